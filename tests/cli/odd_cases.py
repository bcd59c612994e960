"""The corpus of odd cases in odd_calls/: read from YAML, and applied to datasets."""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from PIL import Image

CORPUS = Path(__file__).parent / "odd_calls"


class Raw(str):
    """Text that is written into JSON as it is."""


class Pipe:
    """A named pipe in place of a file: whoever opens it waits for ever."""


class Sparse(int):
    """So many bytes that are 0 and take no room on the disk."""


def bomb(key: str) -> str:
    """YAML of a few lines whose aliases stand for 9^9 values."""
    lists = [f"a{n}: &a{n} [{', '.join(9 * [f'*a{n - 1}' if n else 'x'])}]" for n in range(9)]
    return "\n".join([*lists, f"{key}: *a8"])


def write(path: Path, content: str | bytes | Pipe | Sparse) -> None:
    """Make a file, and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, Pipe):
        os.mkfifo(path)
    elif isinstance(content, Sparse):
        path.touch()
        os.truncate(path, content)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


_MADE = {
    "raw": Raw,
    "digits": lambda count: Raw("9" * int(count)),
    "nested": lambda depth: Raw("[" * int(depth) + "]" * int(depth)),
    "long": lambda length: "a" * int(length),
    "bytes": bytes.fromhex,
    "bomb": bomb,
    "pipe": lambda _: Pipe(),
    "sparse": Sparse,
}
"""Values that YAML cannot state, or not briefly, by tag."""


class _Loader(yaml.SafeLoader):
    """YAML with the tags of `_MADE`."""


_Loader.add_multi_constructor("!", lambda _, tag, node: _MADE[tag](node.value))


def corpus(name: str) -> list[dict[str, Any]]:
    """The cases of one file."""
    return yaml.load((CORPUS / f"{name}.yaml").read_text(encoding="utf-8"), Loader=_Loader)


def edit_json(path: Path, case: dict[str, Any]) -> None:
    """Do to a JSON file what a case says."""
    if "link" in case:
        path.unlink()
        path.symlink_to(case["link"])
        return
    if (text := case.get("text")) is not None:
        write(path, text)
        return
    content = json.loads(path.read_text())
    if case.get("unsplit"):
        content = {key: value for key, value in content.items() if not key.endswith("_filenames")}
    raw: list[Raw] = []
    for where, value in case.get("set", {}).items():
        if isinstance(value, Raw):
            raw.append(value)
            value = f"raw {len(raw) - 1}"
        holder, key = _place(content, where)
        holder[key] = value
    for where in case.get("remove", []):
        holder, key = _place(content, where)
        del holder[key]
    if "every_frame" in case:
        for frame in content["frames"]:
            frame.update(case["every_frame"])
    text = json.dumps(content)
    for number, value in enumerate(raw):
        text = text.replace(f'"raw {number}"', value)
    path.write_text(text)


def edit_checkpoint(path: Path, case: dict[str, Any]) -> None:
    """Do to a checkpoint what a case says."""
    if "folder" in case:
        path.unlink()
        path.mkdir()
        return
    if case.keys() & {"set", "remove", "value", "hostile", "empty", "remove_overlay"}:
        torch.save(_edited(torch.load(path, weights_only=False), case), path)
        return
    content = bytearray(path.read_bytes()[: case.get("cut")])
    for share in case.get("flip", []):
        content[int(share * len(content))] ^= 0xFF
    path.write_bytes(case["content"].encode() if "content" in case else content)


def edit_photo(path: Path, case: dict[str, Any]) -> None:
    """Do to a photo what a case says."""
    content = path.read_bytes()
    if "save" in case:
        photo, how = Image.open(path), {"mode": "RGB", "format": "PNG", **case["save"]}
        if how["mode"] == "I;16":
            photo = Image.fromarray(np.full((photo.height, photo.width), 999, np.uint16))
        elif how["mode"] == "RGBA":
            photo.putalpha(128)
        elif how["mode"] == "LAB":
            photo = Image.frombytes("LAB", photo.size, photo.tobytes())
        else:
            photo = photo.resize(how.get("size", photo.size)).convert(how["mode"])
        photo.save(path, format=how["format"])
        return
    path.unlink()
    if "folder" in case:
        path.mkdir()
    elif "link" in case:
        path.symlink_to(case["link"])
    elif "pipe" in case:
        os.mkfifo(path)
    elif "content" in case:
        path.write_bytes(case["content"] if isinstance(case["content"], bytes) else case["content"].encode())
    elif "stated" in case:
        header = content[12:16] + struct.pack(">II", *case["stated"]) + content[24:29]
        path.write_bytes(content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:])
    elif "cut" in case:
        path.write_bytes(content[: int(case["cut"] * len(content))])


class _Hostile:
    """Runs a command where it is unpickled."""

    def __reduce__(self) -> tuple:
        return os.system, ("touch hostile-code-ran",)


def _edited(saved: dict[str, Any], case: dict[str, Any]) -> Any:
    if "value" in case:
        return case["value"]
    if "hostile" in case:
        return {**saved, "step": _Hostile()}
    state = saved["pipeline"]
    if "empty" in case:
        saved["pipeline"] = state = {name: v[:0] if "gauss" in name else v for name, v in state.items()}
    if "remove_overlay" in case:
        saved["pipeline"] = {name: v for name, v in state.items() if "artifacts" not in name}
    for where, value in case.get("set", {}).items():
        holder, key = _place(saved, where, "/")
        if isinstance(value, dict) and "shape" in value:
            kind = getattr(torch, value.get("dtype", "float32"))
            value = torch.full(value["shape"], value.get("fill", 0), dtype=kind)
        holder[key] = value
    for where in case.get("remove", []):
        holder, key = _place(saved, where, "/")
        del holder[key]
    return saved


def _place(content: Any, where: str, separator: str = ".") -> tuple[Any, Any]:
    *parents, last = (int(key) if key.isdecimal() else key for key in where.split(separator))
    for key in parents:
        content = content[key]
    return content, last
