"""Splats as PLY: nerfstudio's bytes, and a compressed form that decodes to the same splats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from mutations import OFTEN, one_line
from nerfstudio.scripts.exporter import ExportGaussianSplat
from plyfile import PlyData
from small_checkpoints import random_gaussians, write_run

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.checkpoint import Checkpoint


def export(config: Path, output: Path, *options: object) -> Path:
    main(["export-splats", "--load-config", str(config), "--output-dir", str(output), *map(str, options)])
    return output / "splat.ply"


@pytest.fixture(scope="module", params=[3, 0], ids=["harmonics", "plain-colors"])
def run(request, tiny_scene, tmp_path_factory, configure_training, train_and_evaluate) -> Path:
    """A trained run, some of whose Gaussians no exporter may write."""
    folder = tmp_path_factory.mktemp("run")
    model = {"num_downscales": 0, "sh_degree": request.param}
    _, _, config = train_and_evaluate(configure_training("ssa-splatfacto", tiny_scene, folder, 2, model))
    path = next((config.parent / "nerfstudio_models").iterdir())
    saved = torch.load(path)
    state = saved["pipeline"]
    state["_model.gauss_params.quats"][3, 1] = float("nan")
    state["_model.gauss_params.scales"][5, 0] = float("inf")
    state["_model.gauss_params.opacities"][7:20] = -6.0
    state["_model.gauss_params.opacities"][21] = -5.5373
    torch.save(saved, path)
    return config


@pytest.mark.parametrize("colors", ["sh_coeffs", "rgb"])
def test_the_bytes_are_nerfstudios(run, tmp_path, colors):
    ExportGaussianSplat(load_config=run, output_dir=tmp_path / "theirs", ply_color_mode=colors).main()
    ours = export(run, tmp_path / "ours", "--ply-color-mode", colors)
    assert ours.read_bytes() == (tmp_path / "theirs" / "splat.ply").read_bytes()


def test_a_box_crops_as_nerfstudios_does(run, tmp_path):
    box: dict[str, Any] = {
        "obb_center": (0.1, 0.0, -0.1),
        "obb_rotation": (0.1, 0.2, 0.3),
        "obb_scale": (0.8, 0.9, 0.7),
    }
    ExportGaussianSplat(load_config=run, output_dir=tmp_path / "theirs", **box).main()
    options = [o for name, values in box.items() for o in ("--" + name.replace("_", "-"), *values)]
    ours = export(run, tmp_path / "ours", *options)
    assert ours.read_bytes() == (tmp_path / "theirs" / "splat.ply").read_bytes()
    assert 0 < len(PlyData.read(str(ours))["vertex"]) < 3000


def test_what_was_left_out_is_said(run, tmp_path, capsys):
    export(run, tmp_path)
    assert "Left out: 13 below an opacity of 1/255, 2 not finite." in capsys.readouterr().out


def test_a_broken_position_costs_one_gaussian(tmp_path):
    # nerfstudio's exporter then writes nothing: it tests all positions at once (`isfinite(t).all(axis=-1)` of [N]).
    gaussians = random_gaussians(6)
    gaussians["opacities"][:] = 1
    gaussians["means"][3, 1] = float("nan")
    vertex = PlyData.read(str(export(write_run(tmp_path / "run", None, gaussians), tmp_path)))["vertex"]
    np.testing.assert_array_equal(vertex["x"], gaussians["means"][[0, 1, 2, 4, 5], 0].numpy())


def test_the_run_may_have_been_moved(tmp_path):
    config = write_run(tmp_path / "run", None)
    moved = (tmp_path / "run").rename(tmp_path / "elsewhere") / config.name
    assert export(moved, tmp_path / "out").exists()


def test_the_newest_checkpoint_is_taken_unless_another_is_named(tmp_path):
    for step, count in ((9, 4), (20, 6)):
        config = write_run(tmp_path / "run", None, random_gaussians(count), step)
    assert len(PlyData.read(str(export(config, tmp_path / "a")))["vertex"]) == 6
    assert len(PlyData.read(str(export(config, tmp_path / "b", "--step", 9)))["vertex"]) == 4


def decode_compressed(path: Path) -> dict[str, np.ndarray]:
    """PlayCanvas' compressed PLY, decoded after its specification; the order of Gaussians is the file's."""
    ply = PlyData.read(str(path))
    chunk, vertex = ply["chunk"].data, ply["vertex"].data
    of = np.arange(len(vertex)) // 256

    def unpack(name: str, widths: tuple[int, ...]) -> np.ndarray:
        bits, shift, fields = vertex[name].astype(np.uint64), sum(widths), []
        for width in widths:
            shift -= width
            fields.append(((bits >> np.uint64(shift)) & np.uint64(2**width - 1)) / (2**width - 1))
        return np.stack(fields, axis=1)

    def stretched(unit: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        low, high = (np.stack([chunk[f"{end}_{n}"][of] for n in names], axis=1) for end in ("min", "max"))
        return low + unit * (high - low)

    color = unpack("packed_color", (8, 8, 8, 8))
    return {
        "means": stretched(unpack("packed_position", (11, 10, 11)), ("x", "y", "z")),
        "scales": stretched(unpack("packed_scale", (11, 10, 11)), ("scale_x", "scale_y", "scale_z")),
        "rgb": stretched(color[:, :3], ("r", "g", "b")),
        "opacity": color[:, 3],
    }


def test_the_compressed_file_holds_the_same_splats_in_a_quarter_of_the_space(tmp_path):
    gaussians = random_gaussians(3000)
    gaussians["opacities"][:10] = -7
    gaussians["scales"] = gaussians["scales"].clamp(-3, 3)
    config = write_run(tmp_path / "run", None, gaussians)
    plain = export(config, tmp_path / "out", "--compressed")
    compressed = tmp_path / "out" / "splat.compressed.ply"
    assert compressed.stat().st_size < 0.28 * plain.stat().st_size
    decoded = decode_compressed(compressed)
    assert len(decoded["means"]) == 2990
    # Chunks may be sorted: each decoded Gaussian has its own nearest original.
    means = gaussians["means"].numpy()[10:]
    distance = np.linalg.norm(decoded["means"][:, None] - means[None], axis=-1)
    nearest = distance.argmin(axis=1)
    assert len(set(nearest)) > 2950
    assert np.median(distance.min(axis=1)) < 0.005
    kept = {name: values.numpy()[10:][nearest] for name, values in gaussians.items()}
    assert np.median(np.abs(decoded["scales"] - kept["scales"])) < 0.005
    assert np.median(np.abs(decoded["opacity"] - 1 / (1 + np.exp(-kept["opacities"][:, 0])))) < 0.003
    assert np.median(np.abs(decoded["rgb"] - (0.5 + 0.28209479 * kept["features_dc"]))) < 0.005


def test_nothing_visible_is_refused_and_leaves_the_old_file(tmp_path, capsys):
    gaussians = random_gaussians(5)
    config = write_run(tmp_path / "run", None, gaussians)
    before = export(config, tmp_path / "out").read_bytes()
    gaussians["opacities"][:] = -9
    write_run(tmp_path / "run", None, gaussians, step=11)
    with pytest.raises(SystemExit):
        export(config, tmp_path / "out")
    assert "no Gaussian of 5 is finite and visible" in capsys.readouterr().err
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["splat.ply"]
    assert (tmp_path / "out" / "splat.ply").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--obb-center", 0, 0, 0], "needs all of"),
        (["--output-filename", "a/b.ply"], "without folders"),
        (["--output-filename", "splat.txt"], "name of a .ply file"),
    ],
)
def test_contradicting_options_are_refused(tmp_path, capsys, options, complaint):
    config = write_run(tmp_path / "run", None)
    with pytest.raises(SystemExit):
        export(config, tmp_path / "out", *options)
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def damage(checkpoint: Path, seed: int) -> None:
    """Change a bit of the means of `random_gaussians(4, seed=seed)`."""
    content = bytearray(checkpoint.read_bytes())
    content[content.index(random_gaussians(4, seed=seed)["means"].numpy().tobytes())] ^= 1
    checkpoint.write_bytes(content)


def test_the_newest_whole_checkpoint_is_exported_and_the_others_are_named(tmp_path, caplog):
    config = write_run(tmp_path / "run", None, random_gaussians(4, seed=1), step=5)
    write_run(tmp_path / "run", None, random_gaussians(4, seed=2), step=9)
    newest = tmp_path / "run/nerfstudio_models/step-000000009.ckpt"
    damage(newest, seed=2)
    found = Checkpoint.read(config)
    assert found.step == 5
    assert torch.equal(found.gaussians()["means"], random_gaussians(4, seed=1)["means"])
    assert f"{newest} cannot be read as a checkpoint (the checksum of" in caplog.text
    assert "--step chooses one" in caplog.text
    with pytest.raises(InputError, match=r"checksum .* choose another with --step: there are 9, 5"):
        Checkpoint.read(config, step=9)


@pytest.mark.parametrize(("broken", "read"), [([3], 2), ([3, 2], 1)])
def test_no_whole_checkpoint_is_passed_over(broken, read, tmp_path, caplog):
    for step in (1, 2, 3):
        config = write_run(tmp_path / "run", None, random_gaussians(4, seed=step), step=step)
    for step in broken:
        damage(tmp_path / f"run/nerfstudio_models/step-{step:09d}.ckpt", seed=step)
    assert Checkpoint.read(config).step == read
    assert len(caplog.messages) == len(broken)


def test_no_older_checkpoint_is_promised_where_there_is_none(tmp_path, caplog):
    config = write_run(tmp_path / "run", None, random_gaussians(4, seed=1))
    damage(tmp_path / "run/nerfstudio_models/step-000000009.ckpt", seed=1)
    with pytest.raises(InputError, match="copy it again or train again"):
        Checkpoint.read(config)
    assert caplog.messages == []


@OFTEN
@given(place=st.integers(0, 10**9), value=st.integers(1, 255))
@example(place=4237, value=16)  # an entry becomes a folder, of which torch reads nothing
def test_no_flipped_byte_is_exported_as_another_scene(tmp_path, place, value):
    config = write_run(tmp_path / "run", None, random_gaussians(4))
    path = tmp_path / "run/nerfstudio_models/step-000000009.ckpt"
    content = bytearray(path.read_bytes())
    content[place % len(content)] ^= value
    path.write_bytes(content)
    try:
        found = Checkpoint.read(config)
    except InputError as refused:
        one_line(refused, "step-000000009.ckpt")
        return
    for name, values in random_gaussians(4).items():
        assert torch.equal(found.gaussians()[name], values), name
