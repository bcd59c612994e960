"""Write a small capture for `check.py`: `make_capture.py FOLDER`.

Imports of the experiments only what needs none of their packages, so that the bare environment can run it.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    scene = DemoScene(views=12, test_views=3, width=160, height=112)
    scene.write(folder, Dashboard().layers(scene.height, scene.width, np.random.default_rng(0)))
