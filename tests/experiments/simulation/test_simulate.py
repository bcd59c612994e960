"""`ssa simulate` from end to end, on small datasets."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from small_datasets import contents, edit, pixels, write_dataset

from benchmarks.simulator_speed import measure
from ssa_nerfstudio.cameras.lens import undistort
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.photos import write_photo
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.simulation import corruption
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects
from ssa_nerfstudio.experiments.simulation.simulator import simulate


def run(data: Path, output: Path, *arguments: str) -> dict:
    main(["simulate", "--data", str(data), "--output", str(output), *arguments])
    return json.loads((output / "transforms.json").read_text())


def load(path: Path, suffix: str = "") -> Layers:
    with np.load(path) as arrays:
        return Layers(arrays[f"T{suffix}"], arrays[f"B{suffix}"])


def view_layers(path: Path, static: Layers) -> Layers:
    """The layers of one view in the raw frame: those of its file inside a rectangle, `static` outside."""
    with np.load(path) as arrays:
        (row, column), (height, width, _) = arrays["corner"], arrays["T"].shape
        box = slice(row, row + height), slice(column, column + width)
        return static.pasted(box, Layers(arrays["T"].astype(np.float32), arrays["B"].astype(np.float32)))


def exact(layers: Layers, photo: np.ndarray) -> np.ndarray:
    """clip(T C + B) in float64, in gray levels."""
    formed = layers.transmittance.astype(np.float64) * (photo / 255) + layers.addition
    return formed.clip(0, 1) * 255


@pytest.mark.parametrize("effect", EFFECTS)
def test_training_photos_are_the_stored_layers_applied_and_test_photos_are_untouched(effect, tmp_path):
    data = write_dataset(tmp_path / "data", views=10, width=60, height=44)
    out = tmp_path / "out"
    meta = run(data, out, "--effects", effect, "--seed", "5")
    assert meta["test_filenames"] == meta["val_filenames"] == ["images/frame_000.jpg", "images/frame_008.jpg"]
    assert meta["train_filenames"] == [f"images/frame_{n:03d}.png" for n in range(10) if n % 8]
    for name in meta["test_filenames"]:
        assert (out / name).read_bytes() == (data / name).read_bytes()
    layers = load(out / "layers/raw.npz")
    for name in meta["train_filenames"]:
        clean, corrupted = pixels(data / name.replace("png", "jpg")), pixels(out / name)
        per_view = out / "layers/views" / name.replace("png", "npz")
        assert per_view.exists() == (effect in ("finger", "occlusion"))
        drawn = view_layers(per_view, layers) if per_view.exists() else layers
        assert np.abs(corrupted - exact(drawn, clean)).max() <= 0.5 + 1e-3
        assert (corrupted != clean).any()
    pictures = {path.name for path in (out / "layers").glob("*.png")}
    assert pictures == {f"{frame}_{key}.png" for frame in ("raw", "undistorted") for key in "TB"}
    for key, values in (("T", layers.transmittance), ("B", layers.addition)):
        assert np.abs(pixels(out / f"layers/raw_{key}.png") - values.clip(0, 1) * 255).max() <= 0.5 + 1e-3
    # No distortion: the two frames are one.
    undistorted = load(out / "layers/undistorted.npz")
    assert np.array_equal(undistorted.transmittance, layers.transmittance)
    assert np.array_equal(undistorted.addition, layers.addition)


def test_mean_layers_are_the_mean_over_the_training_views(tmp_path):
    out = tmp_path / "out"
    run(write_dataset(tmp_path / "data", width=60, height=44), out, "--effects", "dust", "finger", "occlusion")
    mean = load(out / "layers/raw.npz")
    views = [view_layers(path, mean) for path in sorted((out / "layers/views").rglob("*.npz"))]
    assert len(views) == 8
    for name in ("transmittance", "addition"):
        stack = np.stack([getattr(view, name) for view in views])
        assert np.abs(stack.mean(axis=0) - getattr(mean, name)).max() < 1e-6
        assert (np.ptp(stack, axis=0) > 0).any()


def test_the_same_seed_gives_the_same_bytes_and_another_gives_others(tmp_path):
    data = write_dataset(tmp_path / "data")
    arguments = ("--effects", "rain", "occlusion", "--seed")
    for name, seed, threads in (("a", "3", "1"), ("b", "3", "4"), ("c", "4", "4")):
        run(data, tmp_path / name, *arguments, seed, "--threads", threads)
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b
    assert a.keys() == c.keys()
    differing = {path for path in a if a[path] != c[path]}
    assert {"layers/raw.npz", "scene.yaml", "images/frame_001.png"} <= differing
    assert not differing & {"images/frame_000.jpg", "sparse_pc.ply", "transforms.json"}


def test_the_recorded_scene_repeats_the_run(tmp_path):
    data = write_dataset(tmp_path / "data")
    run(data, tmp_path / "a", "--effects", "ui", "finger", "mud", "--seed", "9")
    record = yaml.safe_load((tmp_path / "a/scene.yaml").read_text())
    assert [effect["effect"] for effect in record["effects"]] == ["ui", "finger", "mud"]
    assert record["effects"][2]["color"] == [63, 42, 20]
    assert record["seed"] == 9
    assert {"numpy", "opencv", "Pillow", "albumentations"} <= record["provenance"]["versions"].keys()
    run(data, tmp_path / "b", "--scene", str(tmp_path / "a/scene.yaml"))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_effects_are_composed_in_order(tmp_path):
    data = write_dataset(tmp_path / "data")
    for names in (["rain"], ["dashboard"], ["rain", "dashboard"]):
        run(data, tmp_path / "-".join(names), "--effects", *names)
    rain, dashboard, both = (
        load(tmp_path / name / "layers/raw.npz") for name in ("rain", "dashboard", "rain-dashboard")
    )
    assert both.transmittance == pytest.approx(dashboard.transmittance * rain.transmittance, abs=1e-6)
    assert both.addition == pytest.approx(dashboard.transmittance * rain.addition + dashboard.addition, abs=1e-6)


def test_no_effect_copies_every_file_and_adds_the_split(tmp_path):
    mask = {"mask_path": "masks/m.png"}
    data = write_dataset(tmp_path / "data", width=20, height=10)
    frames = [frame | mask for frame in json.loads((data / "transforms.json").read_text())["frames"]]
    before = edit(data, frames=frames, aabb_scale=4)
    (data / "colmap/sparse/0").mkdir(parents=True)
    (data / "colmap/sparse/0/points3D.bin").write_bytes(b"points")
    (data / "masks").mkdir()
    Image.new("L", (20, 10), 255).save(data / "masks/m.png")
    meta = run(data, tmp_path / "out", "--effects")
    added = {"train_filenames", "val_filenames", "test_filenames"}
    assert {key: value for key, value in meta.items() if key not in added} == before
    assert added <= meta.keys()
    ignored = ("transforms.json", "scene.yaml")
    original, copied = contents(data), contents(tmp_path / "out")
    assert original.keys() | {"scene.yaml"} == copied.keys()
    assert all(copied[path] == original[path] for path in original if path not in ignored)


def test_the_split_in_transforms_is_respected(tmp_path):
    data = write_dataset(tmp_path / "data", views=6)
    names = [f"images/frame_{n:03d}.jpg" for n in range(6)]
    edit(data, train_filenames=names[:3], val_filenames=names[3:4], test_filenames=["./" + names[4]])
    meta = run(data, tmp_path / "out", "--effects", "vignette", "--eval-interval", "2")
    assert meta["train_filenames"] == [name.replace("jpg", "png") for name in names[:3]]
    assert (meta["val_filenames"], meta["test_filenames"]) == (names[3:4], names[4:5])
    assert (tmp_path / "out" / names[5]).read_bytes() == (data / names[5]).read_bytes()


def test_a_rig_gets_layers_for_every_camera(tmp_path):
    data = write_dataset(tmp_path / "data", views=10, width=48, height=36, k1=-0.1)
    meta = json.loads((data / "transforms.json").read_text())
    shared = {key: meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    for number, frame in enumerate(sorted(meta["frames"], key=lambda frame: frame["file_path"])):
        frame.update(shared, fl_x=shared["fl_x"] * (1.3 if number % 2 else 1))
        if number % 2:
            frame.update(w=40)
            photo = data / frame["file_path"]
            Image.open(photo).resize((40, 36)).save(photo)
    edit(data, frames=meta["frames"], **dict.fromkeys(shared))
    out = run(data, tmp_path / "out", "--effects", "watermark")
    lenses = {view.path: view.lens for view in Dataset.read(data, 8).views}
    for name in out["train_filenames"]:
        source = name.replace("png", "jpg")
        camera = "0" if int(Path(name).stem[-3:]) % 2 else "1"  # the first training view is number 1
        raw, straight = (load(tmp_path / f"out/layers/{frame}.npz", camera) for frame in ("raw", "undistorted"))
        assert np.abs(pixels(tmp_path / "out" / name) - exact(raw, pixels(data / source))).max() <= 0.5 + 1e-3
        assert np.array_equal(straight.addition, undistort(raw.addition, lenses[source]))
    assert (tmp_path / "out/layers/undistorted_T1.png").exists()


@pytest.mark.parametrize("stated_as", [float, str])
def test_reduced_photos_become_a_dataset_of_their_own(stated_as, tmp_path):
    data = write_dataset(tmp_path / "data", width=80, height=60, k1=-0.1)
    edit(data, w=stated_as(80), cx=stated_as(40))
    (data / "images_2").mkdir()
    for path in (data / "images").iterdir():
        Image.open(path).reduce(2).save(data / "images_2" / path.name)
    meta = run(data, tmp_path / "out", "--effects", "ui", "--downscale-factor", "2")
    assert (meta["w"], meta["h"], meta["cx"], meta["fl_x"], meta["k1"]) == (40, 30, 20, 44, -0.1)
    assert pixels(tmp_path / "out" / meta["train_filenames"][0]).shape == (30, 40, 3)
    assert (tmp_path / "out/images/frame_000.jpg").read_bytes() == (data / "images_2/frame_000.jpg").read_bytes()


def test_gray_and_opaque_rgba_photos_are_taken_as_rgb(tmp_path):
    data = write_dataset(tmp_path / "data", suffix=".png")
    for number, mode in ((1, "L"), (2, "RGBA")):
        path = data / f"images/frame_{number:03d}.png"
        Image.open(path).convert(mode).save(path)
    meta = run(data, tmp_path / "out", "--effects", "rain")
    layers = load(tmp_path / "out/layers/raw.npz")
    for name in meta["train_filenames"]:
        assert np.abs(pixels(tmp_path / "out" / name) - exact(layers, pixels(data / name))).max() <= 0.5 + 1e-3


def test_an_interrupted_run_leaves_nothing(tmp_path, monkeypatch, capsys):
    data = write_dataset(tmp_path / "data")
    written = []

    def interrupted(path: Path, image: np.ndarray) -> None:
        written.append(path)
        if len(written) == 4:
            raise KeyboardInterrupt
        write_photo(path, image)

    monkeypatch.setattr(corruption, "write_photo", interrupted)
    with pytest.raises(SystemExit) as stopped:
        run(data, tmp_path / "out", "--effects", "vignette")
    assert stopped.value.code == 130
    assert capsys.readouterr().err.splitlines()[-1] == "ssa simulate was stopped"
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_a_file_that_cannot_be_copied_is_named_and_not_the_output(tmp_path, capsys):
    data = write_dataset(tmp_path / "data")
    points = data / "sparse_pc.ply"
    points.unlink()
    points.mkdir()
    with pytest.raises(SystemExit):
        run(data, tmp_path / "out", "--effects", "vignette")
    assert f"{points} cannot be read as sparse points (Is a directory)" in capsys.readouterr().err


def test_a_photo_too_large_to_be_one_is_named(tmp_path, capsys, monkeypatch):
    data = write_dataset(tmp_path / "data")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(SystemExit):
        run(data, tmp_path / "out", "--effects", "vignette")
    assert "cannot be read as a photo (Image size" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_killed_run_leaves_nothing_that_looks_complete(tmp_path):
    data = write_dataset(tmp_path / "data", views=40, width=1200, height=900)
    command = [sys.executable, "-m", "ssa_nerfstudio", "simulate", "--data", str(data)]
    process = subprocess.Popen([*command, "--output", str(tmp_path / "out"), "--effects", "vignette"])
    while not list(tmp_path.glob(".out.*/out/images/*.png")):
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert not (tmp_path / "out").exists()
    assert [path.parent for path in tmp_path.rglob("transforms.json")] == [data]


def test_memory_does_not_grow_with_the_number_of_photos(tmp_path):
    peaks = []
    for views in (10, 50):
        data = write_dataset(tmp_path / f"data{views}", views=views, width=200, height=150)
        dataset, scene = Dataset.read(data, 8), Scene(read_effects(("finger", "dust")))
        tracemalloc.start()
        simulate(dataset, scene, tmp_path / f"out{views}", threads=2)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 0.2 * peaks[0]


def test_half_of_the_bare_rate_is_kept(tmp_path):
    data = write_dataset(tmp_path / "data", views=20, width=800, height=600)
    bare, simulated = measure(Dataset.read(data, 8), "watermark", threads=1, repeats=3, clock=time.process_time)
    assert bare / simulated >= 0.5


@pytest.mark.parametrize("arguments", [[], ["--effects", "ui", "--scene", "stock-video"]])
def test_either_effects_or_a_scene_has_to_be_named(arguments, tmp_path, capsys):
    data = write_dataset(tmp_path / "data")
    with pytest.raises(SystemExit) as caught:
        run(data, tmp_path / "out", *arguments)
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "either --effects NAME" in line
