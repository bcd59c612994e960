"""Renders of one test view by several methods, side by side: `python benchmarks/renders_of_methods.py RESULTS ...`

No photo is drawn: of some captures renders may be shown, and photos not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from PIL import Image, ImageDraw, ImageFont

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, NotNegative, file_to_write
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.results import Result, read_named
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import METHODS, title

_COLUMNS = 4
_CAPTION = 18


def sheet(rows: list[list[tuple[str, Image.Image]]], width: int) -> Image.Image:
    """Lay pictures with captions out, four in a row; every list begins a new row.

    Args:
        rows: captions and pictures of one size.
        width: of a picture in the result, pixels.

    Returns:
        The sheet, RGB.
    """
    first = rows[0][0][1]
    height = round(width * first.height / first.width) + _CAPTION
    lines = [line[start : start + _COLUMNS] for line in rows for start in range(0, len(line), _COLUMNS)]
    result = Image.new("RGB", (_COLUMNS * width, len(lines) * height), "white")
    draw, font = ImageDraw.Draw(result), ImageFont.load_default(_CAPTION * 0.7)
    for number, line in enumerate(lines):
        for column, (caption, picture) in enumerate(line):
            x, y = column * width, number * height
            result.paste(picture.resize((width, height - _CAPTION), Image.Resampling.LANCZOS), (x, y + _CAPTION))
            draw.text((x + 4, y + 2), caption, fill="black", font=font)
    return result


@dataclass
class Command:
    """Draw one test view as every method of a benchmark renders it, with its PSNR over all test views."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Output folder of `ssa bench`, with its pictures/."""
    output: Annotated[Path, file_to_write(".jpg", ".png")]
    """Picture to write, .jpg or .png."""
    scene: str
    """Capture; SOURCES.md of the captures says which renders may be shown."""
    effects: tuple[str, ...]
    """One row or more each."""
    densification: Literal["adc", "mcmc"] = "adc"
    """Of the runs to draw."""
    seed: NotNegative = 0
    """Of the runs to draw."""
    width: Count = 300
    """Of a render, pixels."""

    def run(self) -> None:
        """Write the picture.

        Raises:
            InputError: no run of an effect has pictures.
        """
        results, _ = read_named([self.folder])
        rows = [self._row(results, effect) for effect in self.effects]
        sheet(rows, self.width).save(self.output, quality=85)

    def _row(self, results: list[Result], effect: str) -> list[tuple[str, Image.Image]]:
        """Captions and renders, in the order of the methods."""
        wanted = (self.scene, effect, self.densification, self.seed)
        chosen = [r for r in results if (r.run.scene, r.run.effect, r.run.densification, r.run.seed) == wanted]
        tiles = []
        for result in sorted(chosen, key=lambda r: [*METHODS].index(r.run.method) if r.run.method in METHODS else 99):
            pictures = self.folder / "pictures" / result.run.id
            if (pictures / "render.jpg").exists():
                psnr = result.metrics["psnr"]
                score = "" if psnr is None else f", {psnr:.1f} dB"
                caption = f"{effect}: {title(result.run.method).replace(', hand-made features', '')}{score}"
                tiles.append((caption, Image.open(pictures / "render.jpg")))
        if not tiles:
            problem = f"{self.folder} has no pictures of {self.scene} behind {effect}"
            raise InputError(problem, "check --scene and --effects, and that pictures/ was copied")
        return tiles


if __name__ == "__main__":
    run_script(Command)
