"""Names of a capture's cameras, from the names of their photos."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import takewhile
from pathlib import PurePosixPath

from ssa_nerfstudio.cameras.intervals import capture_order

_BEFORE_NUMBER = r"[_\-. ]*"
"""What separates a photo's number from what comes before it."""


def camera_names(photos: Sequence[Sequence[str]]) -> list[str]:
    """What the names of each camera's photos begin with, as in front_0001.jpg or images/front/1.jpg: "front".

    Args:
        photos: of each camera, paths relative to the dataset; at least one photo each.

    Returns:
        A name for each camera, unlike the others'. Where their photos' names do not tell them apart, camera_of_ and the
        name of its first photo; camera_0 for the only one.
    """
    if len(photos) == 1:
        return ["camera_0"]
    for name in (_folder, _before_number, _first_words, _first_photo):
        names = [name(each) for each in photos]
        if all(names) and len({*names}) == len(names):
            return names
    return [f"camera_{number}" for number in range(len(photos))]


def camera_of_folder(folder: str) -> str:
    """What the camera is called whose photos are in a folder of this name.

    The dataset's photos are called by it, so that `camera_names` finds it before their numbers.
    """
    name = re.sub(r"[^\w.-]", "_", folder)
    return re.sub(rf"{_BEFORE_NUMBER}$", "", name) or name


def _folder(photos: Sequence[str]) -> str:
    """Folder of all photos below the dataset's images/ or images_2/; empty where there is none."""
    folders = {"_".join(PurePosixPath(photo).parts[1:-1]) for photo in photos}
    return folders.pop() if len(folders) == 1 else ""


def _before_number(photos: Sequence[str]) -> str:
    """What all file names have before the number that counts the photos; empty where they differ."""
    beginnings = {re.sub(rf"{_BEFORE_NUMBER}\d+$", "", PurePosixPath(photo).stem) for photo in photos}
    return beginnings.pop() if len(beginnings) == 1 else ""


def _first_words(photos: Sequence[str]) -> str:
    """Words with which all file names begin, up to the first number."""
    words = [re.findall(r"[^\W\d_]+", re.split(r"\d", PurePosixPath(photo).stem)[0]) for photo in photos]
    return "_".join(each[0] for each in takewhile(lambda each: len({*each}) == 1, zip(*words, strict=False)))


def _first_photo(photos: Sequence[str]) -> str:
    return f"camera_of_{PurePosixPath(min(photos, key=capture_order)).stem}"
