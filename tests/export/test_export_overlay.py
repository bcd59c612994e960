"""The artifact as files: what was trained comes back, in the frame that was asked for, and off the photos."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from small_checkpoints import cameras, one_camera, write_run

from ssa_nerfstudio.cameras.lens import Lens, distort, undistorted_lens
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.export.artifact_files import FILES
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay

WIDTH, HEIGHT = 96, 64


def given(layers) -> OracleOverlay:
    return OracleOverlay(torch.from_numpy(layers.transmittance), torch.from_numpy(layers.addition))


def learned(width: int = WIDTH, height: int = HEIGHT, seed: int = 0, resolution: int = 1) -> ScreenSpaceOverlay:
    overlay = ScreenSpaceOverlay(height, width, resolution)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        overlay.color_logits.normal_(0, 2, generator=generator)
        overlay.alpha_logits.normal_(0, 3, generator=generator)
    return overlay


def export(config: Path, output: Path, *options: object) -> dict:
    main(["export-overlay", "--load-config", str(config), "--output", str(output), *map(str, options)])
    return json.loads((output / "overlay.json").read_text())


def read_rgba(path: Path) -> np.ndarray:
    """Straight RGBA in [0, 1]."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA) / {np.dtype("u1"): 255, np.dtype("u2"): 65535}[image.dtype]


def laid_over(rgba: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """What a picture editor makes of it, in gray levels."""
    alpha = rgba[..., 3:]
    return 255 * alpha * rgba[..., :3] + (1 - alpha) * photo


def photo(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    coarse = np.random.default_rng(seed).uniform(0, 255, (8, 8, 3)).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).round().astype(np.uint8)


@pytest.mark.parametrize("effect", ["watermark", "ui", "dashboard", "mud", "dust", "vignette"])
def test_a_given_artifact_comes_back_within_a_gray_level(tmp_path, effect, draw_effect):
    layers = draw_effect(effect, HEIGHT, WIDTH)
    export(write_run(tmp_path / "run", one_camera(given(layers))), tmp_path / "out")
    truth = layers.apply(photo()).astype(float)
    for name in ("overlay.png", "overlay_16bit.png"):
        error = np.abs(laid_over(read_rgba(tmp_path / "out" / name), photo()) - truth)
        assert error.mean() < 1
        assert np.percentile(error, 99) < 2


@pytest.mark.parametrize("resolution", [1, 2, 4])
def test_every_file_shows_the_learned_overlay(tmp_path, resolution):
    overlay = learned(resolution=resolution)
    about = export(write_run(tmp_path / "run", one_camera(overlay)), tmp_path / "out", "--threshold", 0.3)
    with torch.no_grad():
        transmittance, addition = (layer.numpy() for layer in overlay.layers())
    alpha = 1 - transmittance
    eight, sixteen = (read_rgba(tmp_path / "out" / n) for n in ("overlay.png", "overlay_16bit.png"))
    np.testing.assert_allclose(eight[..., 3:], alpha, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(sixteen[..., 3:], alpha, atol=0.5 / 65535 + 1e-6)
    np.testing.assert_allclose(sixteen[..., :3] * alpha, addition, atol=1e-4)
    premultiplied = np.load(tmp_path / "out" / "overlay_premultiplied.npy")
    np.testing.assert_allclose(premultiplied, np.concatenate([addition, alpha], -1), atol=1e-6)
    matte = cv2.imread(str(tmp_path / "out" / "matte.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(matte / 65535, alpha[..., 0], atol=1e-4)
    scene, artifact = (
        cv2.imread(str(tmp_path / "out" / f"mask_white_is_{what}.png"), cv2.IMREAD_UNCHANGED)
        for what in ("scene", "artifact")
    )
    np.testing.assert_array_equal(artifact, np.where(alpha[..., 0] > 0.3, 255, 0))
    np.testing.assert_array_equal(scene, 255 - artifact)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*FILES, "layers.npz", "overlay.json"}
    assert about["cameras"][0]["covered_fraction"] == pytest.approx((alpha > 0.3).mean())
    assert about["cameras"][0]["mean_matte"] == pytest.approx(alpha.mean(), rel=1e-5)


def test_nerfstudio_and_colmap_keep_what_is_white(tmp_path, draw_effect):
    from nerfstudio.data.utils.data_utils import get_image_mask_tensor_from_path

    export(
        write_run(tmp_path / "run", one_camera(given(draw_effect("dashboard", HEIGHT, WIDTH)))),
        tmp_path / "out",
        "--raw-frame",
    )
    kept = get_image_mask_tensor_from_path(tmp_path / "out" / "mask_white_is_scene.png")[..., 0].numpy()
    assert kept[:20].all()
    assert not kept[-10:].any()


def test_light_that_no_rgba_picture_can_hold_is_reported(tmp_path, draw_effect):
    rain, mark = draw_effect("rain", HEIGHT, WIDTH), draw_effect("watermark", HEIGHT, WIDTH)
    lost = [
        export(write_run(tmp_path / name, one_camera(given(layers))), tmp_path / f"out-{name}")["cameras"][0]
        for name, layers in (("rain", rain), ("mark", mark))
    ]
    assert lost[0]["lost_in_rgba_gray_levels"] > 1
    assert lost[1]["lost_in_rgba_gray_levels"] < 0.01


def shining() -> ScreenSpaceOverlay:
    """A learned artifact that adds light: bright drops that hide little, one so bright that nothing is left."""
    overlay = ScreenSpaceOverlay(HEIGHT, WIDTH, adds_light=True)
    light = torch.full((HEIGHT, WIDTH, 3), 0.01)
    light[10:20, 10:40] = torch.tensor([0.7, 0.6, 0.5])
    light[30:40, 10:40] = torch.tensor([0.2, 0.3, 0.1])
    light[50:60, 10:40] = 0.97
    with torch.no_grad():
        overlay.color_logits.copy_(light.logit())
        overlay.alpha_logits.fill_(torch.tensor(0.02).logit())
    return overlay


def test_light_is_exported_with_the_least_matte_that_carries_it(tmp_path):
    overlay = shining()
    about = export(write_run(tmp_path / "run", one_camera(overlay)), tmp_path / "out")["cameras"][0]
    light, hides = overlay.color().detach().numpy(), overlay.matte().detach().numpy()
    least = np.maximum(hides, light.max(axis=-1, keepdims=True))
    rgba = read_rgba(tmp_path / "out" / "overlay_16bit.png")
    np.testing.assert_allclose(rgba[..., 3:], least, atol=1e-4)
    # In front of black, the picture is what the artifact adds.
    np.testing.assert_allclose(laid_over(rgba, np.zeros(3)) / 255, light, atol=1e-4)
    matte = cv2.imread(str(tmp_path / "out" / "matte.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(matte / 65535, least[..., 0], atol=1e-4)
    artifact = np.asarray(Image.open(tmp_path / "out" / "mask_white_is_artifact.png")) > 0
    np.testing.assert_array_equal(artifact, least[..., 0] > 0.5)
    assert about["covered_fraction"] == pytest.approx(600 / (WIDTH * HEIGHT))
    assert about["lost_in_rgba_gray_levels"] == pytest.approx(255 * (least - hides).mean(), rel=1e-3)
    premultiplied = np.load(tmp_path / "out" / "overlay_premultiplied.npy")
    np.testing.assert_allclose(premultiplied, np.concatenate([light, hides], -1), atol=1e-6)
    given_again = np.load(tmp_path / "out" / "layers.npz")
    np.testing.assert_allclose(given_again["T"], 1 - hides.repeat(3, axis=-1), atol=1e-6)
    np.testing.assert_allclose(given_again["B"], light, atol=1e-6)


def test_photos_lose_light_and_it_is_told_where_they_are_white_by_it(tmp_path, capsys):
    overlay, truth = shining(), photo(4).astype(int)
    transmittance, addition = (layer.detach().numpy() for layer in overlay.layers())
    full = transmittance * (truth / 255) + addition
    shot = np.rint(255 * full.clip(0, 1)).astype(np.uint8)
    (tmp_path / "photos").mkdir()
    Image.fromarray(shot).save(tmp_path / "photos" / "a.png")
    config = write_run(tmp_path / "run", one_camera(overlay))
    export(config, tmp_path / "out", "--apply", tmp_path / "photos", "--threshold", 0.9)
    restored = np.asarray(Image.open(tmp_path / "out" / "photos" / "a.png")).astype(int)
    lost = (np.maximum(1 - transmittance, addition) > 0.9).any(axis=-1)
    white = (shot == 255).any(axis=-1) & ~lost
    assert white.any()
    seen = np.asarray(Image.open(tmp_path / "out" / f"mask_white_is_scene_{WIDTH}x{HEIGHT}.png")) > 0
    assert not (seen & lost).any()
    assert not restored[~seen].any()
    assert np.abs(restored - truth)[seen & ~white].max() <= 1
    assert (restored <= truth + 1)[seen & white].all()
    said = capsys.readouterr().out
    assert f"{(~seen).mean():.1%} of their pixels" in said
    assert f"{(white & seen).mean():.1%} of the pixels are white by it" in said


def test_the_layers_can_be_given_to_another_training(tmp_path, tiny_scene, configure_training, train_and_evaluate):
    config = write_run(tmp_path / "run", one_camera(learned(64, 48)))
    export(config, tmp_path / "out")
    model = {"num_downscales": 0, "overlay": "given", "overlay_given": tmp_path / "out" / "layers.npz"}
    _, pipeline, _ = train_and_evaluate(configure_training("ssa-splatfacto", tiny_scene, tmp_path / "again", 1, model))
    transmittance, _ = learned(64, 48).layers()
    torch.testing.assert_close(pipeline.model.artifacts[0].layers()[0], transmittance.detach().expand(-1, -1, 3))


def test_a_rig_gets_a_folder_for_each_camera(tmp_path):
    lenses = [Lens(WIDTH, HEIGHT, 60, 60, 48, 32), Lens(48, 40, 60, 60, 24, 20)]
    config = write_run(tmp_path / "run", cameras([(learned(), lenses[0]), (learned(48, 40, 1), lenses[1])]))
    about = export(config, tmp_path / "out")
    assert [camera["folder"] for camera in about["cameras"]] == ["camera_0", "camera_1"]
    sizes = [Image.open(tmp_path / "out" / camera["folder"] / "overlay.png").size for camera in about["cameras"]]
    assert sizes == [(WIDTH, HEIGHT), (48, 40)]
    assert {"T0", "B0", "T1", "B1"} == set(np.load(tmp_path / "out" / "layers.npz").files)


LENSES = {
    "perspective": Lens(WIDTH, HEIGHT, 70, 71, 47, 33, (-0.2, 0.05, 0.0, 0.0, 1e-3, -1e-3)),
    "fisheye": Lens(WIDTH, HEIGHT, 60, 60, 47, 33, (0.05, 0.01, 0.0, 0.0, 0.0, 0.0), "fisheye"),
}


@pytest.mark.parametrize("model", sorted(LENSES))
def test_the_raw_frame_is_that_of_the_photos(tmp_path, model, draw_effect, undistorted_layers):
    lens = LENSES[model]
    raw = draw_effect("watermark", HEIGHT, WIDTH)
    target = undistorted_lens(lens)
    inside = undistorted_layers(raw, lens)
    config = write_run(tmp_path / "run", one_camera(given(inside), lens))
    about = export(config, tmp_path / "out", "--raw-frame")["cameras"][0]
    assert (about["frame"], about["intrinsics"]["width"], about["intrinsics"]["distortion"]) == (
        "raw",
        WIDTH,
        list(lens.distortion),
    )
    known = distort(np.ones((target.height, target.width), np.float32), lens, 0.0) > 0.999
    error = np.abs(laid_over(read_rgba(tmp_path / "out" / "overlay.png"), photo()) - raw.apply(photo()))[known]
    assert error.mean() < 2


def test_masks_of_the_raw_frame_go_on_to_its_border(tmp_path, draw_effect, undistorted_layers):
    """Nothing is learned of what undistortion crops away, but a dashboard does not end there."""
    lens = LENSES["perspective"]
    raw = draw_effect("dashboard", HEIGHT, WIDTH)
    config = write_run(tmp_path / "run", one_camera(given(undistorted_layers(raw, lens)), lens))
    export(config, tmp_path / "out", "--raw-frame")
    artifact = np.asarray(Image.open(tmp_path / "out" / "mask_white_is_artifact.png")) > 0
    true = raw.transmittance.min(axis=-1) < 0.5
    assert true[-1].all()
    assert artifact[-1].all()
    assert (artifact != true).mean() < 0.03
    assert read_rgba(tmp_path / "out" / "overlay.png")[-1, 0, 3] == 0


@pytest.mark.parametrize(("effect", "highest"), [("watermark", 12), ("dashboard", 40)])
def test_an_artifact_in_front_of_gopro_walk_comes_back_through_its_lens(
    captures, tmp_path, effect, highest, draw_effect, undistorted_layers
):
    t = json.loads((captures / "gopro_walk" / "transforms.json").read_text())
    distortion = tuple(float(t.get(name, 0)) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    lens = Lens(t["w"], t["h"], t["fl_x"], t["fl_y"], t["cx"], t["cy"], distortion)
    raw = draw_effect(effect, lens.height, lens.width)
    inside = undistorted_layers(raw, lens)
    export(write_run(tmp_path / "run", one_camera(given(inside), lens)), tmp_path / "out", "--raw-frame")
    clean = np.asarray(Image.open(captures / "gopro_walk" / t["frames"][10]["file_path"]).convert("RGB"))
    target = undistorted_lens(lens)
    known = distort(np.ones((target.height, target.width), np.float32), lens, 0.0) > 0.999
    error = np.abs(laid_over(read_rgba(tmp_path / "out" / "overlay.png"), clean) - raw.apply(clean))[known]
    print(f"{effect}: mean {error.mean():.3f}, 99th percentile {np.percentile(error, 99):.2f} gray levels")
    assert error.mean() < 2
    assert np.percentile(error, 99) < highest


def test_a_training_keeps_its_lens_in_the_checkpoint(broken_scene, tmp_path, configure_training, train_and_evaluate):
    from conftest import edit_transforms

    edit_transforms(broken_scene, k1=-0.1, k2=0.02)
    _, pipeline, config = train_and_evaluate(configure_training("ssa-splatfacto", broken_scene, tmp_path, 1))
    overlay = pipeline.model.artifacts[0]
    assert (overlay.height, overlay.width) != (48, 64)
    about = export(config, tmp_path / "out", "--raw-frame")["cameras"][0]
    assert Image.open(tmp_path / "out" / "overlay.png").size == (64, 48)
    assert about["intrinsics"]["distortion"][:2] == pytest.approx([-0.1, 0.02])


def old_run(folder: Path) -> Path:
    """A checkpoint of the first version, which kept no lenses and whose artifacts added no light."""
    config = write_run(folder, one_camera(learned()))
    path = next((folder / "nerfstudio_models").iterdir())
    saved = torch.load(path, weights_only=True)
    state, overlay = saved["pipeline"], "_model.artifacts.overlays.0."
    del state["_model.artifacts.lenses"]
    state[f"{overlay}frame"] = state[f"{overlay}frame"][:3]
    torch.save(saved, path)
    return config


def test_a_checkpoint_of_the_first_version_is_still_read(tmp_path, capsys):
    export(old_run(tmp_path / "run"), tmp_path / "out")
    export(write_run(tmp_path / "new", one_camera(learned())), tmp_path / "of-new")
    assert (tmp_path / "out" / "overlay.png").read_bytes() == (tmp_path / "of-new" / "overlay.png").read_bytes()
    with pytest.raises(SystemExit):
        export(old_run(tmp_path / "run"), tmp_path / "raw", "--raw-frame")
    assert "use the undistorted frame" in capsys.readouterr().err
    assert not (tmp_path / "raw").exists()


def test_a_checkpoint_with_pixels_that_waited_for_the_scene_is_still_read(tmp_path):
    config = write_run(tmp_path / "run", one_camera(learned()))
    export(config, tmp_path / "new")
    (checkpoint,) = config.parent.glob("nerfstudio_models/*.ckpt")
    loaded = torch.load(checkpoint, weights_only=False)
    state = loaded["pipeline"]
    state["_model.artifacts.overlays.0.near"] = torch.ones_like(state["_model.artifacts.overlays.0.evidence"])
    torch.save(loaded, checkpoint)
    export(config, tmp_path / "before")
    assert (tmp_path / "before" / "overlay.png").read_bytes() == (tmp_path / "new" / "overlay.png").read_bytes()


def test_photos_lose_a_watermark_and_keep_the_rest(tmp_path, capsys, draw_effect):
    layers = draw_effect("watermark", HEIGHT, WIDTH)
    (tmp_path / "photos" / "day 1").mkdir(parents=True)
    truth = photo(1)
    Image.fromarray(layers.apply(truth)).save(tmp_path / "photos" / "day 1" / "a.png")
    config = write_run(tmp_path / "run", one_camera(given(layers)))
    export(config, tmp_path / "out", "--apply", tmp_path / "photos")
    restored = np.asarray(Image.open(tmp_path / "out" / "photos" / "day 1" / "a.png")).astype(int)
    # One rounding, divided by a transmittance of 0.6.
    assert np.abs(restored - truth).max() <= 2
    said = capsys.readouterr().out
    assert "0.0% of their pixels" in said
    assert "adds light" not in said


def test_what_an_opaque_artifact_hides_is_black_and_counted(tmp_path, capsys, draw_effect):
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    (tmp_path / "photos").mkdir()
    truth = photo(2)
    Image.fromarray(layers.apply(truth)).save(tmp_path / "photos" / "a.png")
    config = write_run(tmp_path / "run", one_camera(given(layers)))
    export(config, tmp_path / "out", "--apply", tmp_path / "photos")
    restored = np.asarray(Image.open(tmp_path / "out" / "photos" / "a.png")).astype(int)
    seen = np.asarray(Image.open(tmp_path / "out" / f"mask_white_is_scene_{WIDTH}x{HEIGHT}.png")) > 0
    hidden = (layers.transmittance < 0.5).any(axis=-1)
    assert not (seen & hidden).any()
    assert not restored[~seen].any()
    assert np.abs(restored - truth)[seen].max() <= 2
    beyond = cv2.dilate(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert seen[~beyond].all()
    assert f"{(~seen).mean():.1%} of their pixels" in capsys.readouterr().out


def test_original_photos_of_twice_the_size_are_restored(tmp_path, draw_effect):
    large = draw_effect("watermark", 2 * HEIGHT, 2 * WIDTH)
    small = [
        torch.from_numpy(cv2.resize(p, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))
        for p in (large.transmittance, large.addition)
    ]
    (tmp_path / "photos").mkdir()
    truth = photo(3, 2 * WIDTH, 2 * HEIGHT)
    Image.fromarray(large.apply(truth)).save(tmp_path / "photos" / "a.png")
    export(
        write_run(tmp_path / "run", one_camera(OracleOverlay(*small))), tmp_path / "out", "--apply", tmp_path / "photos"
    )
    restored = np.asarray(Image.open(tmp_path / "out" / "photos" / "a.png")).astype(int)
    before = np.abs(large.apply(truth).astype(int) - truth).mean()
    assert np.abs(restored - truth).mean() < 0.35 * before


def test_photos_of_a_rig_need_to_know_their_camera(tmp_path, capsys, draw_effect):
    lenses = [Lens(WIDTH, HEIGHT, 60, 60, 48, 32), Lens(WIDTH, HEIGHT, 80, 80, 48, 32)]
    marks = [draw_effect("watermark", HEIGHT, WIDTH), draw_effect("ui", HEIGHT, WIDTH)]
    pairs = [(given(layers), lens) for layers, lens in zip(marks, lenses, strict=True)]
    config = write_run(tmp_path / "run", cameras(pairs))
    (tmp_path / "photos").mkdir()
    Image.fromarray(marks[1].apply(photo())).save(tmp_path / "photos" / "a.png")
    with pytest.raises(SystemExit):
        export(config, tmp_path / "out", "--apply", tmp_path / "photos")
    said = " ".join(capsys.readouterr().err.split())
    assert "2 overlays: camera_0, camera_1" in said
    assert "--camera 0 to 1" in said
    export(config, tmp_path / "out", "--apply", tmp_path / "photos", "--camera", 1, "--threshold", 0.7)
    restored = np.asarray(Image.open(tmp_path / "out" / "photos" / "a.png")).astype(int)
    seen = np.asarray(Image.open(tmp_path / "out" / f"mask_white_is_scene_{WIDTH}x{HEIGHT}.png")) > 0
    assert seen.mean() > 0.8
    assert np.abs(restored - photo())[seen].max() <= 3


def spoil_nothing(tmp_path: Path) -> list[object]:
    (tmp_path / "empty").mkdir()
    return ["--apply", tmp_path / "empty"]


def spoil_size(tmp_path: Path) -> list[object]:
    (tmp_path / "photos").mkdir()
    Image.fromarray(photo(0, 50, 50)).save(tmp_path / "photos" / "a.png")
    return ["--apply", tmp_path / "photos"]


def spoil_photo(tmp_path: Path) -> list[object]:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("no photo")
    return ["--apply", tmp_path / "photos"]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (lambda folder: ["--threshold", 1.5], "--threshold must be in (0, 1)"),
        (lambda folder: ["--camera", 0], "add --apply PHOTOS"),
        (lambda folder: ["--step", 77], "no checkpoint of step 77; there are 9"),
        (lambda folder: ["--apply", folder / "nowhere"], "is no folder"),
        (lambda folder: ["--apply", folder / "clip.MP4"], "write its frames to a folder, as by ffmpeg"),
        (spoil_nothing, "holds no photos"),
        (spoil_size, "a.png is 50 x 50"),
        (spoil_photo, "a.jpg cannot be read as a photo"),
    ],
)
def test_what_cannot_be_exported_is_refused_and_leaves_nothing(tmp_path, capsys, options, complaint):
    config = write_run(tmp_path / "run", one_camera(learned()))
    with pytest.raises(SystemExit) as caught:
        export(config, tmp_path / "out", *options(tmp_path))
    assert caught.value.code == 2
    assert complaint in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith((".", "out"))) == []


def test_foreign_and_broken_checkpoints_are_refused(tmp_path, capsys):
    for name, complaint in (
        ("nowhere", "does not exist"),
        ("empty", "holds no step-*.ckpt"),
        ("broken", "cannot be read as a checkpoint (File is not a zip file)"),
        ("nerf", "holds no Gaussian splats"),
        ("plain", "has no overlay"),
    ):
        config = write_run(tmp_path / name, None)
        path = next((tmp_path / name / "nerfstudio_models").iterdir())
        if name == "nowhere":
            config.unlink()
        elif name == "empty":
            path.unlink()
        elif name == "broken":
            path.write_bytes(path.read_bytes()[:500])
        elif name == "nerf":
            torch.save({"step": 1, "pipeline": {"_model.field.weight": torch.zeros(2)}}, path)
        with pytest.raises(SystemExit):
            export(config, tmp_path / "out")
        assert complaint in capsys.readouterr().err
