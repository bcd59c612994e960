"""What other programs expect of a dataset with masks: folders, names, polarity, lens; each with its source.

In all of them white is used and black is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

Program = Literal["nerfstudio", "colmap", "lichtfeld", "brush", "3dgrut", "postshot"]


@dataclass(frozen=True)
class Preset:
    """One program's dataset."""

    title: str
    """The program's name."""
    frame: Literal["raw", "undistorted"]
    """Frame that photos are written in, unless asked otherwise."""
    mask: str | None
    """Path of a photo's mask; {folder}, {stem} and {name} are those of the photo below images/. None: the mask is the
    photo's alpha channel."""
    start: str
    """Command that starts the program in the dataset's folder."""
    note: str
    """What else to know."""
    sources: tuple[str, ...]
    """Where the program documents or implements it."""
    lenses: tuple[str, ...] = ("perspective", "fisheye")
    """Models of distorted lenses whose raw photos it reads, as `Lens.model`."""

    def mask_path(self, photo: PurePosixPath) -> PurePosixPath | None:
        """Where a photo's mask goes, given the photo's path below images/; None: into its alpha channel."""
        if self.mask is None:
            return None
        return PurePosixPath(self.mask.format(folder=photo.parent, stem=photo.stem, name=photo.name))


_COLMAP_FAQ = "https://colmap.github.io/faq.html#mask-image-regions"
PRESETS: dict[Program, Preset] = {
    "nerfstudio": Preset(
        title="nerfstudio",
        frame="raw",
        mask="masks/{folder}/{stem}.png",
        start="ns-train splatfacto --data .",
        note="transforms.json names each photo's mask as mask_path. nerfstudio undistorts photos and masks itself.",
        sources=("https://docs.nerf.studio/quickstart/data_conventions.html#masks",),
    ),
    "colmap": Preset(
        title="COLMAP",
        frame="raw",
        mask="masks/{folder}/{name}.png",
        start="colmap feature_extractor --database_path database.db --image_path images --ImageReader.mask_path masks",
        note="A mask is called as its photo, with .png after the photo's own suffix. sparse/0 holds the poses.",
        sources=(_COLMAP_FAQ,),
    ),
    "lichtfeld": Preset(
        title="LichtFeld Studio",
        frame="undistorted",
        mask="masks/{folder}/{stem}.png",
        start="LichtFeld-Studio -d . -o output --mask-mode ignore",
        note="Masks count only with --mask-mode ignore; in the window: Mask Mode, Ignore.",
        sources=(
            "https://github.com/MrNeRF/LichtFeld-Studio, src/io/include/io/filesystem_utils.hpp (MaskDirCache)",
            "https://github.com/MrNeRF/LichtFeld-Studio/issues/547",
        ),
    ),
    "brush": Preset(
        title="Brush",
        frame="undistorted",
        mask="masks/{folder}/{stem}.png",
        start="brush . --with-viewer",
        note="Brush finds the masks by their names, without an option.",
        sources=(
            "https://github.com/ArthurBrussee/brush#training",
            "https://github.com/ArthurBrussee/brush/blob/main/crates/brush-dataset/src/formats/mod.rs (find_mask_path)",
        ),
    ),
    "3dgrut": Preset(
        title="3DGRUT",
        frame="undistorted",
        mask="images/{folder}/{stem}_mask.png",
        start="python train.py --config-name apps/colmap_3dgut.yaml path=$PWD out_dir=runs experiment_name=masked",
        note="To be called in 3DGRUT's folder, with path= this one. Masks lie beside the photos. Of lenses it reads "
        "PINHOLE, SIMPLE_RADIAL and OPENCV_FISHEYE.",
        sources=(
            "https://github.com/nv-tlabs/3dgrut/blob/main/threedgrut/datasets/dataset_colmap.py",
            "https://github.com/nv-tlabs/3dgrut/issues/61",
        ),
        lenses=("fisheye",),
    ),
    "postshot": Preset(
        title="Postshot",
        frame="undistorted",
        mask=None,
        start="postshot-cli train --import images --import sparse/0 --treat-zero-alpha-as-mask true "
        "--output project.psht",
        note="The mask is each photo's alpha channel. In the window: import images and sparse/0 together, and check "
        "Treat Zero Alpha as Mask.",
        sources=(
            "postshot-cli train --help of 0.6.0: regions with zero alpha are ignored with --treat-zero-alpha-as-mask",
            "https://www.jawset.com/docs/d/Postshot+User+Guide",
        ),
        lenses=(),
    ),
}
"""By the name that `--for` takes."""
