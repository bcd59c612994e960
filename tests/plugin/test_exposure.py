"""Exposure of the photos: the order of exposure and overlay, gradients, the projected mean, and whole trainings."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.exposure import Exposure, PhotoExposure, Place
from ssa_nerfstudio.plugin.photo_formation import predicted_photo

PLACES = ("scene", "photo")


def artifacts(dtype=torch.float64, adds_light: bool = False) -> Artifacts:
    """One overlay of 3 x 4 pixels with random parameters, of views 0 and 1; view 2 has none."""
    generator = torch.Generator().manual_seed(0)
    overlay = ScreenSpaceOverlay(3, 4, adds_light=adds_light)
    with torch.no_grad():
        for parameter in overlay.parameters():
            parameter.normal_(generator=generator)
    made = Artifacts()
    made.assign([overlay, None], torch.ones(2, 6), [0, 0, 1], torch.zeros(2, 16))
    return made.to(dtype)


def drawn(dtype=torch.float64) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {
        "rgb": torch.rand(3, 4, 3, generator=generator, dtype=dtype) * 0.6 + 0.2,
        "accumulation": torch.rand(3, 4, 1, generator=generator, dtype=dtype),
        "background": torch.rand(3, generator=generator, dtype=dtype),
    }


def exposure(place: Place, dtype=torch.float64) -> Exposure:
    made = Exposure(3)
    made.place = place
    with torch.no_grad():
        made.transforms.uniform_(-0.05, 0.05, generator=torch.Generator().manual_seed(2))
    made.project()
    return made.to(dtype)


def photo_of(*arguments: Any) -> torch.Tensor:
    """A predicted photo that differs from the clean render."""
    photo = predicted_photo(*arguments)
    assert photo is not None
    return photo


def test_the_lens_artifact_is_exposed_and_what_software_drew_is_not():
    clean, overlays = drawn(), artifacts()
    transmittance, addition = overlays[0].layers()
    for view in (0, 1):
        log_gain, offset = exposure("photo").transforms[view]
        gain = log_gain.exp()
        on_lens = photo_of(clean, overlays, exposure("photo"), view, 1, False)
        torch.testing.assert_close(on_lens, gain * (transmittance * clean["rgb"] + addition) + offset)
        by_software = photo_of(clean, overlays, exposure("scene"), view, 1, False)
        torch.testing.assert_close(by_software, transmittance * (gain * clean["rgb"] + offset) + addition)
        assert not torch.equal(on_lens, by_software)
    bare = photo_of(clean, overlays, exposure("scene"), 2, 1, False)
    log_gain, offset = exposure("scene").transforms[2]
    torch.testing.assert_close(bare, log_gain.exp() * clean["rgb"] + offset)


@pytest.mark.parametrize("ignore_background", [True, False])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("adds_light", [True, False])
def test_identity_exposure_changes_no_bit(place, ignore_background, adds_light):
    clean, overlays, identity = drawn(torch.float32), artifacts(torch.float32, adds_light), Exposure(3)
    identity.place = place
    without = photo_of(clean, overlays, None, 0, 1, ignore_background)
    assert torch.equal(photo_of(clean, overlays, identity, 0, 1, ignore_background), without.clamp(0, 1))
    assert predicted_photo(clean, overlays, None, 2, 1, ignore_background) is None
    assert predicted_photo(clean, Artifacts(), None, 0, 1, ignore_background) is None


@pytest.mark.parametrize("place", PLACES)
def test_gradients_of_render_overlay_and_exposure(place):
    clean, overlays, exposures = drawn(), artifacts(), exposure(place)
    overlay = overlays[0]
    assert isinstance(overlay, ScreenSpaceOverlay)
    rgb, transforms = clean["rgb"].requires_grad_(), exposures.transforms
    color, alpha = overlay.color_logits, overlay.alpha_logits
    photo = lambda *_: photo_of(clean, overlays, exposures, 0, 1, False)  # noqa: E731
    assert photo().min() > 0.01
    assert photo().max() < 0.99
    assert torch.autograd.gradcheck(photo, (rgb, color, alpha, transforms))
    (gradient,) = torch.autograd.grad(photo().sum(), transforms)
    assert (gradient[0] != 0).all()
    assert (gradient[1:] == 0).all()


def test_hiding_background_gains_nothing_under_any_exposure():
    """As without exposure: behind a pixel without splats, the matte has no gradient."""
    clean, overlays, exposures = drawn(), artifacts(), exposure("scene")
    clean["accumulation"] = torch.zeros(3, 4, 1, dtype=torch.float64)
    clean["rgb"] = clean["background"].expand(3, 4, 3)
    photo_of(clean, overlays, exposures, 0, 1, True).sum().backward()
    torch.testing.assert_close(overlays[0].alpha_logits.grad, torch.zeros(3, 4, 1, dtype=torch.float64))


def test_a_prediction_beyond_white_is_clipped_and_pulled_back():
    bright = PhotoExposure(torch.full((3,), 2.0), torch.zeros(3))
    image = torch.full((1, 1, 3), 0.8, requires_grad=True)
    shown = bright.expose(image)
    assert (shown == 1).all()
    (shown - 0.9).abs().sum().backward()
    assert image.grad is not None
    assert (image.grad > 0).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.floats(0, 1), st.integers(0, 2**31))
def test_the_projected_mean_is_the_identity(photos, size, seed):
    exposures = Exposure(photos)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(20):
        with torch.no_grad():
            exposures.transforms += size * torch.randn(photos, 2, 3, generator=generator) + size
        exposures.project()
    mean = exposures.transforms.detach().mean(dim=0)
    torch.testing.assert_close(mean, torch.zeros(2, 3), atol=1e-6 * (1 + size), rtol=0)
    gains = torch.stack([exposures.of_view(view).gain for view in range(photos)]).detach()
    torch.testing.assert_close(gains.log().mean(dim=0).exp(), torch.ones(3), atol=1e-5, rtol=0)


def fitted(photos: torch.Tensor, projected: bool) -> torch.Tensor:
    """A scene of one pixel a column, fitted jointly with the exposures of photos [V, N, 3], from a scene too dark."""
    exposures = Exposure(len(photos))
    scene = torch.full(photos.shape[1:], 0.2, requires_grad=True)
    optimizer = torch.optim.Adam([scene, exposures.transforms], lr=0.01)
    for step in range(1500):
        optimizer.zero_grad()
        view = step % len(photos)
        (exposures.of_view(view).expose(scene) - photos[view]).abs().mean().backward()
        optimizer.step()
        if projected:
            exposures.project()
    return scene.detach()


def test_the_scenes_brightness_does_not_drift():
    generator = torch.Generator().manual_seed(3)
    scene = torch.rand(50, 3, generator=generator) * 0.5 + 0.1
    log_gain = 0.2 * torch.randn(8, 1, 3, generator=generator)
    photos = (log_gain - log_gain.mean(dim=0)).exp() * scene
    assert abs(float(fitted(photos, projected=True).mean() - scene.mean())) < 0.01
    assert abs(float(fitted(photos, projected=False).mean() - scene.mean())) > 0.03


@pytest.fixture(scope="module")
def varying_scene(tiny_scene, tmp_path_factory) -> tuple[Path, np.ndarray]:
    """The tiny scene behind its dashboard, every photo under a gain of its own, and the logarithms of the gains."""
    folder = Path(shutil.copytree(tiny_scene, tmp_path_factory.mktemp("varying") / "scene"))
    log_gains = np.linspace(-0.3, 0.3, 12)[np.random.default_rng(0).permutation(12)]
    for log_gain, path in zip(log_gains, sorted(folder.glob("images/train_*.png")), strict=True):
        photo = np.asarray(Image.open(path)) * np.exp(log_gain)
        Image.fromarray(np.rint(photo.clip(0, 255)).astype(np.uint8)).save(path)
    return folder, log_gains


@pytest.fixture(scope="module")
def train(varying_scene, train_resumable):
    """Train on the varying scene, given settings of the model, steps, and a folder of checkpoints to resume from."""

    def run(steps: int = 40, load_dir: Path | None = None, **model):
        model = {"overlay": "on", "num_downscales": 0, "exposure": "affine", **model}
        return train_resumable(varying_scene[0], steps, model, load_dir)

    return run


@pytest.fixture(scope="module")
def trained(train):
    return train()


def test_a_training_finds_the_exposures_and_that_the_dashboard_has_them(trained, varying_scene):
    model = trained.pipeline.model
    found = model.exposure.transforms.detach().cpu()
    assert model.exposure.place == "photo"
    assert model.exposure.photos == [f"images/train_{number:04d}.png" for number in range(12)]
    wrong = found[:, 0].mean(dim=1).numpy() - varying_scene[1]
    assert np.sqrt(np.mean(wrong**2)) < 0.3 * np.sqrt(np.mean(varying_scene[1] ** 2))
    torch.testing.assert_close(found.mean(dim=0), torch.zeros(2, 3), atol=1e-6, rtol=0)


def test_test_views_are_at_the_mean_exposure(trained):
    model, pipeline = trained.pipeline.model, trained.pipeline
    pipeline.eval()
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    before = model.get_outputs_for_camera(camera)
    kept = model.exposure.transforms.data
    model.exposure.transforms.data = kept + 1
    after = model.get_outputs_for_camera(camera)
    model.exposure.transforms.data = kept
    pipeline.train()
    assert torch.equal(before["rgb"], after["rgb"])
    assert torch.equal(before["composite"], after["composite"])
    assert before["rgb"].max() <= 1


def test_the_same_training_gives_the_same_exposures(train, trained):
    again = train()
    found, expected = (trainer.pipeline.model.exposure.transforms for trainer in (again, trained))
    torch.testing.assert_close(found, expected, atol=1e-3 if found.is_cuda else 0, rtol=0)  # gsplat adds in any order


def test_off_leaves_no_trace(train):
    trainer = train(steps=1, exposure="off")
    assert trainer.pipeline.model.exposure is None
    assert not [name for name in trainer.pipeline.state_dict() if "exposure" in name]
    assert "exposure" not in trainer.optimizers.optimizers


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_a_resumed_training_goes_on_with_its_exposures(train, strategy):
    first = train(steps=12, strategy=strategy, exposure_place="scene")
    resumed = train(steps=13, load_dir=first.checkpoint_dir, strategy=strategy)
    assert resumed._start_step == 12
    then, now = (trainer.pipeline.model.exposure for trainer in (first, resumed))
    assert now.place == "scene"
    assert now.photos == then.photos
    change = (now.transforms - then.transforms).abs().max()
    assert 0 < change < 0.05


def test_a_checkpoint_of_another_setting_or_of_other_photos_is_refused(train, trained):
    with pytest.raises(InputError, match="exposure affine"):
        train(steps=45, load_dir=trained.checkpoint_dir, exposure="off")
    with pytest.raises(InputError, match="exposure acts on the photo, this run's on the scene"):
        train(steps=45, load_dir=trained.checkpoint_dir, exposure_place="scene")
    photos = trained.pipeline.model.exposure.photos
    trained.pipeline.model.exposure.photos = photos[::-1]
    trained.save_checkpoint(39)
    trained.pipeline.model.exposure.photos = photos
    with pytest.raises(InputError, match="resume with the photos"):
        train(steps=45, load_dir=trained.checkpoint_dir)


def test_a_skipped_step_leaves_the_exposures_alone(train):
    trainer = train(steps=2)
    before = trainer.pipeline.model.exposure.transforms.detach().clone()
    for optimizer in trainer.optimizers.optimizers.values():
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.full_like(parameter, torch.nan)
    trainer.optimizers.step_groups(
        list(trainer.optimizers.parameters), torch.ones((), device=trainer.device), trainer.grad_scaler
    )
    assert torch.equal(trainer.pipeline.model.exposure.transforms, before)
