"""All effects on the demo's scene as one picture: `python benchmarks/contact_sheet.py FILE.png`."""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects

_FRAME = (640, 432)
_REDUCTION = 2
_COLUMNS = 4
_CAPTION = 18


def contact_sheet(scene: DemoScene, seed: int = 0) -> Image.Image:
    """A clean view, then every effect in front of it; of the effects that vary a second view follows.

    Args:
        scene: its first and second training view are shown.
        seed: of the effects.

    Returns:
        A picture of 256 colors, four tiles of half the frame's size a row.
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


def main(arguments: list[str]) -> None:
    """Write the contact sheet to the one file named.

    Raises:
        InputError: not exactly one .png file is named.
    """
    if len(arguments) != 1 or Path(arguments[0]).suffix != ".png":
        raise InputError("name one .png file to write: python -m benchmarks.contact_sheet FILE.png")
    sheet = contact_sheet(DemoScene(views=2, test_views=1, width=_FRAME[0], height=_FRAME[1]))
    sheet.save(arguments[0], optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
