"""Where a real artifact is: masks of the raw frame, by which renders and mattes are scored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ssa_nerfstudio.cameras.lens import Lens, undistort, undistorted_lens
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.metrics.artifact_region import MARGIN, ArtifactRegion

STRAIGHT = Lens(120, 90, 100.0, 100.0, 60.0, 45.0)
BENT = Lens(120, 90, 100.0, 100.0, 60.0, 45.0, (-0.25, 0.0, 0.0, 0.0, 0.0, 0.0))


def bar(path: Path, height: int = 90, width: int = 120) -> Path:
    """A mask whose lower third is white."""
    mask = np.zeros((height, width), np.uint8)
    mask[height * 2 // 3 :] = 255
    Image.fromarray(mask).save(path)
    return path


def test_the_margin_belongs_to_neither_side(tmp_path):
    region = ArtifactRegion.read(bar(tmp_path / "mask.png"), STRAIGHT)
    assert region.inside.any(dim=1).nonzero().min() == 60
    assert region.outside.any(dim=1).nonzero().max() == 60 - MARGIN - 1


def test_a_mask_of_the_full_size_serves_reduced_photos(tmp_path):
    region = ArtifactRegion.read(bar(tmp_path / "mask.png", 360, 480), STRAIGHT)
    assert region.inside.any(dim=1).nonzero().min() == 60
    assert region.outside.any(dim=1).nonzero().max() == 60 - MARGIN // 4 - 1


def test_the_region_is_where_undistorted_photos_show_the_artifact(tmp_path):
    region = ArtifactRegion.read(bar(tmp_path / "mask.png"), BENT)
    target = undistorted_lens(BENT)
    photo = undistort(np.repeat(np.asarray(Image.open(tmp_path / "mask.png"))[..., None], 3, axis=2), BENT)
    assert region.inside.shape == (target.height, target.width) == photo.shape[:2]
    assert (photo[region.outside.numpy()] == 0).all()
    assert (photo[region.inside.numpy()] >= 127).all()


def test_an_error_counts_on_its_own_side(tmp_path):
    region = ArtifactRegion.read(bar(tmp_path / "mask.png"), STRAIGHT)
    target = torch.full((90, 120, 3), 0.5)
    render = target.clone()
    render[region.inside] += 0.1
    values = region.view_metrics({"rgb": render}, target)
    assert values["inside_psnr"] == pytest.approx(20.0, abs=1e-3)
    assert values["outside_psnr"] == float("inf")


@pytest.mark.parametrize("factor", [1, 2])
def test_mattes_are_averaged_by_side_at_any_resolution(tmp_path, factor):
    region = ArtifactRegion.read(bar(tmp_path / "mask.png"), STRAIGHT)
    matte = torch.zeros(90 // factor, 120 // factor)
    matte[60 // factor :] = 0.75
    matte[: 30 // factor] = 0.25
    mattes = region.mattes(matte)
    rows_outside = 60 - MARGIN
    assert mattes["matte_inside"] == pytest.approx(0.75)
    assert mattes["matte_upper_third"] == pytest.approx(0.25)
    assert mattes["matte_outside"] == pytest.approx(0.25 * 30 / rows_outside)
    assert set(region.mattes(None).values()) == {0.0}


def test_a_mask_that_is_no_picture_is_refused(tmp_path):
    (tmp_path / "mask.png").write_text("white")
    with pytest.raises(InputError, match=r"mask\.png cannot be read as a mask"):
        ArtifactRegion.read(tmp_path / "mask.png", STRAIGHT)
