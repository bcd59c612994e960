"""Datasets of a benchmark at a resolution that the capture has no folder of."""

from __future__ import annotations

import shutil

from PIL import Image
from rich.console import Console

from ssa_nerfstudio.experiments.benchmark.execution.datasets import prepare
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Benchmark, Part, SceneEntry
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan


def test_photos_are_reduced_once(tiny_scene, tmp_path):
    scene = SceneEntry(str(tiny_scene), name="tiny", downscale=2)
    runs = plan(Benchmark((scene,), (Part(methods=("3dgs",), effects=("none",)),), name="made"))
    folder = tmp_path / "scenes"
    written = []
    for _ in range(2):
        prepare(runs, folder, tmp_path / "artifacts", 1, Console())
        photos = (folder / runs[0].dataset).rglob("*.png")
        assert {Image.open(photo).size for photo in photos} == {(32, 24)}
        shutil.rmtree(folder / runs[0].dataset)
        (reduced,) = folder.glob("*-source-div2")
        written.append({photo.name: photo.stat().st_mtime_ns for photo in reduced.rglob("*.png")})
    assert written[0] == written[1] != {}
