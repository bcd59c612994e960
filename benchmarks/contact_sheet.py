"""All effects on the built-in scene as one picture: `python benchmarks/contact_sheet.py FILE.png`"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from PIL import Image, ImageDraw, ImageFont

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import file_to_write
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects

_FRAME = (640, 432)
_REDUCTION = 2
_COLUMNS = 4
_CAPTION = 18


def contact_sheet(scene: DemoScene, seed: int = 0) -> Image.Image:
    """Draw a clean view and every effect over it; effects that vary are drawn over a second view, too.

    Args:
        scene: its first two training views are drawn.
        seed: of the effects.

    Returns:
        A picture of 256 colors, four tiles of half the frame's size in a row.
    """
    photos = [scene.render(pose) for pose in scene.cameras[0][:2]]
    tiles = [("clean", photos[0])]
    for name in EFFECTS:
        drawn = Scene(read_effects((name,)), seed)
        artifact = drawn.draw(scene.height, scene.width)
        for view, photo in enumerate(photos if artifact.box is not None else photos[:1]):
            inside = None if artifact.box is None else artifact.view(drawn.view_generators(artifact, view))
            tiles.append((f"{name}, view {view + 1}" if artifact.box else name, artifact.apply(photo, inside)))
    width, height = scene.width // _REDUCTION, scene.height // _REDUCTION + _CAPTION
    rows = -(-len(tiles) // _COLUMNS)
    sheet = Image.new("RGB", (_COLUMNS * width, rows * height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_CAPTION * 0.75)
    for number, (caption, picture) in enumerate(tiles):
        x, y = number % _COLUMNS * width, number // _COLUMNS * height
        sheet.paste(Image.fromarray(picture).reduce(_REDUCTION), (x, y + _CAPTION))
        draw.text((x + 4, y + 2), caption, fill="black", font=font)
    palette = sheet.quantize(256, method=Image.Quantize.MAXCOVERAGE)
    return sheet.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)


@dataclass
class Command:
    """Draw all effects on the built-in scene as one picture."""

    file: Annotated[Path, tyro.conf.Positional, file_to_write(".png")]
    """PNG file to write, in a folder that exists."""

    def run(self) -> None:
        """Write the contact sheet."""
        sheet = contact_sheet(DemoScene(views=2, test_views=1, width=_FRAME[0], height=_FRAME[1]))
        sheet.save(self.file, optimize=True)


if __name__ == "__main__":
    run_script(Command)
