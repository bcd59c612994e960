"""The documentation's picture of a run's report: `python benchmarks/report_screenshot.py docs/images/run-report.png`

Photos of the built-in scene behind a dashboard, `ssa run`, and the page in the system's Chromium.
"""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image
from viewer_screenshots import browser

from ssa_nerfstudio.cli import main, run_script
from ssa_nerfstudio.cli.option_bounds import Count, file_to_write
from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

_WIDTH, _HEIGHT = 320, 224
_SMALL = ["--train.pipeline.model.num-downscales", "0", "--train.pipeline.model.densify-grad-thresh", "0.006"]
"""Full resolution from the start, and fewer new Gaussians than photos of megapixels need."""


@dataclass
class Command:
    """Take the documentation's picture of a run's report."""

    output: Annotated[Path, tyro.conf.Positional, file_to_write(".png")]
    """The .png file to write."""
    views: Count = 36
    """Number of photos."""
    steps: Count = 400
    """Training steps."""

    def run(self) -> None:
        """Render the photos, run all stages, and take the picture.

        Raises:
            InputError: there is no Chromium.
        """
        with tempfile.TemporaryDirectory() as scratch, browser() as chromium:
            photos, out = Path(scratch) / "drive", Path(scratch) / "out"
            _write_photos(photos, self.views)
            main(["run", str(photos), "--output", str(out), "--steps", str(self.steps), *_SMALL])
            page = chromium.new_page(viewport={"width": 860, "height": 1000})
            page.goto((out / "report.html").as_uri())
            # The pictures and what is above them; files, figures and commands follow below.
            height = int(page.evaluate("document.querySelector('h2').getBoundingClientRect().top"))
            picture = Image.open(io.BytesIO(page.screenshot(full_page=True))).convert("RGB").crop((0, 0, 860, height))
            picture.quantize(256, dither=Image.Dither.NONE).save(self.output, optimize=True)


def _write_photos(folder: Path, views: int) -> None:
    """An arc around the built-in scene, 4 degrees a view, bobbing, behind a dashboard."""
    scene = DemoScene(width=_WIDTH, height=_HEIGHT)
    layers = Dashboard().layers(_HEIGHT, _WIDTH, np.random.default_rng(0))
    folder.mkdir()
    for number in range(views):
        azimuth = np.radians(-130 + 4 * number)
        position = np.array([3.4 * np.cos(azimuth), 3.4 * np.sin(azimuth), 1.5 + 0.5 * np.sin(1.7 * number)])
        back = (position - [0, 0, 0.5]) / np.linalg.norm(position - [0, 0, 0.5])
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        Image.fromarray(layers.apply(scene.render(pose))).save(folder / f"{number:03d}.jpg", quality=95)


if __name__ == "__main__":
    run_script(Command)
