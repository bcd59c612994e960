"""`ssa detect` on files: the verdict of each camera, the masks, and bad input in one line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import edit_transforms
from PIL import Image

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.evidence.capture_detection import detect_camera, read_cameras


def photos(folder: Path, count: int = 14, artifact: bool = True, size: tuple[int, int] = (64, 96)) -> Path:
    """A wall of noise from changing places, a bright bar in front."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(0, 256, (80, 80, 3), dtype=np.uint8), (400, 400), interpolation=cv2.INTER_CUBIC)
    folder.mkdir(parents=True)
    height, width = size
    for number in range(count):
        y, x = rng.integers(0, 400 - max(size), 2)
        photo = wall[y : y + height, x : x + width].copy()
        if artifact:
            photo[10:20, 20:70] = (250, 250, 200)
        Image.fromarray(photo).save(folder / f"photo_{number}.png")
    return folder


def verdicts(path: Path) -> list[dict]:
    return json.loads(path.read_text())["groups"]


def test_a_folder_of_photos_is_enough(tmp_path, capsys):
    data, output, report = photos(tmp_path / "photos"), tmp_path / "found", tmp_path / "found.json"
    main(["detect", "--data", str(data), "--output", str(output), "--json", str(report)])
    (group,) = verdicts(report)
    assert group["verdict"] == "opaque"
    assert group["views"] == 14
    assert group["p_value"] < 0.01
    masks = [np.asarray(Image.open(output / f"mask_{name}.png")) for name in ("nerfstudio", "colmap")]
    assert (masks[0] == masks[1]).all()
    assert masks[0].shape == (64, 96)
    assert (masks[0][12:18, 24:66] == 0).all()  # black is what both ignore
    assert (masks[0][30:] == 255).mean() > 0.98
    assert group["coverage"] == pytest.approx((masks[0] == 0).mean())
    assert Image.open(output / "evidence.png").mode == "RGB"
    said = capsys.readouterr().out
    assert f"a static artifact over {group['coverage']:.1%} of the frame, opaque" in said
    assert f"Train with an overlay: ssa run {data} --output OUT" in said


def test_a_dash_writes_json_alone_to_the_standard_output(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["detect", "--data", str(photos(tmp_path / "photos")), "--output", "found", "--json", "-"])
    out, err = capsys.readouterr()
    assert [group["verdict"] for group in json.loads(out)["groups"]] == ["opaque"]
    assert "a static artifact over" in err
    assert "found: evidence.png, and masks whose black is the artifact" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["found", "photos"]


def test_detection_needs_no_console(tmp_path, capsys):
    (camera,) = read_cameras(photos(tmp_path / "photos"), 200)
    assert detect_camera(camera, threads=1).verdict == "opaque"
    assert capsys.readouterr() == ("", "")


def test_clean_photos_give_none_and_a_white_mask(tmp_path, capsys):
    data, output, report = photos(tmp_path / "photos", artifact=False), tmp_path / "found", tmp_path / "found.json"
    main(["detect", "--data", str(data), "--output", str(output), "--json", str(report)])
    (group,) = verdicts(report)
    assert (group["verdict"], group["coverage"]) == ("none", 0.0)
    assert (np.asarray(Image.open(output / "mask_colmap.png")) == 255).all()
    said = capsys.readouterr().out
    assert "no static artifact in 14 photos" in said
    assert "Train without an overlay: ssa run" in said


def test_a_dataset_is_tested_per_camera_on_its_training_photos(tiny_scene, tmp_path):
    """Two sizes of frame, and clean test views that would thin the evidence out."""
    scene = Path(shutil.copytree(tiny_scene, tmp_path / "scene"))
    transforms = json.loads((scene / "transforms.json").read_text())
    frames = []
    for frame in transforms["frames"]:
        frames += [frame, {**frame, "file_path": frame["file_path"].replace("images/", "images/small_")}]
        photo = Image.open(scene / frame["file_path"])
        half = photo.resize((photo.width // 2, photo.height // 2))
        half.save(scene / frames[-1]["file_path"])
        for f, n in ((frames[-2], 1), (frames[-1], 2)):
            f.update({key: transforms[key] / n for key in ("fl_x", "fl_y", "cx", "cy")})
            f.update({key: transforms[key] // n for key in ("w", "h")})
    names = {
        key: [f["file_path"] for f in frames if kind in f["file_path"]]
        for key, kind in (("train_filenames", "train"), ("test_filenames", "test"), ("val_filenames", "test"))
    }
    kept = {k: v for k, v in transforms.items() if k not in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    (scene / "transforms.json").write_text(json.dumps(kept))
    edit_transforms(scene, frames=frames, **names)
    report = tmp_path / "found.json"
    main(["detect", "--data", str(scene), "--output", str(tmp_path / "found"), "--json", str(report)])
    first, second = verdicts(report)
    assert first["verdict"] == second["verdict"] == "opaque"
    assert {(g["width"], g["height"]) for g in (first, second)} == {(64, 48), (32, 24)}
    assert first["views"] == second["views"] == 12
    assert sorted(p.name for p in (tmp_path / "found").iterdir()) == ["small_train", "train"]


def test_without_an_output_the_last_result_of_that_name_is_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    photos(tmp_path / "walk", count=8)
    for _ in range(2):
        main(["detect", "--data", "walk"])
    written = sorted(path.name for path in (tmp_path / "outputs/detection/walk").iterdir())
    assert written == ["evidence.png", "mask_colmap.png", "mask_nerfstudio.png"]


@pytest.fixture
def detected(tmp_path, monkeypatch) -> dict[Path, bytes]:
    """Files of a detection of ./walk, where it is written by default, and what is in them."""
    monkeypatch.chdir(tmp_path)
    photos(tmp_path / "walk", count=8)
    main(["detect", "--data", "walk"])
    return {path: path.read_bytes() for path in Path("outputs/detection/walk").iterdir()}


def test_a_report_in_the_folder_that_is_replaced_is_refused(detected, capsys):
    with pytest.raises(SystemExit) as refused:
        main(["detect", "--data", "walk", "--json", "outputs/detection/walk/found.json"])
    assert refused.value.code == 2
    assert "--json outputs/detection/walk/found.json is in outputs/detection/walk, which" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in Path("outputs/detection/walk").iterdir()} == detected


def test_a_full_disk_leaves_the_earlier_detection(detected):
    command = 'ulimit -f 1; exec "$0" -m ssa_nerfstudio detect --data walk --threads 1'
    done = subprocess.run(["bash", "-c", command, sys.executable], capture_output=True, text=True)
    assert done.returncode == 2
    assert "outputs/detection/walk cannot be written" in done.stderr
    assert {path: path.read_bytes() for path in Path("outputs/detection/walk").iterdir()} == detected
    assert [path.name for path in Path("outputs/detection").iterdir()] == ["walk"]


def test_an_output_that_exists_is_left_alone(tmp_path, capsys):
    data = photos(tmp_path / "photos", count=8)
    with pytest.raises(SystemExit) as refused:
        main(["detect", "--data", str(data), "--output", str(tmp_path)])
    assert refused.value.code == 2
    assert "exists already" in capsys.readouterr().err


def test_a_video_is_accepted(tmp_path):
    data = photos(tmp_path / "photos", count=20)
    video = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 10, (96, 64))
    for number in range(20):
        writer.write(cv2.imread(str(data / f"photo_{number}.png")))
    writer.release()
    report = tmp_path / "found.json"
    main(["detect", "--data", str(video), "--json", str(report), "--output", str(tmp_path / "found")])
    assert verdicts(report)[0]["verdict"] == "opaque"


def broken(folder: Path) -> Path:
    (folder / "photo_3.png").write_text("no photo")
    return folder


def truncated(folder: Path) -> Path:
    path = folder / "photo_3.png"
    path.write_bytes(path.read_bytes()[:500])
    return folder


def on_its_side(folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.open(folder / "photo_3.png").save(folder / "photo_3.jpg", exif=exif)
    (folder / "photo_3.png").unlink()
    return folder


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda folder: folder / "nowhere", "does not exist"),
        (lambda folder: photos(folder / "one", count=1), "2 are needed"),
        (lambda folder: (folder / "empty").mkdir() or folder / "empty", "holds no photo"),
        (broken, "photo_3.png"),
        (truncated, "photo_3.png"),
        (on_its_side, "EXIF orientation"),
    ],
    ids=["missing", "one photo", "empty", "text", "truncated", "mixed orientations"],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys, spoil, complaint):
    data = spoil(photos(tmp_path / "photos"))
    with pytest.raises(SystemExit) as refused:
        main(["detect", "--data", str(data), "--output", str(tmp_path / "found")])
    assert refused.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize(
    "options", [["--draws", "10"], ["--json", "nowhere/found.json"], ["--json", "/"], ["--threads", "0"]]
)
def test_invalid_arguments_are_refused(tmp_path, capsys, options):
    with pytest.raises(SystemExit) as refused:
        main(["detect", "--data", str(tmp_path), *options])
    assert refused.value.code == 2
    assert options[0] in capsys.readouterr().err


@pytest.mark.parametrize(("plain", "largest"), [(False, 64), (True, 300)], ids=["images", "json"])
def test_a_full_disk_leaves_nothing(plain, largest, tmp_path):
    """A limit on the size of files stands in for it: writing fails as on a full disk, in a real process.

    The images of uniform photos are so small that only the report does not fit.
    """
    data = photos(tmp_path / "photos")
    if plain:
        for path in data.iterdir():
            Image.new("RGB", (96, 64), (90, 90, 90)).save(path)
    limited = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
    limited += f"resource.setrlimit(resource.RLIMIT_FSIZE, ({largest}, {largest})); "
    limited += "from ssa_nerfstudio.cli import main; "
    limited += f"main(['detect', '--data', {str(data)!r}, '--output', {str(tmp_path / 'found')!r}, "
    limited += f"'--json', {str(tmp_path / 'found.json')!r}])"
    done = subprocess.run([sys.executable, "-c", limited], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert f"found{'.json' * plain} cannot be written" in line
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_dataset_may_be_named_by_its_file(tiny_scene):
    of_folder, of_file = (read_cameras(path, 10) for path in (tiny_scene, tiny_scene / "transforms.json"))
    assert [(camera.name, camera.count) for camera in of_file] == [(camera.name, camera.count) for camera in of_folder]
    assert [camera.count for camera in of_file] == [12]
