"""Which photos are restored and which pixels: an artifact that is there goes, one that is not leaves no trace."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from small_checkpoints import one_camera, write_run

from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers
from ssa_nerfstudio.export.restoration import fitting, recoverable, restore, shows
from ssa_nerfstudio.overlay.layer import OracleOverlay

WIDTH, HEIGHT = 240, 160
EFFECTS = ("watermark", "ui", "dashboard", "rain", "mud", "vignette", "dust")


def layers_of(transmittance: np.ndarray, addition: np.ndarray) -> ArtifactLayers:
    height, width = transmittance.shape[:2]
    return ArtifactLayers(transmittance, addition, Lens(width, height, 200, 200, 120, 80), "raw", "learned")


def learned_like(layers) -> ArtifactLayers:
    """What a training makes of an artifact: softer, 15 % too clear, and with a haze of one percent."""
    hides, light = (cv2.GaussianBlur(x, (0, 0), 0.7) for x in (1 - layers.transmittance, layers.addition))
    return layers_of(0.99 - 0.85 * hides, 0.85 * light + 0.005)


@pytest.fixture(scope="module")
def photos(captures) -> list[np.ndarray]:
    found = []
    for name in ("plush", "gopro_walk"):
        dataset = Dataset.read(captures / name, eval_interval=8)
        found += [dataset.read_photo(view) for view in dataset.views[::16]]
    return [cv2.resize(photo, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for photo in found]


@pytest.mark.parametrize("known", ["exactly", "as learned"])
@pytest.mark.parametrize("effect", EFFECTS)
def test_photos_show_the_artifact_in_front_of_them_and_clean_ones_do_not(photos, draw_effect, effect, known):
    drawn = draw_effect(effect, HEIGHT, WIDTH)
    layers = learned_like(drawn) if known == "as learned" else layers_of(drawn.transmittance, drawn.addition)
    assert [shows(drawn.apply(photo), layers) for photo in photos] == [True] * len(photos)
    assert [shows(photo, layers) for photo in photos] == [False] * len(photos)


@pytest.mark.parametrize("effect", ["dashboard", "watermark", "mud"])
def test_an_overlay_that_is_off_by_a_pixel_is_still_seen(photos, draw_effect, effect):
    drawn = draw_effect(effect, HEIGHT, WIDTH)
    layers = learned_like(drawn)
    padded = (np.pad(x, ((1, 0), (0, 0), (0, 0)), "edge") for x in (layers.transmittance, layers.addition))
    moved = layers_of(*(x[:-1] for x in padded))
    assert all(shows(drawn.apply(photo), moved) for photo in photos)
    assert not any(shows(photo, moved) for photo in photos)


@pytest.mark.parametrize("contrast", [0.5, 2.0])
def test_contrast_alone_decides_nothing(photos, draw_effect, contrast):
    """A scene may be smoother or rougher behind an artifact than elsewhere."""
    drawn = draw_effect("vignette", HEIGHT, WIDTH)
    layers = layers_of(drawn.transmittance, drawn.addition)
    middle = cv2.GaussianBlur((drawn.transmittance.mean(axis=-1) < 0.9).astype(np.float32), (0, 0), 8)[..., None]
    for photo in photos:
        blurred = cv2.GaussianBlur(photo, (0, 0), 8).astype(np.float32)
        rougher = blurred + (photo - blurred) * (1 + (contrast - 1) * middle)
        scene = np.rint(rougher).clip(0, 255).astype(np.uint8)
        assert shows(drawn.apply(scene), layers)
        assert not shows(scene, layers)


def test_the_rim_of_what_is_hidden_is_not_taken_for_scene(photos, draw_effect):
    drawn = draw_effect("dashboard", HEIGHT, WIDTH)
    layers = learned_like(drawn)
    seen = recoverable(layers, 0.5)
    for photo in photos:
        restored, _ = restore(drawn.apply(photo), layers, seen)
        wrong = np.abs(restored.astype(int) - photo)[seen]
        assert (wrong > 50).mean() < 1e-3
        assert np.abs(drawn.apply(photo).astype(int) - photo)[~seen].mean() > 20


def test_where_the_overlay_is_almost_clear_nothing_changes(photos):
    haze = layers_of(np.full((HEIGHT, WIDTH, 3), 0.995, np.float32), np.full((HEIGHT, WIDTH, 3), 0.002, np.float32))
    restored, implausible = restore(photos[0], haze, recoverable(haze, 0.5))
    np.testing.assert_array_equal(restored, photos[0])
    assert implausible == 0


@pytest.fixture
def run(tmp_path, draw_effect) -> Path:
    """A run that learned a dashboard, beside a folder of photos with it in front of them."""
    drawn = draw_effect("dashboard", HEIGHT, WIDTH)
    overlay = OracleOverlay(torch.from_numpy(drawn.transmittance), torch.from_numpy(drawn.addition))
    return write_run(tmp_path / "run", one_camera(overlay))


def test_photos_without_the_artifact_are_written_as_they_are_and_named(run, tmp_path, capsys, photos, draw_effect):
    drawn = draw_effect("dashboard", HEIGHT, WIDTH)
    (tmp_path / "photos").mkdir()
    Image.fromarray(drawn.apply(photos[0])).save(tmp_path / "photos" / "a.png")
    Image.fromarray(photos[1]).save(tmp_path / "photos" / "b.png")
    out = tmp_path / "out"
    main(["export-overlay", "--load-config", str(run), "--output", str(out), "--apply", str(tmp_path / "photos")])
    np.testing.assert_array_equal(np.asarray(Image.open(out / "photos" / "b.png")), photos[1])
    assert not np.asarray(Image.open(out / "photos" / "a.png"))[-10:].any()
    said = capsys.readouterr().out
    assert "1 photo; " in said
    assert "1 photo left unchanged, without the artifact where it was learned: b.png." in said


def test_a_folder_of_photos_without_the_artifact_is_refused(run, tmp_path, capsys, photos):
    (tmp_path / "photos").mkdir()
    Image.fromarray(photos[0]).save(tmp_path / "photos" / "a.png")
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        main(["export-overlay", "--load-config", str(run), "--output", str(out), "--apply", str(tmp_path / "photos")])
    assert ended.value.code == 2
    assert "none of the photos in " in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(("width", "fits"), [(480, True), (482, True), (478, True), (484, False), (476, False)])
def test_photos_of_another_size_fit_where_rounding_explains_their_aspect(tmp_path, width, fits):
    """The frame is 240 x 160: at twice its size, 480 x 320, a column is 0.2 % of the aspect."""
    frame = layers_of(np.ones((HEIGHT, WIDTH, 3), np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float32))
    path = tmp_path / "photo.png"
    Image.new("RGB", (width, 320)).save(path)
    if fits:
        assert fitting(path, [frame]) is frame
    else:
        with pytest.raises(InputError, match=f"is {width} x 320, the overlay's frame 240 x 160"):
            fitting(path, [frame])
