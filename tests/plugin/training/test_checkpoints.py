"""What a kill, a full disk and a torn file leave behind: the newest whole checkpoint, from which a run resumes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.training.checkpoints import PARTIAL, newest_first, staged_checkpoints
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig

AS_NS_TRAIN = "import sys; sys.argv[0] = 'ns-train'\n"
"""Exceptions end the process as they end nerfstudio's command."""
TRAIN = """
import os, resource, signal, sys
from pathlib import Path
import torch
torch.set_num_threads(1)

data, output, fault = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
config = configure_training("ssa-splatfacto", data, output, 30, {"num_downscales": 0, "stop_split_at": 1})
config.steps_per_save = 10

def on_step(step):
    if fault == "killed in training" and step == 18:
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "disk full" and step == 15:
        # What a full disk does to a process: a write beyond so many bytes fails.
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

if fault == "killed in saving":
    save = torch.save
    def torn(state, path):
        save(state, path)
        if state["step"] == 20:
            os.truncate(path, os.path.getsize(path) // 2)
            os.kill(os.getpid(), signal.SIGKILL)
    torch.save = torn
train_and_evaluate(config, on_step)
"""


def interrupted(data: Path, output: Path, fault: str, imports: str) -> tuple[int, str, Path]:
    """Train 30 steps with a checkpoint after every 10 in a process that meets a fault: its end, and its checkpoints."""
    done = subprocess.run(
        [sys.executable, "-c", AS_NS_TRAIN + imports + TRAIN, data, output, fault],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ,
    )
    return done.returncode, done.stderr, next(output.glob("*/*/*/nerfstudio_models"))


@pytest.fixture(scope="session")
def resumed(configure_training, train_and_evaluate):
    def resumed(data: Path, output: Path, checkpoints: Path) -> int:
        """The step at which a run that resumes goes on."""
        config = configure_training("ssa-splatfacto", data, output, 30, {"num_downscales": 0})
        config.load_dir = checkpoints
        steps: list[int] = []
        _, _, path = train_and_evaluate(config, steps.append)
        assert torch.load(path.parent / "nerfstudio_models" / "step-000000029.ckpt")["step"] == 29
        return steps[0] - 1

    return resumed


@pytest.mark.parametrize(
    ("fault", "code", "saved"),
    [("killed in training", -signal.SIGKILL, 10), ("killed in saving", -signal.SIGKILL, 10), ("disk full", 3, 10)],
)
def test_a_fault_costs_at_most_one_checkpoint_interval(
    tiny_scene, tmp_path, fault, code, saved, resumed, training_imports
):
    ended, errors, checkpoints = interrupted(tiny_scene, tmp_path / "first", fault, training_imports)
    assert ended == code, errors
    assert [path.name for path in checkpoints.iterdir()] == [f"step-{saved:09d}.ckpt"]
    assert (checkpoints.parent / PARTIAL).exists() == (fault == "killed in saving")
    if fault == "disk full":
        line = errors.strip().splitlines()[-1]
        assert line.startswith("ssa-nerfstudio: error: the checkpoint of step 20 could not be written")
        assert f"resume from {checkpoints / 'step-000000010.ckpt'}" in line
    assert resumed(tiny_scene, tmp_path / "second", checkpoints) == saved + 1


@pytest.fixture(scope="module")
def three_checkpoints(tiny_scene, tmp_path_factory, configure_training, train_and_evaluate) -> Path:
    """A run of 30 steps that keeps every checkpoint: of steps 10, 20 and 29."""
    config = configure_training(
        "ssa-splatfacto", tiny_scene, tmp_path_factory.mktemp("whole"), 30, {"num_downscales": 0}
    )
    config.steps_per_save, config.save_only_latest_checkpoint = 10, False
    _, _, path = train_and_evaluate(config)
    return path.parent / "nerfstudio_models"


def copied(checkpoints: Path, folder: Path) -> list[Path]:
    folder.mkdir()
    for path in checkpoints.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return newest_first(folder)


def torn(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


def not_finite(path: Path) -> None:
    state = torch.load(path, weights_only=False)
    state["pipeline"]["_model.gauss_params.means"][0] = float("nan")
    torch.save(state, path)


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "torn": torn,
    "of another kind": lambda path: torch.save({"weights": 1}, path),
    "text": lambda path: path.write_text("no checkpoint"),
    "one byte flipped": flipped,
    "not finite": not_finite,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_newest_checkpoint_is_passed_over_and_the_next_is_named(
    tiny_scene, three_checkpoints, tmp_path, caplog, damage, resumed
):
    newest, next_newest, _ = copied(three_checkpoints, tmp_path / "copy")
    DAMAGES[damage](newest)
    assert resumed(tiny_scene, tmp_path / "second", newest.parent) == 21
    warnings = [record.getMessage() for record in caplog.records if record.name.startswith("ssa_nerfstudio")]
    assert f"{newest} cannot be used" in warnings[0]
    assert f"resuming from {next_newest}, the newest checkpoint that is whole" in warnings[1]


def test_where_every_checkpoint_is_damaged_the_folder_is_named(tiny_scene, three_checkpoints, tmp_path, resumed):
    for path in copied(three_checkpoints, tmp_path / "copy"):
        torn(path)
    with pytest.raises(InputError, match="copy holds no checkpoint that can be read"):
        resumed(tiny_scene, tmp_path / "second", tmp_path / "copy")


def test_strangers_in_the_folder_do_not_matter(tiny_scene, three_checkpoints, tmp_path):
    copied(three_checkpoints, tmp_path / "copy")
    for name in ("notes.txt", "step-final.ckpt", ".step-000000099.ckpt.swp"):
        (tmp_path / "copy" / name).write_text("")
    assert newest_first(tmp_path / "copy")[0].name == "step-000000029.ckpt"


def test_only_the_latest_is_kept_and_only_once_it_is_there(tiny_scene, tmp_path, configure_training):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 4, {"num_downscales": 0})
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.save_checkpoint(1)
    trainer.save_checkpoint(2)
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000002.ckpt"]


def test_an_error_while_writing_leaves_the_folder_as_it_was(tmp_path):
    folder = tmp_path / "run" / "nerfstudio_models"
    with staged_checkpoints(folder) as partial:
        (partial / "step-000000001.ckpt").write_text("old")

    def fail() -> None:
        with staged_checkpoints(folder) as partial:
            (partial / "step-000000002.ckpt").write_text("half")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fail()
    assert [path.read_text() for path in folder.iterdir()] == ["old"]
    assert [path.name for path in folder.parent.iterdir()] == ["nerfstudio_models"]


def test_a_configuration_is_written_with_names_that_load():
    written = yaml.dump(SSASplatfactoModelConfig(sparsity_weight=0.125))
    assert yaml.load(written, Loader=yaml.Loader) == SSASplatfactoModelConfig(sparsity_weight=0.125)


def test_a_configuration_with_former_names_loads():
    written = yaml.dump([SSASplatfactoModelConfig(sparsity_weight=0.125), FusedAdamConfig(lr=0.5)])
    former = written.replace("plugin.model.SSASplatfactoModelConfig", "plugin.settings.SSASplatfactoModelConfig")
    former = former.replace("plugin.training.fused_adam.", "plugin.fused_adam.")
    assert former != written
    code = "import yaml, ssa_nerfstudio.plugin.methods; "
    code += f"print(yaml.load({former!r}, Loader=yaml.Loader)[0].sparsity_weight)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip().endswith("0.125"), done.stderr
