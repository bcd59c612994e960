"""Hard cases of whole trainings: everything stays finite, and what a user could meet has a sane result."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hard_cases import Case, Family
from PIL import Image
from plyfile import PlyData

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.model import SSASplatfactoModel

TRAINING = Family("Whole training")
SIDE = (48, 64)
Edit = Callable[[Path], None]


@dataclass
class Trainings:
    """What a case trains with, from the experiments, and the folder that it works in."""

    folder: Path
    configure: Callable
    train_and_evaluate: Callable
    write_scene: Callable[..., Path]
    composited: Callable[..., Any]

    def dataset(self, covered: float = 0.0, edit: Edit | None = None, views: int = 8) -> Path:
        """A small capture behind an opaque orange over a share of the frame, from below, changed by `edit`."""
        artifact = None
        if covered:
            matte = np.zeros(SIDE, np.float32)
            matte[round(SIDE[0] * (1 - covered)) :] = 1
            artifact = self.composited(matte, np.array([0.9, 0.5, 0.1], np.float32))
        size = {"width": SIDE[1], "height": SIDE[0]}
        data = self.write_scene(self.folder / "scene", artifact, views=views, test_views=2, **size)
        if edit is not None:
            edit(data)
        return data

    def train(
        self, data: Path, steps: int = 25, method: str = "ssa-splatfacto", rates: float = 1.0, auto_scale=True, **model
    ):
        """Train and check that everything stayed finite: the loss of a step after it all, parameters, metrics."""
        config = self.configure(method, data, self.folder / "runs", steps, {"num_downscales": 0, **model})
        config.pipeline.datamanager.dataparser.auto_scale_poses = auto_scale
        config.pipeline.model.max_skipped_steps = 1  # a single skipped step is a failure here
        for entry in config.optimizers.values():
            entry["optimizer"].lr *= rates
            if entry["scheduler"] is not None and entry["scheduler"].lr_final is not None:
                entry["scheduler"].lr_final *= rates
        outcome, pipeline, _ = self.train_and_evaluate(config)
        assert all(torch.isfinite(loss) for loss in pipeline.train().get_train_loss_dict(steps)[1].values())
        for name, parameter in pipeline.model.named_parameters():
            assert torch.isfinite(parameter).all(), name
        finite = {name: value for name, value in outcome.metrics.items() if not name.endswith("_std")}
        assert all(np.isfinite(value) for value in finite.values()), finite
        assert pipeline.model.num_points > 0
        return outcome, pipeline.model


def repaint(value: int) -> Edit:
    def edit(folder: Path) -> None:
        for path in (folder / "images").iterdir():
            Image.fromarray(np.full((*SIDE, 3), value, np.uint8)).save(path)

    return edit


def transforms(change: Callable[[dict[str, Any]], None]) -> Edit:
    def edit(folder: Path) -> None:
        path = folder / "transforms.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return edit


def scaled(factor: float) -> Edit:
    """The whole world times a factor: cameras and points."""

    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= factor

    def edit(folder: Path) -> None:
        transforms(change)(folder)
        points(lambda xyz: xyz * factor)(folder)

    return edit


def points(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """The points the dataset starts from, [N, 3], changed."""

    def edit(folder: Path) -> None:
        path = folder / "sparse_pc.ply"
        ply = PlyData.read(str(path))
        vertex = ply["vertex"]
        xyz = change(np.stack([vertex[axis] for axis in "xyz"], axis=1))
        vertex.data = vertex.data[: len(xyz)].copy()
        for axis, values in zip("xyz", xyz.T, strict=True):
            vertex.data[axis] = values
        ply.write(str(path))

    return edit


def same_pose(content: dict[str, Any]) -> None:
    for frame in content["frames"]:
        frame["transform_matrix"] = content["frames"][0]["transform_matrix"]


def two_views(content: dict[str, Any]) -> None:
    content["train_filenames"] = content["train_filenames"][:2]


def same_photo(folder: Path) -> None:
    paths = sorted((folder / "images").iterdir())
    for path in paths[1:]:
        path.write_bytes(paths[0].read_bytes())


def matte_of(model: SSASplatfactoModel) -> torch.Tensor:
    return model.artifacts.learned()[0].matte().detach()[..., 0]


for _share in (1.0, 0.6, 0.3):
    for _overlay in ("on", "off"):

        @TRAINING.case(
            f"an opaque artifact over {_share:.0%} of the frame, overlay {_overlay}",
            "Behind it the scene loses its gradient, or all of it dies.",
            _share,
            _overlay,
        )
        def _covered(share: float, overlay: str, runs: Trainings) -> None:
            _, model = runs.train(runs.dataset(share), overlay=overlay)
            if overlay == "on":
                boundary = round(SIDE[0] * (1 - share))
                assert matte_of(model)[boundary + 1 :].mean() > 0.9
                assert boundary == 0 or matte_of(model)[: max(1, boundary - 1)].mean() < 0.5


@TRAINING.case("black photos", "Colors of 0, an SSIM of 0 over 0, a mean of 0.", 0)
@TRAINING.case("white photos", "Colors of 1, and a background that explains everything.", 255)
def _flat(value: int, runs: Trainings) -> None:
    outcome, _ = runs.train(runs.dataset(edit=repaint(value)), overlay="on")
    assert outcome.metrics["composite_psnr"] > 15


@TRAINING.case(
    "one photo from every side", "Everything is static: all of it is artifact, and nothing is left to be scene."
)
def _(runs: Trainings) -> None:
    _, model = runs.train(runs.dataset(edit=same_photo))
    assert matte_of(model).mean() > 0.9


@TRAINING.case("two views", "The fewest there can be.")
def _(runs: Trainings) -> None:
    runs.train(runs.dataset(edit=transforms(two_views)))


@TRAINING.case("poses all equal", "Normalising the scene divides by the largest distance of a camera, 0.")
def _(runs: Trainings) -> None:
    with pytest.raises(InputError, match="all cameras are in one place"):
        runs.train(runs.dataset(edit=transforms(same_pose)))


@TRAINING.case("cameras a millionth apart", "The cameras' extent is next to 0, and sizes are measured in it.")
def _(runs: Trainings) -> None:
    def change(content: dict[str, Any]) -> None:
        same_pose(content)
        content["frames"] = json.loads(json.dumps(content["frames"]))
        for number, frame in enumerate(content["frames"]):
            frame["transform_matrix"][0][3] += 1e-6 * number

    runs.train(runs.dataset(edit=transforms(change)), method="ssa-splatfacto-paper")


for _factor in (1e-3, 1e3):

    @TRAINING.case(f"a scene of {_factor:g} times the size", "Normalising it must give the usual scene.", _factor)
    def _world(factor: float, runs: Trainings) -> None:
        outcome, _ = runs.train(runs.dataset(edit=scaled(factor)))
        assert outcome.metrics["psnr"] > 10

    @TRAINING.case(
        f"a scene of {_factor:g} times the size, not normalized",
        "Depths below the near plane, or steps a thousandth of what they should be.",
        _factor,
    )
    def _raw(factor: float, runs: Trainings) -> None:
        runs.train(runs.dataset(edit=scaled(factor)), auto_scale=False)


for _method in ("ssa-splatfacto", "ssa-splatfacto-mcmc"):
    for _overlay in ("on", "off"):

        @TRAINING.case(
            f"learning rates times ten, {_method}, overlay {_overlay}",
            "Scales and opacities run away.",
            _method,
            _overlay,
        )
        def _fast(method: str, overlay: str, runs: Trainings) -> None:
            runs.train(runs.dataset(0.3), 40, method, rates=10, overlay=overlay)


@TRAINING.case(
    "points all in one place", "No distance to a neighbor: a log scale of minus infinity.", lambda xyz: 0 * xyz
)
@TRAINING.case("two points", "Fewer than the neighbors that a size is made of.", lambda xyz: xyz[:2])
@TRAINING.case("a single point", "No neighbor at all.", lambda xyz: xyz[:1])
@TRAINING.case(
    "points that are not finite",
    "One NaN spoils the search for neighbors.",
    lambda xyz: np.where(np.arange(len(xyz))[:, None] % 7 == 0, np.nan, xyz),
)
@TRAINING.case(
    "a point 1e6 away",
    "Its size is 1e6, and the others' depths lose their digits.",
    lambda xyz: np.where(np.arange(len(xyz))[:, None] == 0, 1e6, xyz),
)
def _points(change: Callable[[np.ndarray], np.ndarray], runs: Trainings) -> None:
    runs.train(runs.dataset(edit=points(change)), num_random=500)


@TRAINING.case("no points", "Nothing to start from.")
def _(runs: Trainings) -> None:
    with pytest.raises(InputError, match="it holds no points"):
        runs.train(runs.dataset(edit=points(lambda xyz: xyz[:0])))


@TRAINING.case("photos smaller than SSIM's window", "Reduced photos have no window left.")
def _(runs: Trainings) -> None:
    data = runs.write_scene(runs.folder / "scene", views=6, test_views=2, width=40, height=30)
    model = {"num_downscales": 2, "resolution_schedule": 30_000}
    _, pipeline, _ = runs.train_and_evaluate(runs.configure("ssa-splatfacto", data, runs.folder / "runs", 10, model))
    assert all(torch.isfinite(p).all() for p in pipeline.model.parameters())


for _overlay in ("on", "off"):

    @TRAINING.case(
        f"MCMC that starts below its smallest opacity, overlay {_overlay}",
        "Everything is dead at the first relocation.",
        _overlay,
    )
    def _(overlay: str, runs: Trainings) -> None:
        runs.train(
            runs.dataset(), 40, "ssa-splatfacto-mcmc", overlay=overlay, mcmc_opacity_start=0.002,
            warmup_length=1,
        )  # fmt: skip


for _guards in (True, False):
    for _overlay in ("on", "off"):

        @TRAINING.case(
            f"MCMC behind a dashboard on fox, overlay {_overlay}, guards {'on' if _guards else 'off'}",
            "The paper's baseline diverges there.",
            _overlay,
            _guards,
            slow=True,
        )
        def _fox(overlay: str, guards: bool, runs: Trainings) -> None:
            import os

            from ssa_nerfstudio.cli import main

            folder, capture = runs.folder, Path(os.environ.get("SSA_DATA", "data")) / "fox"
            if not capture.exists():
                pytest.skip("set SSA_DATA to the folder of real captures")
            main(["simulate", "--data", str(capture), "--output", str(folder / "fox"), "--effects", "dashboard"])
            model = {"overlay": overlay, "guards": guards, "num_downscales": 0, "cap_max": 20_000}
            config = runs.configure("ssa-splatfacto-mcmc", folder / "fox", folder / "runs", 1000, model, 0.125)
            outcome, pipeline, _ = runs.train_and_evaluate(config)
            assert all(torch.isfinite(p).all() for p in pipeline.model.parameters())
            assert torch.exp(pipeline.model.scales).max() < 100
            assert np.isfinite(outcome.metrics["psnr"])


@TRAINING.parametrize
def test_whole_training(
    case: Case, tmp_path: Path, configure_training, train_and_evaluate, write_built_in_scene, composited_layers
) -> None:
    case.check(Trainings(tmp_path, configure_training, train_and_evaluate, write_built_in_scene, composited_layers))
