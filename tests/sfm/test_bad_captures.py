"""Captures that cannot be processed: one line with culprit and remedy, exit code 2, nothing left behind."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from PIL import Image
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.cli import main


def refused(capsys: pytest.CaptureFixture[str], folder: Path, *options: str) -> str:
    """The one line with which the command is refused; it must have left nothing."""
    before = sorted(folder.iterdir())
    with pytest.raises(SystemExit) as caught:
        main(["process", "--train", str(folder / "photos"), "--output", str(folder / "out"), *options])
    assert caught.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert sorted(folder.iterdir()) == before
    return lines[0]


def noise(count: int = 3, width: int = 64, height: int = 48) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(count)]


def oriented(path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(noise(1)[0]).save(path, exif=exif)


def empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-300])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (empty, "photos holds no photo and no video"),
        (lambda folder: [(folder / f"photo_{n}.jpg").unlink() for n in (0, 1)], "holds 1 photo, 3 are needed"),
        (lambda folder: oriented(folder / "photo_3.jpg", 6), "photo_3.jpg has EXIF orientation 6, photo_0.jpg has 1"),
        (lambda folder: write(folder, noise(1, 48, 64), ".png"), "photo_0.png is 48 x 64, photo_0.jpg is 64 x 48"),
        (lambda folder: (folder / "photo_1.jpg").write_text("text"), "photo_1.jpg cannot be read as a photo"),
        (lambda folder: truncate(folder / "photo_2.jpg"), "photo_2.jpg cannot be read as a photo"),
        (lambda folder: Image.new("I;16", (64, 48)).save(folder / "photo_4.png"), "photo_4.png is of mode I;16"),
        (lambda folder: [empty(folder), (folder / "a.mp4").write_text("no")], "a.mp4 is no video that can be decoded"),
    ],
)
def test_what_is_wrong_with_the_photos_is_named(damage: Callable[[Path], object], message, tmp_path, capsys):
    damage(write(tmp_path / "photos", noise(), ".jpg"))
    assert message in refused(capsys, tmp_path)


def test_options_that_make_no_sense_are_named(tmp_path, capsys):
    write(tmp_path / "photos", noise())
    (tmp_path / "text.png").write_text("text")
    Image.new("L", (64, 50), 255).save(tmp_path / "shape.png")
    Image.new("L", (64, 48), 0).save(tmp_path / "black.png")
    for options, message in (
        (("--train", str(tmp_path / "nowhere")), "nowhere does not exist"),
        (("--clean", str(tmp_path / "nowhere")), "nowhere does not exist"),
        (("--frames", "0"), "--frames must be at least 3"),
        (("--min-registered", "50"), "--min-registered is a share"),
        (("--threads", "0"), "--threads must be at least 1"),
        (("--mask", str(tmp_path / "nowhere.png")), "nowhere.png cannot be read as a mask"),
        (("--mask", str(tmp_path / "text.png")), "text.png cannot be read as a mask"),
        (("--mask", str(tmp_path / "shape.png")), "shape.png is 64 x 50, the photos are 64 x 48"),
        (("--mask", str(tmp_path / "black.png")), "black.png leaves 0.0% of the frame"),
        (("--output", str(tmp_path / "photos")), "photos exists already"),
        (("--output", str(tmp_path / "text.png/out")), "cannot be written"),
    ):
        assert message in refused(capsys, tmp_path, *options)


def test_a_mask_that_keeps_the_artifact_is_refused(tmp_path, capsys, draw_effect, photos):
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    write(tmp_path / "photos", [layers.apply(photo) for photo in photos(12)])
    Image.fromarray(layers.transmittance.min(axis=-1) <= 0.9).save(tmp_path / "mask.png")
    line = refused(capsys, tmp_path, "--mask", str(tmp_path / "mask.png"), "--threads", "1")
    assert "which is the static artifact" in line
    assert "--invert-mask" in line


def test_photos_that_show_nothing_in_common_stop_the_command(tmp_path, capsys):
    """The work is kept: with another --min-registered the next run needs no new features."""
    write(tmp_path / "photos", noise(4))
    with pytest.raises(SystemExit):
        main(["process", "--train", str(tmp_path / "photos"), "--output", str(tmp_path / "out"), "--threads", "1"])
    (line,) = capsys.readouterr().err.splitlines()
    assert "only 0 of 4 photos could be registered, 50% are required" in line
    assert sorted(path.name for path in tmp_path.iterdir()) == [".out.work", "photos"]


def test_no_lower_requirement_than_none_is_proposed(tmp_path, capsys):
    write(tmp_path / "photos", noise(4))
    line = refused(capsys, tmp_path, "--min-registered", "0", "--threads", "1")
    assert "only 0 of 4 photos could be registered, at least one is required; mask what covers" in line
    assert "--min-registered" not in line


def test_copies_of_one_photo_are_not_told_to_overlap_more(tmp_path, photos, capsys):
    write(tmp_path / "photos", [photos(12)[0]] * 8)
    line = refused(capsys, tmp_path, "--threads", "1")
    assert "nothing in them moves, as in copies of one photo or from a tripod; take photos from several places" in line


@pytest.mark.parametrize("blocks", [1, 300, 600], ids=["photos", "database", "more of the database"])
def test_a_full_disk(blocks, tmp_path, photos):
    """A real process whose files may not grow beyond a limit, as on a full disk."""
    write(tmp_path / "photos", photos(8))
    command = f'ulimit -f {blocks}; exec "$0" -m ssa_nerfstudio process --threads 1 --train photos --output out'
    done = subprocess.run(["bash", "-c", command, sys.executable], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "out cannot be written" in line
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_memory_that_runs_out_costs_no_work(tmp_path, photos):
    """As systems do it: the largest process, which is COLMAP's, is killed."""
    write(tmp_path / "photos", photos(8))
    command = [sys.executable, "-m", "ssa_nerfstudio", "process", "--threads", "1", "--train", "photos"]
    running = subprocess.Popen(
        [*command, "--output", "out"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert running.stdout is not None
    next(line for line in running.stdout if line.startswith("features"))
    (child,) = psutil.Process(running.pid).children()
    child.kill()
    (line,) = running.communicate()[1].splitlines()
    assert running.returncode == 2
    assert "lack of memory" in line
    assert list(tmp_path.glob(".out.work/motion/database.db"))


def test_videos_of_two_sizes(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    for name, (width, height) in (("a", (64, 48)), ("b", (WIDTH, HEIGHT))):
        writer = cv2.VideoWriter(
            str(tmp_path / f"photos/{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (width, height)
        )
        for frame in noise(5, width, height):
            writer.write(frame)
        writer.release()
    assert "b.avi is 224 x 168, a.avi is 64 x 48" in refused(capsys, tmp_path)
