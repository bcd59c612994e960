"""Sheets of the pictures of runs: for one scene and artifact a column a method, renders, artifacts and mattes below."""

from __future__ import annotations

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import title

TILE = 300
"""Width of a picture, pixels."""
_GAP, _CAPTION = 4, 20
ROWS = ("render", "artifact", "matte")


def sheet(columns: list[tuple[Result, Path]]) -> Image.Image | None:
    """Training and test photo, then for each run its render, the artifact it learned, and its matte.

    Args:
        columns: results with the folders of their pictures.

    Returns:
        The sheet; None where no pictures are there.
    """
    columns = [(result, folder) for result, folder in columns if (folder / "render.jpg").is_file()]
    if not columns:
        return None
    first = columns[0][1]
    grid: dict[tuple[int, int], tuple[str, Path]] = {
        (0, 0): ("training photo", first / "photo.jpg"),
        (1, 0): ("test photo", first / "test.jpg"),
    }
    for column, (result, folder) in enumerate(columns, start=1):
        psnr = result.metrics.get("psnr")
        figure = f", {psnr:.2f} dB" if psnr is not None else ""
        learned = "oracle artifact" if result.run.method == "given" else "artifact learned"
        captions = (f"{title(result.run.method)}{figure}", learned, "matte")
        for row, (name, caption) in enumerate(zip(ROWS, captions, strict=True)):
            if (folder / f"{name}.jpg").is_file():
                grid[row, column] = (caption, folder / f"{name}.jpg")
    with Image.open(columns[0][1] / "render.jpg") as picture:
        height = max(1, round(TILE * picture.height / picture.width))
    rows = max(row for row, _ in grid) + 1
    cell = (TILE + _GAP, height + _CAPTION + _GAP)
    canvas = Image.new("RGB", (cell[0] * (len(columns) + 1), cell[1] * rows), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(13)
    for (row, column), (caption, path) in grid.items():
        x, y = column * cell[0], row * cell[1]
        draw.text((x + 2, y + 2), caption, fill="black", font=font)
        with Image.open(path) as picture:
            canvas.paste(picture.convert("RGB").resize((TILE, height), Image.Resampling.LANCZOS), (x, y + _CAPTION))
    return canvas
