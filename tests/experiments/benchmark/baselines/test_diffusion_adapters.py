"""Difix3D+ and FLUX.1 Kontext with diffusers' own classes and tiny random weights that the tests make."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from baselines.training import photos_of, train
from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.data.dataset import View
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.baselines import diffusion_weights, difix3d, flux_kontext
from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Capture
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS
from ssa_nerfstudio.plugin.methods import METHODS

pytest.importorskip("diffusers", reason="pip install '.[diffusion]'")


@pytest.fixture(scope="module")
def difix(tmp_path_factory) -> Path:
    from baselines.tiny_diffusion import save_difix

    return save_difix(tmp_path_factory.mktemp("difix"))


@pytest.fixture(scope="module")
def flux(tmp_path_factory) -> dict[str, Any]:
    from baselines.tiny_diffusion import save_flux

    weights = save_flux(tmp_path_factory.mktemp("flux"))
    return {"weights": str(weights), "area": 64 * 48, "restoration_steps": 2, "batch": 3}


def test_difix_enhances_test_renders_of_any_size_with_the_nearest_photo(capture, difix, tmp_path, monkeypatch):
    _, pipeline = train("difix3d", capture("clean"), tmp_path, 4, weights=str(difix), area=96 * 64)
    model: Any = pipeline.model
    model.eval()
    camera = pipeline.datamanager.train_dataset.cameras[5:6]
    enhance = type(model).enhance
    drawn = model.get_outputs(camera)
    assert drawn["rgb"].shape == drawn["rendered"].shape == (48, 64, 3)
    assert not torch.allclose(drawn["rgb"], drawn["rendered"], atol=0.02)
    assert torch.equal(drawn["rgb"], enhance(model, drawn["rendered"], 5))
    code = next(module for name, module in sys.modules.items() if name.endswith("pipeline_difix"))
    assert code.DifixPipeline.asked == ("remove degradation", (88, 64), (88, 64), 1, [199], 0.0)
    shown: list[int] = []
    monkeypatch.setattr(type(model), "enhance", lambda self, render, nearest: shown.append(nearest) or render)
    model.get_outputs(camera)
    assert shown == [5]  # its own photo is the nearest
    model.config.reference = False  # as the weights of nvidia/difix want it
    enhance(model, drawn["rendered"], 5)
    assert code.DifixPipeline.asked == ("remove degradation", (88, 64), None, 1, [199], 0.0)


def test_the_reference_looks_where_the_render_does():
    turn = torch.tensor([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])  # half a turn about the vertical
    here, aside = torch.zeros(3, 1), torch.tensor([[1.0], [0.0], [0.0]])
    poses = torch.stack([torch.cat([turn, here], 1), torch.cat([torch.eye(3), aside], 1)])
    found = difix3d.pose_distances(poses, torch.cat([torch.eye(3), here], 1))
    torch.testing.assert_close(found, torch.tensor([torch.pi, 1.0]))


def test_difix_does_not_touch_training(capture, difix, tmp_path):
    _, enhanced = train("difix3d", capture("clean"), tmp_path / "a", 4, weights=str(difix), area=96 * 64)
    _, plain = train("3dgs", capture("clean"), tmp_path / "b", 4)
    assert torch.equal(enhanced.model.means, plain.model.means)


def restored(folder: Path) -> list[np.ndarray]:
    return [np.array(Image.open(path)) for path in photos_of(folder)]


def test_flux_restores_every_training_photo_and_leaves_the_rest(capture, flux, tmp_path):
    source = capture("dashboard")
    flux_kontext.write_dataset(Capture(source, "dashboard", None, flux), tmp_path / "restored")
    assert [photo.shape for photo in restored(tmp_path / "restored")] == [(48, 64, 3)] * 24
    before, after = (json.loads((f / "transforms.json").read_text()) for f in (source, tmp_path / "restored"))
    assert after["test_filenames"] == before["test_filenames"]
    assert [frame["transform_matrix"] for frame in after["frames"]] == [f["transform_matrix"] for f in before["frames"]]
    record = json.loads((tmp_path / "restored" / "restoration.json").read_text())
    assert record["prompt"] == "remove the car dashboard occluding the view"
    assert record["seconds"] > 0


def test_flux_is_asked_with_the_papers_guidance_and_steps_and_one_seed(capture, flux, tmp_path, monkeypatch):
    from diffusers.pipelines.flux.pipeline_flux_kontext import FluxKontextPipeline

    plain, asked = FluxKontextPipeline.__call__, []

    def call(self, **arguments):
        asked.append(arguments)
        return plain(self, **arguments)

    monkeypatch.setattr(FluxKontextPipeline, "__call__", call)
    settings = {**flux, "batch": 24, "generator_seed": 3, "prompt": "remove the car"}
    flux_kontext.write_dataset(Capture(capture("dashboard"), "dashboard", None, settings), tmp_path / "restored")
    (arguments,) = asked
    assert (arguments["guidance_scale"], arguments["num_inference_steps"]) == (2.5, 2)
    assert (arguments["width"], arguments["height"], arguments["max_area"]) == (64, 48, 64 * 48)
    assert arguments["prompt"] == ["remove the car"] * 24
    assert [generator.initial_seed() for generator in arguments["generator"]] == [3] * 24
    assert flux_kontext.RestoredConfig().restoration_steps == 28


def test_an_instruction_that_a_candidate_states_is_the_one_that_is_asked(tmp_path):
    """nerfstudio's models have a setting of that name, too, which is None."""
    stated = "{method: flux-kontext, weights: somebody/weights, prompt: remove the %s}"
    (tmp_path / "a.yaml").write_text(
        f"scenes: [{{data: demo}}]\ncandidates: {{car: {stated % 'car'}, rain: {stated % 'rain'}}}\n"
        "parts: [{methods: [car, rain], effects: [mud], steps: 5}]"
    )
    asked = []
    baseline = dataclasses.replace(
        flux_kontext.BASELINE, dataset=lambda capture, made: asked.append((capture.settings["prompt"], made))
    )
    for run in plan(read_benchmark(str(tmp_path / "a.yaml"))):
        baseline.make_dataset(run, tmp_path / "data", tmp_path / "mask.png")
    (car, first), (rain, second) = asked
    assert (car, rain) == ("remove the car", "remove the rain")
    assert first != second
    config = copy.deepcopy(METHODS["ssa-splatfacto"])
    baseline.adapt(config)
    assert vars(config.pipeline.model)["prompt"] == ""


def test_a_batch_has_photos_of_one_size_alone():
    lenses = [Lens(*size, 50.0, 50.0, 32.0, 24.0) for size in ((64, 48), (48, 64), (64, 48), (64, 48))]
    views = [(number, View(f"{number}.png", "train", lens, ())) for number, lens in enumerate(lenses)]
    found = [[number for number, _ in batch] for batch in flux_kontext.batches(views, 2)]
    assert found == [[0, 2], [3], [1]]


def test_every_simulated_artifact_has_an_instruction_of_its_own():
    assert len({flux_kontext.PROMPTS[name] for name in EFFECTS}) == len(EFFECTS)


def test_flux_goes_on_where_it_was_interrupted_with_the_same_result(capture, flux, tmp_path, monkeypatch):
    made = Capture(capture("dashboard"), "dashboard", None, flux)
    flux_kontext.write_dataset(made, tmp_path / "whole")
    resized_back, done = flux_kontext.resized_back, []

    def interrupted(*arguments):
        done.append(arguments)
        if len(done) > 5:
            raise KeyboardInterrupt
        return resized_back(*arguments)

    monkeypatch.setattr(flux_kontext, "resized_back", interrupted)
    with pytest.raises(KeyboardInterrupt):
        flux_kontext.write_dataset(made, tmp_path / "part")
    assert not (tmp_path / "part").exists()
    assert len(list((tmp_path / ".part.restored").glob("*.png"))) == 5
    monkeypatch.undo()
    flux_kontext.write_dataset(made, tmp_path / "part")
    assert json.loads((tmp_path / "part" / "restoration.json").read_text())["photos"] == 24 - 5
    for ours, theirs in zip(restored(tmp_path / "part"), restored(tmp_path / "whole"), strict=True):
        # Other photos share a batch, which rounds differently.
        np.testing.assert_allclose(ours.astype(int), theirs.astype(int), atol=2)


def test_flux_trains_3dgs_on_what_it_restored(capture, flux, tmp_path):
    outcome, pipeline = train("flux-kontext", capture("dashboard"), tmp_path, 4, **flux)
    assert "restored" in str(pipeline.datamanager.train_dataset.image_filenames[0])
    assert outcome.metrics["psnr"] > 5


@pytest.mark.parametrize("content", ["nothing", "no folder", "a broken index"])
def test_a_folder_that_holds_no_weights_is_refused_in_one_line(tmp_path, content):
    folder = tmp_path / "weights"
    if content != "no folder":
        folder.mkdir()
    if content == "a broken index":
        (folder / "model_index.json").write_text("{")
    with pytest.raises(InputError, match=re.escape(flux_kontext.WEIGHTS)) as refusal:
        diffusion_weights.load(
            str(folder), flux_kontext.WEIGHTS, torch.device("cpu"), False, torch.float32, "FluxKontextPipeline"
        )
    assert "\n" not in str(refusal.value)


def test_too_little_memory_is_one_line_with_a_remedy():
    with (
        pytest.raises(InputError, match="too little memory for flux; set offload"),
        diffusion_weights.enough_memory("flux"),
    ):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")


@pytest.mark.parametrize(("width", "height"), [(960, 720), (540, 960), (848, 480), (64, 48)])
def test_a_pipeline_gets_the_aspect_of_the_photo_at_its_own_resolution(width, height):
    fitted = diffusion_weights.fitted(width, height, 576 * 1024, 16)
    assert all(side % 16 == 0 for side in fitted)
    assert fitted[0] * fitted[1] == pytest.approx(576 * 1024, rel=0.04)
    assert fitted[0] / fitted[1] == pytest.approx(width / height, rel=0.03)
