"""Blocks of neighboring views: their means against plain averages, however many views and whatever their type."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.evidence.brightness import MAX_BLOCKS, MAX_FINE_BLOCKS, WORKING_SIZE, BrightnessBlocks


def noise(views: int, height: int, width: int) -> torch.Tensor:
    values = np.random.default_rng(views * height * width).integers(0, 256, (views, height, width, 3))
    return torch.from_numpy(values).to(torch.int32)


@settings(max_examples=25, deadline=None)
@given(views=st.integers(1, 100))
def test_blocks_hold_neighboring_views_and_all_of_equal_number(views):
    images = noise(views, 3, 4)
    blocks = BrightnessBlocks(3, 4)
    for image in images:
        blocks.add(image, None)
    means, seen = blocks.means()
    size = 1
    while size * MAX_BLOCKS < views:
        size *= 2
    expected = [chunk.double().mean(dim=(0, 3)) for chunk in images.split(size)]
    if len(expected) > 2 and len(images.split(size)[-1]) < size / 2:
        expected.pop()
    assert len(means) == len(expected) <= MAX_BLOCKS
    torch.testing.assert_close(means, torch.stack(expected))
    assert seen.all()


def test_chosen_blocks_are_joined_as_neighbors():
    images = noise(100, 3, 4)
    blocks = BrightnessBlocks(3, 4)
    for image in images:
        blocks.add(image, None)
    assert (len(blocks), blocks.views_per_block) == (50, 2)
    (mean,), _ = blocks.means([7])
    torch.testing.assert_close(mean, images[14:16].double().mean(dim=(0, 3)))
    joined, _ = blocks.means([*range(10), *range(40, 50)])
    assert len(joined) == 10
    torch.testing.assert_close(joined[5], images[80:84].double().mean(dim=(0, 3)))


def test_large_frames_are_reduced_by_box_filtering():
    height, width = WORKING_SIZE + 3, WORKING_SIZE * 3 + 2
    image = noise(1, height, width)[0]
    blocks = BrightnessBlocks(height, width)
    blocks.add(image, None)
    means, _ = blocks.means()
    assert blocks.reduction == 3
    assert means.shape == (1, height // 3, width // 3)
    torch.testing.assert_close(means[0, 5, 7], image[15:18, 21:24].double().mean())


def test_masked_pixels_do_not_count():
    images = noise(2, 2, 3)
    seen = torch.tensor([[1, 0, 0], [1, 1, 0]], dtype=torch.bool)[..., None]
    blocks = BrightnessBlocks(2, 3)
    blocks.add(images[0] * seen, seen)
    means, visible = blocks.means()
    assert torch.equal(visible[0], seen[..., 0])
    torch.testing.assert_close(means[0, 1, 1], images[0, 1, 1].double().mean())
    assert means[0, 0, 2] == 0


@pytest.mark.parametrize("size", [(1, 1), (1, 2000), (2000, 1)])
def test_strips_and_single_pixels_are_accepted(size):
    blocks = BrightnessBlocks(*size)
    image = noise(1, *size)[0]
    blocks.add(image, None)
    means, _ = blocks.means()
    torch.testing.assert_close(means.mean(), image.double().mean(), rtol=0.02, atol=0)


def test_memory_does_not_grow_with_the_number_of_views():
    blocks = BrightnessBlocks(4, 4)
    image = noise(1, 4, 4)[0]
    for _ in range(1000):
        blocks.add(image, None)
    held = sum(block.numel() for kept in vars(blocks).values() if isinstance(kept, list) for block in kept)
    assert held <= MAX_FINE_BLOCKS * (16 + 1)
    means, _ = blocks.means()
    torch.testing.assert_close(means, image.double().mean(dim=-1).expand_as(means))
