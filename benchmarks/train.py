"""Train and evaluate once: `python benchmarks/train.py --data DIR --output FILE.json --settings NAME=VALUE`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Bound, Count, Factor, Method
from ssa_nerfstudio.data.training_requirements import check_training
from ssa_nerfstudio.data.transforms import Transforms


@dataclass
class Command:
    """Train once and write the metrics as JSON."""

    data: Path
    """A nerfstudio dataset."""
    output: Annotated[
        Path, Bound("a .json file that is no folder", lambda path: path.suffix == ".json" and not path.is_dir())
    ]
    """The JSON file to write; the trained model goes into a folder beside it."""
    method: Method = "ssa-splatfacto"
    """Method to train with."""
    steps: Count = 30_000
    """Training steps; every schedule is scaled to them."""
    settings: tuple[str, ...] = ()
    """Settings of the model as name=value, for example overlay=off sparsity_weight=0.01."""
    scale_factor: Factor = 1.0
    """Photos are resized by this."""

    def run(self) -> None:
        """Train, evaluate, write.

        Raises:
            InputError: the model has no such setting, or the dataset cannot be trained on.
        """
        check_training(Transforms.read(self.data))
        from ssa_nerfstudio.experiments.runs.run_configuration import configure, model_settings
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

        folder = self.output.with_suffix("")
        model = model_settings(self.settings)
        config = configure(self.method, self.data, folder, self.steps, model, self.scale_factor)
        outcome, _, path = train_and_evaluate(config)
        asked = {"method": self.method, "data": self.data.name, "steps": self.steps, "settings": list(self.settings)}
        self.output.parent.mkdir(parents=True, exist_ok=True)
        self.output.write_text(json.dumps({**asked, **outcome.as_dict(), "config": str(path)}, indent=2) + "\n")


if __name__ == "__main__":
    run_script(Command)
