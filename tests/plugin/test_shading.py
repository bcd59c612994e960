"""Shading: the light on an artifact in each photo, its start from the photos, and whole trainings with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence import artifact_light as evidence_of_light
from ssa_nerfstudio.evidence.artifact_light import artifact_light
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.shading import light, shading_basis
from ssa_nerfstudio.plugin import overlay_setup, photo_shading
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.model import SSASplatfactoModel
from ssa_nerfstudio.plugin.photo_formation import predicted_photo
from ssa_nerfstudio.plugin.photo_shading import Shading, shading_at_start

HEIGHT, WIDTH, VIEWS = 40, 60, 9


def opacity(dtype=torch.float64) -> torch.Tensor:
    """An artifact in the lower right, with a soft rim to its left."""
    made = torch.zeros(HEIGHT, WIDTH, 1, dtype=dtype)
    made[20:, 30:], made[20:, 28:30] = 1.0, 0.4
    return made


def coefficients() -> torch.Tensor:
    drawn = 0.1 * torch.randn(VIEWS, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return drawn - drawn.mean(dim=0)


def test_the_light_is_linear_over_the_artifact_and_1_where_there_is_none():
    basis = shading_basis(opacity())
    assert (light(basis, torch.ones(5, dtype=torch.float64))[:, :28] == 1).all()
    inside = basis[22:38, 32:58]
    torch.testing.assert_close(inside[..., 0], torch.ones(16, 26, dtype=torch.float64))
    steps = inside[:, 1:, 1] - inside[:, :-1, 1]
    torch.testing.assert_close(steps, steps[0, 0].expand_as(steps))
    # Rows 20 to 39: their middle is at 29.5, their deviation that of a uniform distribution.
    edge = 7.5 / (399 / 12) ** 0.5
    torch.testing.assert_close(inside[[0, -1], 0, 2], torch.tensor([-edge, edge], dtype=torch.float64))
    tinted = light(basis, torch.tensor([0.1, 0.0, -0.1, 0.0, 0.0], dtype=torch.float64))[30, 40]
    torch.testing.assert_close(tinted, torch.tensor([0.1, 0.0, -0.1], dtype=torch.float64).exp())
    assert basis.abs().max() <= np.sqrt(3) + 1e-12


@pytest.mark.parametrize("masked", [False, True])
def test_the_start_finds_the_light_on_what_is_opaque(masked):
    basis, addition = shading_basis(opacity()), opacity() * torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    scenes = torch.rand(VIEWS, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    images = [
        ((1 - opacity()) * scene + light(basis, own) * addition).float()
        for scene, own in zip(scenes, coefficients(), strict=True)
    ]
    masks: list[torch.Tensor | None] = [None] * VIEWS
    if masked:  # something else in one photo
        masks[3] = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
        masks[3][20:30] = False
        images[3] = images[3].clone()
        images[3][20:30] = 1.0
    found = artifact_light(images, masks, basis.float(), ((1 - opacity()).float(), addition.float()))
    torch.testing.assert_close(found.coefficients.mean(dim=0), torch.zeros(5), atol=1e-6, rtol=0)
    torch.testing.assert_close(found.coefficients, coefficients().float(), atol=0.03, rtol=0)
    assert found.changes


def tinted(scene: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
    """A plain scene under a light that changes in color and, from left to right, in brightness."""
    across = torch.linspace(-1, 1, WIDTH)[:, None]
    return (scene + 0.2 * own[:3] + 0.2 * own[3] * across).clamp(0, 1)


@pytest.mark.parametrize("brightness", [0.0, 0.003, 0.1])
def test_what_the_scene_explains_is_no_light(brightness):
    """A scene that comes through changes from photo to photo, too, but as much as comes through, not as is opaque."""
    made = torch.zeros(HEIGHT, WIDTH, 1)
    made[10:30, 20:40], made[12:28, 22:38] = 0.7, 0.95
    layers = 1 - made, made * torch.tensor([0.5, 0.4, 0.3])
    basis, generator = shading_basis(made), torch.Generator().manual_seed(3)
    images = []
    for number, own in enumerate(torch.randn(30, 4, generator=generator)):
        factor = light(basis, brightness * (-1) ** number * torch.tensor([1.0, 1, 1, 0, 0]))
        shown = layers[0] * tinted(torch.full((HEIGHT, WIDTH, 3), 0.5), own) + factor * layers[1]
        images.append(shown + 0.004 * torch.randn(shown.shape, generator=generator))
    found = artifact_light(images, [None] * 30, basis, layers)
    assert found.changes == (brightness == 0.1), found.explained
    if not brightness:
        assert found.coefficients.abs().max() > 0.03  # by itself it would pass for light


def test_the_start_trusts_what_lets_least_of_the_scene_through():
    """Of a core and a rim; with both alike the error would be 0.036."""
    made = torch.zeros(HEIGHT, WIDTH, 1)
    made[10:30, 10:50], made[12:28, 14:46] = 0.6, 1.0
    layers = 1 - made, made * torch.tensor([0.5, 0.4, 0.3])
    basis, gains = shading_basis(made), torch.tensor([0.1, 0.1, 0.1, 0.0, 0.0])
    own = torch.randn(30, 4, generator=torch.Generator().manual_seed(7))
    images = [
        layers[0] * tinted(torch.full((HEIGHT, WIDTH, 3), 0.5), each) + light(basis, (-1) ** view * gains) * layers[1]
        for view, each in enumerate(own)
    ]
    found = artifact_light(images, [None] * 30, basis, layers).coefficients
    expected = torch.stack([(-1) ** view * gains for view in range(30)])
    assert (found - expected)[:, :3].square().mean().sqrt() < 0.005


def box(matte: float, border: int = 10) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """The basis and the layers of an artifact of one color that leaves a border of the frame clear."""
    made = torch.zeros(HEIGHT, WIDTH, 1)
    made[border : HEIGHT - border, border : WIDTH - border] = matte
    return shading_basis(made), (1 - made, made * torch.tensor([0.5, 0.4, 0.3]))


def scenes(count: int = 30) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    plain = torch.full((HEIGHT, WIDTH, 3), 0.5)
    return [
        tinted(plain, each) + 0.004 * torch.randn(plain.shape, generator=generator)
        for each in torch.randn(count, 4, generator=generator)
    ]


def test_a_panel_of_one_color_has_a_light_though_any_scene_behind_would_do():
    """A scene that may have any brightness would explain it: 0.02 T times 2.5 of white."""
    basis, (transmittance, addition) = box(0.98)
    images = [transmittance * scene + addition * (0.1 * (-1) ** number + 1) for number, scene in enumerate(scenes())]
    assert artifact_light(images, [None] * 30, basis, (transmittance, addition)).changes


def test_light_is_explained_beside_a_scene_that_comes_through():
    """Of a soft artifact both change alike, so that neither explains alone what it has to."""
    made = torch.linspace(0.55, 0.95, WIDTH)[None, :, None].expand(HEIGHT, WIDTH, 1).clone()
    made[:10] = 0
    basis, layers = shading_basis(made), (1 - made, made * torch.tensor([0.5, 0.4, 0.3]))
    flat = torch.full((HEIGHT, WIDTH, 3), 0.5)
    images = []
    for number, own in enumerate(torch.randn(30, 4, generator=torch.Generator().manual_seed(6))):
        factor = 1 + 0.2 * basis[..., :1] * (-1) ** (number // 3)
        images.append(layers[0] * tinted(flat, 2 * own) + factor * layers[1])
    assert artifact_light(images, [None] * 30, basis, layers).explained > 0.2, "0.15 alone"


@pytest.mark.parametrize("masked", [False, True])
def test_what_masks_hide_does_not_count_as_scene(masked):
    """More comes through than T says, as far as that is uncertain. A black border would make the scene calmer."""
    basis, (transmittance, addition) = box(0.9)
    images = [(transmittance + 0.04 * (basis[..., :1] > 0)) * scene + addition for scene in scenes()]
    mask = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    if masked:
        mask[:8], mask[-8:], mask[:, :8], mask[:, -8:] = False, False, False, False
        images = [image * mask for image in images]
    found = artifact_light(images, [mask] * 30, basis, (transmittance, addition))
    assert 0.005 < found.explained < 0.04
    assert not found.changes


def test_where_no_photo_shows_the_scene_nothing_tells():
    basis, (transmittance, addition) = box(0.7, border=0)
    images = [transmittance * scene + addition for scene in scenes()]
    assert artifact_light(images, [None] * 30, basis, (transmittance, addition)).explained == 0


def test_each_overlay_has_the_light_of_its_own_photos():
    made = Artifacts()
    overlays = [ScreenSpaceOverlay(HEIGHT, WIDTH) for _ in range(2)]
    (basis, (_, addition)), generator = box(1.0), torch.Generator().manual_seed(7)
    for overlay in overlays:
        overlay.initialize(torch.tensor([0.5, 0.4, 0.3]).expand(HEIGHT, WIDTH, 3), basis[..., :1], 1 - basis[..., :1])
    groups = [0, 1, 2, 0, 1, 0, 1, 0, 1]
    made.assign([*overlays, None], torch.ones(3, 6) * torch.arange(3)[:, None], groups, torch.zeros(3, 16))
    logs = 0.1 * torch.randn(9, generator=generator)
    cache = [
        {"image": torch.where(basis[..., :1] > 0, addition * each.exp(), scene)}
        for scene, each in zip(scenes(9), logs, strict=True)
    ]
    found = shading_at_start("auto", made, list("abcdefghi"), cache, None)
    assert found is not None
    assert found.photos == list("adfhbegi")
    for rows, views in ((slice(0, 4), [0, 3, 5, 7]), (slice(4, 8), [1, 4, 6, 8])):
        expected = (logs[views] - logs[views].mean())[:, None].expand(4, 3)
        torch.testing.assert_close(found.coefficients[rows, :3].detach(), expected, atol=0.02, rtol=0)
    assert found.of_view(2) is None


def test_a_checkpoint_knows_photos_that_are_listed_twice(monkeypatch):
    extra = {"photos": ["b", "a", "a"]}
    state = {"_model.shading.coefficients": torch.rand(3, 5), "_model.shading._extra_state": extra}
    monkeypatch.setattr(photo_shading, "load_pipeline_state", lambda path: state)
    found = shading_at_start("auto", artifacts()[0], ["a", "a", "b"], None, Path("x.ckpt"))
    assert found is not None
    assert found.photos == ["b", "a", "a"]
    extra["photos"] = ["b", "a", "a", "a"]
    with pytest.raises(InputError, match="the shading of 4 photos, and 1 of them is missing"):
        shading_at_start("auto", artifacts()[0], ["a", "a", "b"], None, Path("x.ckpt"))


def test_gradients_of_several_steps_add_up():
    own = shading()
    for view in (0, 1, 1):
        own.add_gradient(view, torch.ones(5).double())
    assert own.coefficients.grad is not None
    torch.testing.assert_close(own.coefficients.grad, torch.tensor([[1.0], [2]]).double().expand(2, 5))
    own.coefficients.grad = None
    own.add_gradient(0, torch.ones(5).double())
    gradient = own.coefficients.grad
    assert gradient is not None
    assert not gradient[1].any()


def test_of_a_spot_the_scene_passes_for_light():
    """Of a spot five coefficients explain much of whatever comes through, so there is none."""
    generator = torch.Generator().manual_seed(4)
    for size, changes in ((6, False), (24, True)):
        made = torch.zeros(HEIGHT, WIDTH, 1)
        made[8 : 8 + size, 20 : 20 + size] = 0.98
        layers, basis = (1 - made, made * torch.tensor([0.5, 0.4, 0.3])), shading_basis(made)
        own = 0.1 * torch.randn(20, generator=generator)
        images = [layers[1] * each.exp() + 0.5 * layers[0] for each in own]
        found = artifact_light(images, [None] * 20, basis, layers)
        assert found.explained > 0.9
        assert found.changes == changes


def test_without_an_opaque_pixel_the_light_is_the_same_everywhere():
    basis = shading_basis(0.4 * opacity(torch.float32))
    images = [torch.rand(HEIGHT, WIDTH, 3) for _ in range(VIEWS)]
    found = artifact_light(images, [None] * VIEWS, basis, (torch.rand(HEIGHT, WIDTH, 1), torch.rand(HEIGHT, WIDTH, 3)))
    assert not found.coefficients.any()
    assert not found.changes
    assert not shading_basis(torch.zeros(3, 4, 1)).any()


def artifacts(adds_light: bool = False) -> tuple[Artifacts, ScreenSpaceOverlay]:
    """An overlay of 3 x 4 pixels with random parameters, of views 0 and 1; view 2 has none."""
    generator = torch.Generator().manual_seed(0)
    overlay = ScreenSpaceOverlay(3, 4, adds_light=adds_light)
    with torch.no_grad():
        for parameter in overlay.parameters():
            parameter.normal_(generator=generator)
        overlay.evidence.uniform_(generator=generator)
    made = Artifacts()
    made.assign([overlay, None], torch.ones(2, 6), [0, 0, 1], torch.zeros(2, 16))
    return made.double(), overlay


def shading() -> Shading:
    drawn = 0.4 * torch.rand(2, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.2
    return Shading({0: 0, 1: 0}, ["a", "b", "c"], drawn)


def photo_light(view: int, own: Shading, overlay: ScreenSpaceOverlay) -> torch.Tensor | None:
    coefficients = own.of_view(view)
    return None if coefficients is None else own.light(view, coefficients, overlay, 1)


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("ignore_background", [False, True])
def test_the_photos_light_falls_on_the_artifact_alone(adds_light, ignore_background):
    made, overlay = artifacts(adds_light)
    own, (transmittance, addition) = shading(), overlay.layers()
    drawn = {
        "rgb": 0.5 * torch.rand(3, 4, 3).double(),
        "accumulation": torch.ones(3, 4, 1),
        "background": torch.zeros(3),
    }
    for view in (0, 1):
        factor = light(shading_basis(1 - overlay.evidence), own.coefficients[view])
        photo = predicted_photo(drawn, made, None, view, 1, ignore_background, photo_light(view, own, overlay))
        torch.testing.assert_close(photo, (transmittance * drawn["rgb"] + factor * addition).clamp(0, 1))
    assert own.of_view(2) is None


def test_the_gradient_is_of_the_photo_that_is_shown():
    made, overlay = artifacts()
    own = shading()
    drawn = {
        "rgb": 0.5 * torch.rand(3, 4, 3).double(),
        "accumulation": torch.ones(3, 4, 1),
        "background": torch.zeros(3),
    }

    def photo(*_) -> torch.Tensor:
        shown = predicted_photo(drawn, made, None, 1, 1, False, photo_light(1, own, overlay))
        assert shown is not None
        return shown

    assert photo().max() < 1
    assert torch.autograd.gradcheck(photo, (own.coefficients, overlay.color_logits, overlay.alpha_logits))
    (gradient,) = torch.autograd.grad(photo().sum(), own.coefficients)
    assert (gradient[1] != 0).all()
    assert not gradient[0].any()


def test_each_overlay_has_the_mean_light_of_its_photos():
    own = Shading({4: 0, 2: 1, 0: 0}, list("abcde"), torch.rand(3, 5, dtype=torch.float64))
    before = own.coefficients.detach().clone()
    own.project()
    assert own.photos == ["e", "c", "a"]
    torch.testing.assert_close(own.coefficients[[0, 2]].mean(dim=0), torch.zeros(5).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(own.coefficients[0] - own.coefficients[2], before[0] - before[2])
    assert not own.coefficients[1].any()  # alone with its overlay


@pytest.fixture(scope="module")
def panel(composited_layers):
    matte = np.zeros((48, 64), np.float32)
    matte[30:] = 0.98
    return composited_layers(matte, np.full((48, 64, 3), [0.5, 0.35, 0.3], np.float32))


@pytest.fixture(scope="module")
def varying_scene(write_built_in_scene, panel, tmp_path_factory) -> tuple[Path, np.ndarray]:
    """The built-in scene behind a panel, under another light in every photo, and the logarithms of its brightness."""
    folder = tmp_path_factory.mktemp("shaded") / "scene"
    write_built_in_scene(folder, panel, views=12, test_views=3, width=64, height=48)
    logs = np.linspace(-0.15, 0.15, 12)[np.random.default_rng(0).permutation(12)]
    for brightness, path in zip(logs, sorted(folder.glob("images/train_*.png")), strict=True):
        photo = np.asarray(Image.open(path)) / 255 + (np.exp(brightness) - 1) * panel.addition
        Image.fromarray(np.rint(255 * photo.clip(0, 1)).astype(np.uint8)).save(path)
    return folder, logs


@pytest.fixture(scope="module")
def train(varying_scene, train_resumable):
    """Train on the varying scene, given settings of the model, steps, and a folder of checkpoints to resume from."""

    def run(steps: int = 30, load_dir: Path | None = None, **model):
        model = {"overlay": "on", "num_downscales": 0, **model}
        return train_resumable(varying_scene[0], steps, model, load_dir)

    return run


@pytest.fixture(scope="module")
def trained(train):
    return train()


def test_a_training_finds_the_light(trained, varying_scene):
    found = trained.pipeline.model.shading.coefficients.detach().cpu()
    torch.testing.assert_close(found.mean(dim=0), torch.zeros(5), atol=1e-6, rtol=0)
    logs = varying_scene[1]
    assert np.corrcoef(found[:, :3].mean(dim=1).numpy(), logs)[0, 1] > 0.95


def test_of_many_photos_some_tell_and_all_have_a_light(train, monkeypatch):
    monkeypatch.setattr(evidence_of_light, "MAX_VIEWS", 5)
    assert len(train(steps=1).pipeline.model.shading.photos) == 12
    asked = []
    found = artifact_light

    def unchanging(images, *others):
        asked.append(len(images))
        return replace(found(images, *others), explained=0.0)

    monkeypatch.setattr(evidence_of_light, "artifact_light", unchanging)
    assert train(steps=1).pipeline.model.shading is None
    assert asked == [4, 4], "for a second estimate, and for the light"


def test_it_explains_the_photos_of_the_artifact(trained, train):
    def error(trainer) -> float:
        pipeline, errors = trainer.pipeline, []
        photos, cameras = pipeline.datamanager.cached_train, pipeline.datamanager.train_dataset.cameras
        for view, photo in enumerate(photos):
            camera = cameras[view : view + 1].to(pipeline.device)
            camera.metadata = {"cam_idx": view}
            outputs = pipeline.model.get_outputs(camera)
            shown = outputs["composite"].detach().cpu() - photo["image"].cpu()[..., :3] / 255
            errors.append(float(shown[32:].square().mean()))
        return float(np.mean(errors))

    assert error(trained) < 0.3 * error(train(shading="off"))


def test_other_views_have_the_mean_light(trained):
    model, pipeline = trained.pipeline.model, trained.pipeline
    pipeline.eval()
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    outputs, (transmittance, addition) = model.get_outputs_for_camera(camera), model.artifacts[0].layers()
    pipeline.train()
    torch.testing.assert_close(outputs["composite"], (transmittance * outputs["rgb"] + addition).detach())
    torch.testing.assert_close(outputs["overlay_rgb"] * outputs["overlay_alpha"], addition.detach())


def test_off_leaves_no_trace(train):
    trainer = train(steps=1, shading="off")
    assert trainer.pipeline.model.shading is None
    assert not [name for name in trainer.pipeline.state_dict() if "shading" in name]
    assert "shading" not in trainer.optimizers.optimizers


def test_a_light_that_is_the_same_in_all_photos_is_not_learned(train_resumable, write_built_in_scene, panel, tmp_path):
    write_built_in_scene(tmp_path / "scene", panel, views=12, test_views=3, width=64, height=48)
    trainer = train_resumable(tmp_path / "scene", 1, {"overlay": "on", "num_downscales": 0})
    assert trainer.pipeline.model.shading is None
    assert "shading" not in trainer.optimizers.optimizers


@pytest.mark.parametrize("may_move", [False, True])
@pytest.mark.parametrize(
    ("model", "times"), [({}, 1), ({"shading": "affine"}, 1), ({"shading": "off"}, 0), ({"exposure": "affine"}, 0)]
)
def test_the_start_is_estimated_again_where_there_may_be_shading(train, monkeypatch, model, times, may_move):
    seen, unlike = [], []

    def estimate_again(overlay, found, samples, *others):
        seen.append(samples)
        return "again"

    def refine(overlay, found, second, static):
        assert second == "again"
        return "second", may_move

    monkeypatch.setattr(overlay_setup, "second_estimate", estimate_again)
    monkeypatch.setattr(overlay_setup, "refine_in_mean_light", refine)
    monkeypatch.setattr(overlay_setup, "ignore_changing", lambda *given: unlike.append(given[1:]))
    train(steps=1, **model)
    assert len(seen) == times
    (found, moving), *more = unlike
    assert not more
    assert moving is (seen[0] if may_move and times else None)
    assert found == "second" or not times


def test_photos_of_varying_exposure_do_not_tell(train):
    assert train(steps=1, exposure="affine").pipeline.model.shading is None
    assert train(steps=1, exposure="affine", shading="affine").pipeline.model.shading is not None


def test_nothing_is_shaded_where_no_overlay_is_learned(train):
    trainer = train(steps=1, overlay="off")
    assert trainer.pipeline.model.shading is None
    assert "shading" not in trainer.optimizers.optimizers


def test_it_says_so_where_the_artifact_hides_nothing_as_it_starts(train, capsys):
    assert train(steps=1, shading="affine", overlay_start="constant").pipeline.model.shading is None
    assert "it has the same light in all photos" in capsys.readouterr().out


def test_what_hides_beside_light_that_is_added_is_shaded(train):
    assert train(steps=1, shading="affine", overlay_light="on").pipeline.model.shading is not None


@pytest.mark.parametrize("downscale", [2, 4])
def test_a_coarser_overlay_and_reduced_photos_have_the_same_light(train, varying_scene, downscale):
    trainer = train(steps=3, overlay_downscale=downscale, num_downscales=1)
    found = trainer.pipeline.model.shading.coefficients.detach().cpu()
    assert np.corrcoef(found[:, :3].mean(dim=1).numpy(), varying_scene[1])[0, 1] > 0.95


def test_a_resumed_training_goes_on_with_it(train):
    first = train(steps=12)
    resumed = train(steps=13, load_dir=first.checkpoint_dir)
    assert resumed._start_step == 12
    then, now = (trainer.pipeline.model.shading for trainer in (first, resumed))
    assert now.photos == then.photos
    change = (now.coefficients - then.coefficients).abs().max()
    assert 0 < change < 0.02


def test_a_checkpoint_of_another_setting_or_of_other_photos_is_refused(train, trained):
    with pytest.raises(InputError, match="the checkpoint has a shading"):
        train(steps=35, load_dir=trained.checkpoint_dir, shading="off")
    without = train(steps=1, shading="off").checkpoint_dir
    with pytest.raises(InputError, match="the checkpoint has no shading"):
        train(steps=35, load_dir=without, shading="affine")
    assert train(steps=3, load_dir=without).pipeline.model.shading is None
    own = trained.pipeline.model.shading
    photos = own.photos
    own.photos = [*photos[:-1], "images/another.png"]
    trained.save_checkpoint(29)
    own.photos = photos
    with pytest.raises(InputError, match="the shading of 12 photos, and 1 of them is missing"):
        train(steps=35, load_dir=trained.checkpoint_dir)
    trained.save_checkpoint(29)


def test_a_run_with_it_can_be_rendered(trained):
    from nerfstudio.utils.eval_utils import eval_setup

    _, pipeline, _, _ = eval_setup(trained.config.get_base_dir() / "config.yml", test_mode="test")
    model = pipeline.model
    assert isinstance(model, SSASplatfactoModel)
    assert model.shading is None
    assert len(model.artifacts) == 1
