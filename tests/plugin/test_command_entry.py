"""nerfstudio's commands end in one line of ours: runs that cannot be read, and options that upstream fails at."""

from __future__ import annotations

import copy
import sys
import warnings
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

import pytest
import torch
import yaml

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.command_entry import is_nerfstudio_command, report_in_one_line, resuming
from ssa_nerfstudio.plugin.methods import METHODS


def called(entry_point: Callable[[], None]) -> None:
    """Call what a process calls, with what the interpreter does of an exception that nobody catches."""
    try:
        entry_point()
    except Exception as error:
        sys.excepthook(type(error), error, error.__traceback__)


@pytest.fixture
def refused(monkeypatch, capsys):
    """Call a command as its script does; the line and exit code that it ends with."""

    def run(name: str, *options: str | Path) -> str:
        (script,) = entry_points(group="console_scripts", name=name)
        monkeypatch.setattr(sys, "argv", [name, *map(str, options)])
        monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
        report_in_one_line()
        with pytest.raises(SystemExit) as end:
            called(script.load())
        assert end.value.code == 2
        (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
        return line.removeprefix("ssa-nerfstudio: error: ")

    return run


@pytest.mark.parametrize("content", ["", "[1, 2]", "x: [", "!!python/object:no.such.Class {}", "\x89PNG\xff", "\0"])
def test_a_config_that_is_none(content, refused, tmp_path):
    config = tmp_path / "config.yml"
    config.write_bytes(content.encode("latin-1"))
    line = refused("ns-eval", "--load-config", config)
    assert line.startswith(f"{config} cannot be read as the config.yml of a run")


@pytest.fixture(scope="module")
def run(tiny_scene, tmp_path_factory, configure_training, train_and_evaluate) -> Path:
    """A run of one step."""
    folder = tmp_path_factory.mktemp("runs")
    config = configure_training("ssa-splatfacto", tiny_scene, folder, 1, {"num_downscales": 0, "overlay": "off"})
    config.set_timestamp()
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.save_checkpoint(0)
    return config.get_base_dir()


@pytest.mark.parametrize("name", ["step-000000000.ckpt", "notes.txt"])
def test_a_checkpoint_that_is_none(name, refused, run):
    file = run / "nerfstudio_models" / name
    before = file.read_bytes() if file.exists() else None
    file.write_text("hello")
    line = refused("ns-eval", "--load-config", run / "config.yml")
    culprit = file if before else file.parent
    assert line.startswith(f"{culprit} cannot be read as a checkpoint")
    file.write_bytes(before) if before else file.unlink()


def test_no_checkpoint_at_all(refused, run):
    (file,) = (run / "nerfstudio_models").iterdir()
    file.rename(run / "aside.ckpt")
    assert "nerfstudio_models cannot be read as a checkpoint" in refused("ns-eval", "--load-config", run / "config.yml")
    (run / "aside.ckpt").rename(file)


def test_an_error_after_the_run_was_read_is_not_blamed_on_it(refused, run, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("of another kind")

    monkeypatch.setattr("ssa_nerfstudio.plugin.pipeline.SSAPipeline.__init__", fail)
    monkeypatch.setattr(sys, "__excepthook__", lambda *_: None)
    with pytest.raises(pytest.fail.Exception):
        refused("ns-eval", "--load-config", run / "config.yml")


def test_memory_that_runs_out_is_said_in_one_line(refused, run, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has")

    monkeypatch.setattr("ssa_nerfstudio.plugin.pipeline.SSAPipeline.__init__", fail)
    line = refused("ns-eval", "--load-config", run / "config.yml")
    assert line == "memory ran out (CUDA out of memory); close other programs, or use smaller photos"


def test_results_that_are_no_json(refused, run, tmp_path):
    line = refused("ns-eval", "--load-config", run / "config.yml", "--output-path", tmp_path / "out.txt")
    assert line == f"--output-path {tmp_path}/out.txt: the results are JSON; choose a name that ends in .json"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "why"),
    [("{}", "it holds a dict"), ("a: [", "while parsing"), (None, ""), ("!!python/name:no.such", "")],
)
def test_a_training_of_a_config_that_is_none(content, why, refused, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "transforms.json"
    if content is not None:
        config.write_text(content)
    words = ("ssa-splatfacto", "--data", tiny_scene, "--vis", "tensorboard", f"--load-config={config}")
    line = refused("ns-train", *words)
    assert line.startswith(f"{config}: No such file" if content is None else f"--load-config {config} cannot be read")
    assert why in line
    assert {*tmp_path.iterdir()} <= {config}


@pytest.mark.parametrize("content", ["{}", "[]", "{", '{"seconds": 1, "render_height": 4, "render_width": 4}'])
def test_a_camera_path_that_is_none(content, refused, run, tmp_path, monkeypatch):
    monkeypatch.setattr("nerfstudio.utils.install_checks.check_ffmpeg_installed", lambda: None)
    path = tmp_path / "path.json"
    path.write_text(content)
    words = ("--camera-path-filename", path, "--output-path", tmp_path / "video.mp4")
    line = refused("ns-render", "camera-path", "--load-config", run / "config.yml", *words)
    assert line.startswith(f"--camera-path-filename {path} cannot be read as a camera path")
    assert line.endswith("; save one in the tab Render of ns-viewer")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "words", [["pointcloud"], ["pointcloud", "--normal-method", "open3d"], ["poisson"], ["marching-cubes"]]
)
def test_what_splats_cannot_be_exported_as(words, refused, run, tmp_path):
    line = refused("ns-export", *words, "--load-config", run / "config.yml", "--output-dir", tmp_path)
    assert line.endswith("nor a field to make a mesh of; export the splats: ns-export gaussian-splat")
    assert list(tmp_path.iterdir()) == []


def test_a_box_around_nothing(refused, run, tmp_path):
    box = [word for name in ("center", "rotation", "scale") for word in (f"--obb-{name}", "0", "0", "0")]
    words = ("--load-config", run / "config.yml", "--output-dir", tmp_path, *box)
    line = refused("ns-export", "gaussian-splat", *words)
    assert line.startswith("no Gaussian lies in the box of --obb-center, --obb-rotation and --obb-scale; choose")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--machine.seed", "-1"), "--machine.seed must be from 0 to 4294967295, got -1"),
        (("--machine.seed", "99999999999"), "--machine.seed must be from 0"),
        (("--machine.num-devices", "0"), "--machine.num-devices must be at least 1, got 0"),
        (("--machine.num-devices", "2"), "--machine.num-devices 2: a training uses one device; leave it at 1"),
        (("--machine.num-machines", "2"), "--machine.num-machines 2: a training uses one device; leave it at 1"),
        (("--viewer.websocket-port", "99999"), "--viewer.websocket-port must be from 1 to 65535, got 99999"),
        (("--logging.steps-per-log", "0"), "--logging.steps-per-log must be at least 1, got 0"),
        (("--steps-per-save", "-5"), "--steps-per-save must be at least 0, got -5"),
        (
            ("--gradient-accumulation-steps", "means", "0"),
            "--gradient-accumulation-steps must be at least 1, got 0 for",
        ),
        (("--output-dir", "-"), "--output-dir -: a training does not go to the standard output"),
    ],
)
def test_options_that_upstream_fails_at(options, says, refused, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert says in refused("ns-train", "ssa-splatfacto", "--data", tiny_scene, "--vis", "tensorboard", *options)
    assert list(tmp_path.iterdir()) == []


NO_RUN = [
    (("--data", "nope"), "nope/transforms.json does not exist"),
    ((), "transforms.json does not exist"),
    (("--data", "cut"), "cut/transforms.json is no valid JSON"),
    (("--data", "{scene}", "--load-dir", "nope"), "--load-dir nope holds no step-*.ckpt"),
    (("--data", "{scene}", "--load-dir", "cut", "--load-step", "3"), "--load-dir cut holds no step-000000003.ckpt"),
    (("--data", "{scene}", "--load-checkpoint", "nope"), "--load-checkpoint nope does not exist"),
    (("--data", "{scene}", "--load-checkpoint", "cut"), "--load-checkpoint cut is no checkpoint"),
    (("--data", "{scene}", "--load-checkpoint", "cut/transforms.json"), "transforms.json is no checkpoint; give a"),
    (("--data", "{scene}", "nerfstudio-data", "--downscale-factor", "3"), "images_3/train_0000.png does not exist"),
]
"""Options of `ns-train` where cut/transforms.json is truncated, and the line that they end in."""


@pytest.mark.parametrize(("options", "says"), NO_RUN)
def test_data_and_checkpoints_are_looked_at_before_anything_is_printed_or_written(
    options, says, tiny_scene, tmp_path, monkeypatch, refused
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(METHODS["ssa-splatfacto"].__class__, "print_to_terminal", lambda _: pytest.fail("printed"))
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut/transforms.json").write_text('{"frames": [')
    words = (word.format(scene=tiny_scene) for word in options)
    assert says in refused("ns-train", "ssa-splatfacto", "--vis", "tensorboard", *words)
    assert [path.name for path in tmp_path.rglob("*")] == ["cut", "transforms.json"]


@pytest.mark.parametrize("before", [(), ("earlier",)])
def test_what_only_the_photos_show_leaves_no_run(before, broken_scene, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    photo = broken_scene / "images/train_0004.png"
    photo.write_bytes(photo.read_bytes()[:200])
    runs = Path("out", broken_scene.name, "ssa-splatfacto")
    for name in before:
        (runs / name).mkdir(parents=True)
    words = ("--data", broken_scene, "--vis", "tensorboard", "--output-dir", "out")
    assert "train_0004.png cannot be read" in refused("ns-train", "ssa-splatfacto", *words)
    assert [path.name for path in runs.glob("*")] == [*before]
    assert runs.parent.exists() == bool(before)


@pytest.mark.parametrize("seed", [0, 2**32 - 1])
def test_seeds_at_both_ends_are_taken(seed):
    config = copy.deepcopy(METHODS["ssa-splatfacto"])
    config.machine.seed = seed
    config.check()


@pytest.mark.parametrize(
    ("program", "module", "expected"),
    [
        ("/bin/ns-train", None, True),
        ("train.py", "nerfstudio.scripts.train", True),
        ("train.py", "mine.scripts.train", False),
        ("ssa", None, False),
    ],
)
def test_what_is_a_command_of_nerfstudio(program, module, expected, monkeypatch):
    main = ModuleType("__main__")
    main.__spec__ = module and ModuleSpec(module, None)
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.setattr(sys, "argv", [program])
    assert is_nerfstudio_command() == expected


@pytest.mark.parametrize(
    ("reader", "says"),
    [
        (("--eval-mode", "fraction", "--train-split-fraction", "5"), "--train-split-fraction 5 leaves no two of 15"),
        (("--eval-mode", "fraction", "--train-split-fraction", "nan"), "--train-split-fraction nan leaves no two"),
        (("--eval-mode", "interval", "--eval-interval", "1"), "--eval-interval must be at least 2, got 1"),
        (("--eval-mode", "filename"), "test_0000.png has neither train nor eval in its name"),
    ],
)
def test_splits_that_cannot_be_made(reader, says, refused, broken_scene, tmp_path):
    from cli.odd_cases import edit_json

    edit_json(broken_scene / "transforms.json", {"unsplit": True})
    words = ("--data", broken_scene, "--vis", "tensorboard", "--output-dir", tmp_path / "out")
    assert says in refused("ns-train", "ssa-splatfacto", *words, "nerfstudio-data", *reader)


def test_a_dataset_of_another_kind(refused, tiny_scene, tmp_path):
    words = ("--data", tiny_scene, "--vis", "tensorboard", "--output-dir", tmp_path / "out", "colmap")
    line = refused("ns-train", "ssa-splatfacto", *words)
    assert line.startswith(f"nerfstudio cannot read {tiny_scene} (Colmap path")
    assert line.endswith("; look at the options of its reader")


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"sh_degree": 9}, "sh-degree must be at most 4, got 9"),
        ({"ssim_lambda": 5.0}, "ssim-lambda must be at most 1, got 5.0"),
        ({"ssim_lambda": float("nan")}, "ssim-lambda must be at least 0, got nan"),
        ({"densify_grad_thresh": float("nan")}, "densify-grad-thresh is no number"),
        (
            {"num_downscales": 6},
            r"num-downscales 6 starts with one pixel in 2\^6, and a side of a photo has 48; choose a smaller number$",
        ),
    ],
)
def test_settings_that_upstream_fails_at(settings, says, configure_training, tiny_scene, tmp_path):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, {"overlay": "off", **settings})
    config.timestamp = "now"
    with pytest.raises(InputError, match=says):
        config.setup(local_rank=0, world_size=1).setup()


@pytest.mark.parametrize(
    ("options", "resumed"),
    [
        (["--data", "my photos"], "--data 'my photos'"),
        (["--load-dir", "old", "--data", "my photos"], "--data 'my photos'"),
        (["--steps-per-save", "10", "--load-dir", "old", "--vis", "viewer"], "--steps-per-save 10 --vis viewer"),
    ],
)
def test_the_command_that_resumes_has_one_load_dir_and_all_other_options(monkeypatch, options, resumed):
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/ns-train", "ssa-splatfacto", *options])
    assert resuming(Path("run/models")) == f"ns-train ssa-splatfacto --load-dir run/models {resumed}"


@pytest.mark.parametrize(
    ("module", "shown"), [("torch.cuda.amp", 0), ("nerfstudio", 0), ("gsplat.x", 0), ("torchx", 1)]
)
def test_no_command_opens_with_warnings_of_libraries_about_each_other(module, shown, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["ns-train"])
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        report_in_one_line()
        warnings.warn_explicit("use another", FutureWarning, "file.py", 1, module)
    assert len(seen) == shown


@pytest.mark.parametrize(
    ("data", "remedy"),
    [("scene", "call the command where the training was called"), ("/nowhere/scene", "put it there again")],
)
def test_a_dataset_that_is_elsewhere(data, remedy, refused, run, tmp_path):
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    config.pipeline.datamanager.data = Path(data)
    (tmp_path / "config.yml").write_text(yaml.dump(config))
    line = refused("ns-eval", "--load-config", tmp_path / "config.yml")
    assert line == f"{data}, which the run was trained on, does not exist; {remedy}"
