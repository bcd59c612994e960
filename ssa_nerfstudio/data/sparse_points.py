"""The sparse points of a dataset: written, read, and refused where a training would start from something else."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ssa_nerfstudio._system.named_pipes import refuse_pipe
from ssa_nerfstudio.errors import InputError

_REMEDY = "make it again, or remove ply_file_path from transforms.json to start from random points"
_HEADER = 1 << 16
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_NEEDED = ("x", "y", "z", "red", "green", "blue")


def write_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write positions [N, 3] and colors uint8 [N, 3] as binary PLY: float x, y, z and uchar red, green, blue."""
    table = np.empty(len(points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    table["xyz"], table["rgb"] = points, colors
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.tobytes())


def check_points(path: Path) -> None:
    """Check that a PLY file holds as many colored points as it states, at least one of them at a finite place.

    open3d, which nerfstudio reads it with, gives no points where the header is broken and zeros for points that are
    cut off.

    Raises:
        InputError: see `read_points`.
    """
    read_points(path)


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions [N, 3], of which single ones may not be finite, and colors uint8 [N, 3] from a PLY file.

    Raises:
        InputError: the file is missing, no PLY, empty or truncated, a value is no number, or no point is finite.
    """
    try:
        refuse_pipe(path)
        with path.open("rb") as file:
            head = file.read(_HEADER)
            header, end, _ = head.partition(b"end_header\n")
            file.seek(len(header) + len(end))
            kind, count, properties = _vertices(header.decode("ascii").split("\n")) if end else ("", 0, {})
            if not kind:
                raise ValueError("its header is not that of a PLY file that starts with vertices")
            if count < 1:
                raise ValueError("it holds no points")
            if missing := sorted({*_NEEDED} - properties.keys()):
                raise ValueError(f"its points have no {', '.join(missing)}")
            table = _columns(file, kind, count, properties)
            if len(table) < count:
                raise ValueError(f"it holds {len(table)} of the {count} points that it states")
            points, colors = table[:, :3], table[:, 3:]
            if not np.isfinite(points).all(axis=1).any():  # a training leaves single ones out
                raise ValueError(f"none of its {count} points is finite")
            return points, colors.astype(np.uint8)
    except (OSError, ValueError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(f"{path} cannot be read as sparse points ({reason})", _REMEDY) from error


def _columns(file: BinaryIO, kind: str, count: int, properties: dict[str, str]) -> np.ndarray:
    """Read place and color [N, 6] of up to `count` vertices; ValueError where a value is no number."""
    if kind == "ascii":
        places = [list(properties).index(axis) for axis in _NEEDED]
        rows = (line.split() for line, _ in zip(file, range(count), strict=False))
        rows = [[float(row[place]) for place in places] for row in rows if len(row) >= len(properties)]
        return np.array(rows, dtype=np.float64).reshape(-1, len(_NEEDED))
    order = ">" if "big" in kind else "<"
    kinds = np.dtype([(name, f"{order}{kind}") for name, kind in properties.items()])
    whole = min(count, (os.fstat(file.fileno()).st_size - file.tell()) // kinds.itemsize)
    table = np.frombuffer(file.read(whole * kinds.itemsize), kinds)
    return np.stack([table[axis].astype(np.float64) for axis in _NEEDED], axis=1)


def _vertices(header: list[str]) -> tuple[str, int, dict[str, str]]:
    """Format, number and properties of the vertices; the format is empty where they are not the first element."""
    kind, count, properties, elements = "", 0, {}, 0
    if header[0].strip() != "ply":
        return "", 0, {}
    for words in map(str.split, header):
        match words:
            case ["format", kind, _]:
                pass
            case ["element", name, number]:
                elements += 1
                if elements == 1 and name != "vertex":
                    return "", 0, {}
                count = int(number) if elements == 1 else count
            case ["property", type_name, name] if elements == 1:
                properties[name] = _TYPES.get(type_name, "f4")
    return kind, count, properties
