"""Each repair is needed by the upstream that is installed: a test that fails here says which repair may go."""

from __future__ import annotations

import ctypes
import importlib.util
import inspect
import logging
import pickle
import sys
from pathlib import Path

import gsplat.strategy.ops
import numpy as np
import pytest
import torch
from gsplat.cuda import _wrapper
from gsplat.strategy import DefaultStrategy
from nerfstudio.configs import external_methods
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.trainer import Trainer
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils import install_checks

from ssa_nerfstudio.plugin.compat import gsplat_repairs, nerfstudio_repairs, open3d_libraries, versions


def test_numpy_scalars_in_checkpoints_need_to_be_allowed(tmp_path):
    path = tmp_path / "scalar.ckpt"
    torch.save({"lr": np.float64(0.5)}, path)
    allowed = torch.serialization.get_safe_globals()
    torch.serialization.clear_safe_globals()
    try:
        with pytest.raises(pickle.UnpicklingError):
            torch.load(path, weights_only=True)
        nerfstudio_repairs.allow_checkpoint_scalars()
        assert torch.load(path, weights_only=True) == {"lr": 0.5}
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(allowed)


def test_the_list_of_external_methods_reads_sources_and_the_repaired_one_lists_the_same_without(monkeypatch):
    read = []
    find = inspect.findsource
    monkeypatch.setattr(inspect, "findsource", lambda frame: read.append(frame) or find(frame))
    monkeypatch.setattr(external_methods, "inspect", inspect)
    listed = external_methods.get_external_methods()
    assert len(read) >= len(listed[0]) > 0
    read.clear()
    nerfstudio_repairs.list_external_methods_fast()
    assert external_methods.get_external_methods() == listed
    assert not read


def test_splatfacto_builds_lpips_which_downloads_weights(monkeypatch):
    import torchmetrics.image.lpip

    class Built(Exception):
        pass

    def build(**_):
        raise Built

    monkeypatch.setattr(torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", build)
    with pytest.raises(Built):
        build_splatfacto()
    with nerfstudio_repairs.without_torchmetrics():
        build_splatfacto()
    assert sys.modules["torchmetrics.image.lpip"].LearnedPerceptualImagePatchSimilarity is build


def test_splatfacto_imports_torchmetrics_and_ours_does_not(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "torchmetrics"]:
        monkeypatch.delitem(sys.modules, name)
    with nerfstudio_repairs.without_torchmetrics():
        build_splatfacto()
    assert not [name for name in sys.modules if name.split(".")[0] == "torchmetrics"]
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    with pytest.raises(ImportError):
        build_splatfacto()


def build_splatfacto() -> None:
    box = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    config = SplatfactoModelConfig(random_init=True, num_random=8)
    config.setup(scene_box=box, num_train_data=1, metadata={})


def test_nerfstudio_exits_without_an_ffmpeg_and_finds_the_one_that_is_provided(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    plain = inspect.unwrap(install_checks.check_ffmpeg_installed)
    monkeypatch.setattr(install_checks, "check_ffmpeg_installed", _original(plain))
    with pytest.raises(SystemExit):
        install_checks.check_ffmpeg_installed()
    nerfstudio_repairs.provide_ffmpeg()
    install_checks.check_ffmpeg_installed()


def _original(check):
    """nerfstudio's own function, whether or not the plugin has replaced it in this process."""
    cells = {
        name: cell.cell_contents for name, cell in zip(check.__code__.co_freevars, check.__closure__ or (), strict=True)
    }
    return cells.get("check", check)


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat's kernels run on CUDA")
def test_gsplats_relocation_needs_cuda_and_runs_on_a_cpu_when_repaired():
    arguments = torch.rand(4), torch.rand(4, 3), torch.full((4,), 2), torch.ones(5, 5)
    with pytest.raises(Exception):  # noqa: B017, PT011 - whatever a missing backend raises
        _wrapper._make_lazy_cuda_func("compute_relocation")(*arguments, 5)
    gsplat_repairs.repair_mcmc()
    opacities, scales = gsplat.strategy.ops.compute_relocation(*arguments)
    assert torch.isfinite(opacities).all()
    assert scales.shape == (4, 3)


def test_gsplats_covariances_are_those_of_scaled_and_turned_axes_when_repaired():
    gsplat_repairs.repair_mcmc()
    quarter_turn = torch.tensor([[1.0, 0.0, 0.0, 1.0]])  # about z, not normalized
    covariances, _ = gsplat.strategy.ops.quat_scale_to_covar_preci(
        quarter_turn, torch.tensor([[1.0, 2.0, 3.0]]), compute_preci=False, triu=False
    )
    assert covariances is not None
    torch.testing.assert_close(covariances[0], torch.diag(torch.tensor([4.0, 1.0, 9.0])))


def test_gsplat_resets_opacities_at_step_0():
    params = torch.nn.ParameterDict({"opacities": torch.full((3,), 3.0)})
    optimizers: dict[str, torch.optim.Optimizer] = {"opacities": torch.optim.Adam([params["opacities"]])}
    strategy = DefaultStrategy()
    strategy._update_state = lambda *_, **__: None  # pyright: ignore[reportAttributeAccessIssue]
    strategy.step_post_backward(params, optimizers, {}, 0, {})
    assert (torch.sigmoid(params["opacities"]) < 0.011).all()


def test_splatfacto_still_replaces_parameters_when_it_loads_a_checkpoint():
    assert "torch.nn.Parameter(torch.zeros(" in inspect.getsource(SplatfactoModel.load_state_dict)


def test_splatfacto_still_moves_seed_colors_to_cuda():
    assert ".cuda()" in inspect.getsource(SplatfactoModel.populate_modules)


def test_nerfstudio_still_pins_the_memory_of_cached_photos():
    assert "pin_memory()" in inspect.getsource(FullImageDatamanager._load_images)


def test_nerfstudios_resumed_runs_still_train_all_steps_again():
    assert "range(self._start_step, self._start_step + num_iterations)" in inspect.getsource(Trainer.train)


def test_nerfstudio_still_writes_times_at_every_step():
    source = inspect.getsource(Trainer.train)
    assert "EventName.TRAIN_RAYS_PER_SEC" in source


def test_open3d_still_links_to_a_libusb_that_it_does_not_bring():
    spec = importlib.util.find_spec("open3d")
    assert spec is not None
    assert spec.origin is not None
    folder = Path(spec.origin).parent
    libraries = sorted(folder.rglob("*.so*"), key=lambda path: path.stat().st_size)
    assert any(open3d_libraries.LIBUSB.encode() in path.read_bytes() for path in libraries if "usb" not in path.name)
    # The copy that `make setup` puts there does not count.
    assert {path.parent for path in folder.rglob("libusb*")} <= {folder}


@pytest.fixture
def slim_system(tmp_path, monkeypatch) -> Path:
    """No libusb on the system; open3d, and the wheel that holds one, in a folder."""
    for name, library in (("open3d", "other.so"), ("libusb_package", "libusb-1.0.so")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
        (tmp_path / name / library).touch()
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "platform", "linux")
    return tmp_path


def test_the_wheels_libusb_is_loaded_or_copied_where_the_system_has_none(slim_system, monkeypatch):
    loaded = []

    def load(library: str, mode: int = 0) -> None:
        if library == open3d_libraries.LIBUSB:
            raise OSError
        loaded.append((library, mode))

    monkeypatch.setattr(ctypes, "CDLL", load)
    open3d_libraries.preload()
    assert loaded == [(str(slim_system / "libusb_package/libusb-1.0.so"), ctypes.RTLD_GLOBAL)]
    assert open3d_libraries.install() == slim_system / "open3d" / open3d_libraries.LIBUSB
    assert (slim_system / "open3d" / open3d_libraries.LIBUSB).is_file()


def test_the_systems_libusb_is_enough(slim_system, monkeypatch):
    loaded = []
    monkeypatch.setattr(ctypes, "CDLL", lambda library, mode=0: loaded.append(library))
    open3d_libraries.preload()
    assert open3d_libraries.install() is None
    assert loaded == [open3d_libraries.LIBUSB] * 2


@pytest.mark.parametrize(("found", "warned"), [("2.5.1", True), ("2.6.0", False), ("2.15.0", True)])
def test_other_versions_are_named_once(monkeypatch, caplog, found, warned):
    monkeypatch.setattr(versions, "version", lambda name: found if name == "torch" else versions.WRITTEN_FOR[name][0])
    versions.check_versions.cache_clear()
    with caplog.at_level(logging.WARNING):
        versions.check_versions()
        versions.check_versions()
    assert (caplog.text.count(f"torch {found} is installed") == 1) == warned
    assert len(caplog.records) == warned


def test_the_versions_are_those_of_the_package_metadata():
    stated = (Path(__file__).parents[3] / "pyproject.toml").read_text()
    low, below = versions.WRITTEN_FOR["torch"]
    assert f'"torch>={low},<{below}"' in stated
    assert all(f'"{name}=={versions.WRITTEN_FOR[name][0]}"' in stated for name in ("nerfstudio", "gsplat"))
