"""Draw the imports between the package's folders: `python docs/import_diagram.py` writes docs/images/architecture.svg,
`--check` fails where that file is stale.

The imports are read from the source by grimp, the rows are the layers of pyproject.toml's first import-linter contract.
An arrow that follows from others is left out (transitive reduction).
"""

from __future__ import annotations

import sys
from html import escape
from pathlib import Path

import grimp

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PACKAGE = "ssa_nerfstudio"
PICTURE = ROOT / "docs/images/architecture.svg"
WIDTH, ROW, BOX_WIDTH, BOX_HEIGHT = 760, 78, 130, 36
FRAMEWORK = "nerfstudio"


def layers() -> list[list[str]]:
    """Folders row by row, from the top, as the contract has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rows = next(c["layers"] for c in contracts if c["type"] == "layers" and c["containers"] == [PACKAGE])
    return [[name.strip() for name in row.split("|")] for row in rows]


def imports() -> dict[str, set[str]]:
    """For each folder, the folders and the framework that its modules import directly."""
    graph = grimp.build_graph(
        PACKAGE, include_external_packages=True, exclude_type_checking_imports=True, cache_dir=None
    )
    names = {name for row in layers() for name in row}
    found: dict[str, set[str]] = {name: set() for name in names}
    for module in graph.modules:
        importer = module.split(".")[1] if module.startswith(f"{PACKAGE}.") else None
        if importer not in names:
            continue
        for target in graph.find_modules_directly_imported_by(module):
            root, _, rest = target.partition(".")
            imported = rest.split(".")[0] if root == PACKAGE else root
            if imported != importer and imported in names | {FRAMEWORK}:
                found[importer].add(imported)
    return found


def reduce_transitively(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """The edges of an acyclic graph without those that a longer path implies."""

    def reachable(start: str) -> set[str]:
        direct = edges.get(start, set())
        return direct | {node for child in direct for node in reachable(child)}

    return {
        node: {child for child in children if not any(child in reachable(other) for other in children - {child})}
        for node, children in edges.items()
    }


def draw() -> str:
    """The diagram as SVG, without fonts or scripts from elsewhere."""
    found, rows = imports(), layers()
    frameworked = {name for name, targets in found.items() if FRAMEWORK in targets}
    edges = reduce_transitively({name: targets - {FRAMEWORK} for name, targets in found.items()})
    place = _places(rows, edges)
    parts = [_arrow(place[a], place[b]) for a in sorted(edges) for b in sorted(edges[a])]
    parts += [_box(name, *place[name], name in frameworked) for row in rows for name in row]
    height = len(rows) * ROW + 30
    legend = "blue: imports nerfstudio directly; arrows: imports, without those that others imply"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" '
        'font-family="sans-serif" font-size="14">\n'
        '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 L10 5 L0 10 z" fill="#555"/></marker></defs>\n'
        f'<rect width="{WIDTH}" height="{height}" rx="8" fill="#fff"/>\n'
        + "\n".join(parts)
        + f'\n<text x="{WIDTH / 2:g}" y="{height - 14}" text-anchor="middle" font-size="12" fill="#555">{legend}</text>'
        "\n</svg>\n"
    )


def _places(rows: list[list[str]], edges: dict[str, set[str]]) -> dict[str, tuple[float, float]]:
    """Center of each box; within a row, boxes lie near the mean of those that import them."""
    place: dict[str, tuple[float, float]] = {}
    for at, row in enumerate(rows):
        parents = {name: [place[p][0] for p, children in edges.items() if name in children] for name in row}
        middle = {name: sum(xs) / len(xs) if xs else WIDTH / 2 for name, xs in parents.items()}
        ordered = sorted(row, key=lambda name: (middle[name], name))
        for column, name in enumerate(ordered):
            place[name] = (WIDTH * (column + 0.5) / len(row), at * ROW + ROW / 2)
    return place


def _box(name: str, x: float, y: float, frameworked: bool) -> str:
    fill, stroke = ("#d6e6fb", "#2f6db5") if frameworked else ("#f4f4f4", "#888")
    return (
        f'<rect x="{x - BOX_WIDTH / 2:g}" y="{y - BOX_HEIGHT / 2:g}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="5" '
        f'fill="{fill}" stroke="{stroke}"/>'
        f'<text x="{x:g}" y="{y + 5:g}" text-anchor="middle" fill="#111">{escape(name)}</text>'
    )


def _arrow(start: tuple[float, float], end: tuple[float, float]) -> str:
    (x0, y0), (x1, y1) = start, end
    # Arrows over several rows bend around the boxes between.
    spread = (abs(y1 - y0) / ROW - 1) * 62 * (1 if x0 + x1 > WIDTH or x0 == x1 else -1)
    y0, y1 = y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2
    third = (y1 - y0) / 3
    curve = f"M{x0:g} {y0:g} C{x0 + spread:g} {y0 + third:g} {x1 + spread:g} {y1 - third:g} {x1:g} {y1:g}"
    return f'<path d="{curve}" fill="none" stroke="#555" stroke-width="1.3" marker-end="url(#tip)"/>'


if __name__ == "__main__":
    picture = draw()
    if sys.argv[1:] == ["--check"]:
        sys.exit(
            None if PICTURE.read_text() == picture else f"{PICTURE.name} is stale: run python docs/import_diagram.py"
        )
    PICTURE.write_text(picture)
