"""Per-pixel statistics of a stream of images, against numpy and exact integers."""

from __future__ import annotations

import gc
import math
import pickle
import weakref
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from torch import Tensor

from ssa_nerfstudio.evidence.brightness import MAX_FINE_BLOCKS
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate

FULL_SCALE = {np.uint8: 255, np.uint16: 65535}
shapes = st.tuples(st.integers(1, 9), st.integers(1, 4), st.integers(1, 4), st.just(3))


@st.composite
def captures(draw: st.DrawFn, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    """Images [V, H, W, 3] and masks [V, H, W] of one capture."""
    shape = draw(shapes)
    elements = None if dtype in FULL_SCALE else st.floats(0, 1, width=32)
    images = draw(npst.arrays(dtype, shape, elements=elements))
    masks = draw(npst.arrays(bool, shape[:3]) | st.just(np.ones(shape[:3], bool)))
    return images, masks


def gather(images: np.ndarray, masks: np.ndarray | None = None) -> ImageStatistics:
    pairs = zip(images, [None] * len(images) if masks is None else masks, strict=True)
    return accumulate(
        (torch.from_numpy(image.copy()), None if mask is None else torch.from_numpy(mask.copy()))
        for image, mask in pairs
    )


def assert_exact(statistics: ImageStatistics, images: np.ndarray, masks: np.ndarray, full_scale: int) -> None:
    """Every pixel against Python's integers, which know no overflow and no rounding."""
    mean, deviation, views = statistics.mean(), statistics.deviation(), statistics.views
    for y, x in np.ndindex(images.shape[1:3]):
        seen = [[int(v) for v in images[i, y, x]] for i in range(len(images)) if masks[i, y, x]]
        n = len(seen)
        assert views[y, x, 0] == n
        if n == 0:
            assert (mean[y, x] == 0.5).all()
        spreads = []
        for channel in range(3 if n else 0):
            values = [value[channel] for value in seen]
            assert mean[y, x, channel].item() == sum(values) / (n * full_scale)
            spreads.append(n * sum(v * v for v in values) - sum(values) ** 2)
        expected = math.sqrt(max(spreads)) / (n * full_scale) if n > 1 else 1.0
        assert deviation[y, x, 0].item() == pytest.approx(expected, rel=4e-16, abs=0)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([np.uint8, np.uint16]).flatmap(lambda dtype: captures(dtype)))
def test_integer_images_are_summed_exactly_with_and_without_masks(capture: tuple[np.ndarray, np.ndarray]) -> None:
    images, masks = capture
    full_scale = FULL_SCALE[images.dtype.type]
    assert_exact(gather(images, masks), images, masks, full_scale)
    assert_exact(gather(images), images, np.ones_like(masks), full_scale)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([np.float32, np.float64]).flatmap(lambda dtype: captures(dtype)))
def test_float_images_have_the_mean_and_deviation_that_numpy_computes(capture: tuple[np.ndarray, np.ndarray]) -> None:
    images, masks = capture
    statistics = gather(images, masks)
    mean, deviation = statistics.mean().numpy(), statistics.deviation().numpy()
    for y, x in np.ndindex(images.shape[1:3]):
        seen = images[masks[:, y, x], y, x].astype(np.float64)
        assert statistics.views[y, x, 0] == len(seen)
        expected = seen.mean(axis=0) if len(seen) else np.full(3, 0.5)
        np.testing.assert_allclose(mean[y, x], expected, rtol=1e-14, atol=1e-15)
        # A variance is the difference of two sums in float64: where it vanishes, its root is right to 1e-7 only.
        spread = seen.std(axis=0).max() if len(seen) > 1 else 1.0
        np.testing.assert_allclose(deviation[y, x], spread, rtol=1e-9, atol=2e-7)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_a_small_deviation_on_a_bright_pixel_is_not_cancelled_away(dtype: type) -> None:
    levels = np.array([0.975, 0.98] * 500) * FULL_SCALE.get(dtype, 1)
    images = np.broadcast_to(levels.astype(dtype)[:, None, None, None], (1000, 1, 1, 3))
    expected = (images.astype(np.float64) / FULL_SCALE.get(dtype, 1)).std(axis=0).max()
    assert gather(images).deviation().item() == pytest.approx(expected, rel=1e-7)


@settings(max_examples=30, deadline=None)
@given(capture=st.sampled_from([np.uint8, np.uint16]).flatmap(lambda dtype: captures(dtype)), random=st.randoms())
def test_the_order_of_the_views_does_not_matter(capture: tuple[np.ndarray, np.ndarray], random) -> None:
    images, masks = capture
    order = list(range(len(images)))
    random.shuffle(order)
    one, other = gather(images, masks), gather(images[order], masks[order])
    assert torch.equal(one.mean(), other.mean())
    assert torch.equal(one.deviation(), other.deviation())
    assert torch.equal(one.views, other.views)


@settings(max_examples=30, deadline=None)
@given(value=st.tuples(*[st.integers(0, 65535)] * 3), count=st.integers(2, 300))
def test_a_constant_pixel_of_integer_images_deviates_by_exactly_zero(value: tuple[int, ...], count: int) -> None:
    wide = torch.tensor(value, dtype=torch.int32).to(torch.uint16).expand(2, 2, 3)
    narrow = torch.tensor([v // 257 for v in value], dtype=torch.uint8).expand(2, 2, 3)
    for image in (wide, narrow):
        statistics = accumulate((image, None) for _ in range(count))
        assert (statistics.deviation() == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_pixel_of_float_images_deviates_by_less_than_any_scale_that_matters(dtype: torch.dtype) -> None:
    image = torch.linspace(0, 1, 300, dtype=dtype).reshape(10, 10, 3)
    assert accumulate((image, None) for _ in range(300)).deviation().max() < 1e-6


def test_a_hot_pixel_deviates_less_than_changing_pixels() -> None:
    images = np.random.default_rng(0).integers(0, 200, (50, 5, 6, 3), dtype=np.uint8)
    images[:, 2, 3] = 255
    statistics = gather(images)
    assert (statistics.mean()[2, 3] == 1).all()
    assert statistics.deviation()[2, 3, 0] == 0
    others = statistics.deviation().flatten()[torch.arange(30) != 2 * 6 + 3]
    assert others.min() > 0.15


def test_alternating_black_and_white_has_the_maximal_deviation_of_one_half() -> None:
    images = np.zeros((10, 3, 2, 3), np.uint8)
    images[::2] = 255
    assert (gather(images).deviation() == 0.5).all()


def test_the_deviation_is_that_of_the_channel_that_varies_most() -> None:
    images = np.full((4, 1, 1, 3), 100, np.uint8)
    images[:2, 0, 0, 1] = 150
    images[:2, 0, 0, 2] = 110
    assert gather(images).deviation().item() == pytest.approx(25 / 255, rel=1e-15)


def test_pixels_that_fewer_than_two_views_show_deviate_by_one() -> None:
    images = np.full((3, 1, 3, 3), 51, np.uint8)
    masks = np.array([[[1, 1, 0]], [[1, 0, 0]], [[1, 0, 0]]], bool)
    statistics = gather(images, masks)
    assert statistics.views[0, :, 0].tolist() == [3, 1, 0]
    assert statistics.deviation()[0, :, 0].tolist() == [0.0, 1.0, 1.0]
    assert statistics.mean()[0, :, 0].tolist() == [0.2, 0.2, 0.5]


def test_masked_pixels_have_no_influence_not_even_as_nan() -> None:
    image = torch.full((2, 2, 3), 0.25)
    broken = image.clone()
    broken[0, 1] = float("nan")
    mask = torch.tensor([[True, False], [True, True]])
    statistics = accumulate([(image, None), (broken, mask), (image, None)])
    assert (statistics.mean() == 0.25).all()
    assert (statistics.deviation() == 0).all()
    assert statistics.views[..., 0].tolist() == [[3, 2], [3, 3]]


def test_a_mask_may_have_a_channel_and_any_dtype() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (4, 5, 3), generator=generator, dtype=torch.uint8)
    mask = torch.rand(4, 5, generator=generator) > 0.5
    for other in (mask[..., None], mask.float(), mask.to(torch.uint8) * 255):
        masked, same = accumulate([(image, mask)]), accumulate([(image, other)])
        assert torch.equal(masked.mean(), same.mean())
        assert torch.equal(masked.views, same.views)
        assert masked.views.sum() == mask.sum()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_an_alpha_channel_is_ignored(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    images = [(torch.rand(4, 5, 4, generator=generator) * 200).to(dtype) for _ in range(3)]
    with_alpha = accumulate((image, None) for image in images)
    without = accumulate((image[..., :3].clone(), None) for image in images)
    assert torch.equal(with_alpha.mean(), without.mean())
    assert torch.equal(with_alpha.deviation(), without.deviation())
    assert with_alpha.mean().shape == (4, 5, 3)


def test_inputs_are_not_modified() -> None:
    image = torch.rand(4, 5, 3, dtype=torch.float64)
    before, mask = image.clone(), torch.rand(4, 5) > 0.5
    accumulate([(image, mask), (image, None)])
    assert torch.equal(image, before)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (
            torch.zeros(4, 6, 3, dtype=torch.uint8),
            r"image of \(4, 6\) torch.uint8 among images of \(4, 5\) torch.uint8",
        ),
        (torch.zeros(5, 4, 3, dtype=torch.uint8), r"image of \(5, 4\)"),
        (torch.zeros(4, 5, 3), r"torch.float32 among images of \(4, 5\) torch.uint8"),
        (torch.zeros(4, 5, 3, dtype=torch.uint16), r"torch.uint16 among images of \(4, 5\) torch.uint8"),
    ],
    ids=["wider", "turned", "float", "uint16"],
)
def test_a_view_of_another_size_or_dtype_is_refused_and_leaves_the_sums_alone(other: Tensor, message: str) -> None:
    statistics = ImageStatistics()
    statistics.add(torch.full((4, 5, 3), 9, dtype=torch.uint8))
    with pytest.raises(ValueError, match=message):
        statistics.add(other)
    assert statistics.size == (4, 5)
    assert (statistics.views == 1).all()
    assert (statistics.mean() == 9 / 255).all()


@pytest.mark.parametrize(
    "ask",
    [lambda s: s.size, lambda s: s.views, lambda s: s.mean(), lambda s: s.deviation()],
    ids=["size", "views", "mean", "deviation"],
)
def test_statistics_without_views_raise(ask: Callable[[ImageStatistics], object]) -> None:
    with pytest.raises(ValueError, match="no image has been added"):
        ask(ImageStatistics())


def test_memory_does_not_grow_with_the_number_of_views() -> None:
    alive: list[weakref.ref[Tensor]] = []
    most = 0

    def stream(count: int) -> Iterator[tuple[Tensor, Tensor | None]]:
        nonlocal most
        for index in range(count):
            image = torch.full((6, 7, 3), index % 256, dtype=torch.uint8)
            alive.append(weakref.ref(image))
            most = max(most, sum(reference() is not None for reference in alive[-20:]))
            yield image, None

    few = accumulate(stream(MAX_FINE_BLOCKS))
    many = accumulate(stream(2000))
    gc.collect()
    assert most <= 2
    assert not any(reference() is not None for reference in alive)
    assert len(pickle.dumps(many)) <= len(pickle.dumps(few)) + 8, "more than a counter's digits"
    assert (many.views == 2000).all()


def test_sums_are_exact_beyond_what_32_bits_hold() -> None:
    """70,000 views, half of them white: their squares add up to 2.3e9, more than 2^31."""
    statistics = ImageStatistics()
    white, black = torch.full((1, 1, 3), 255, dtype=torch.uint8), torch.zeros(1, 1, 3, dtype=torch.uint8)
    for _ in range(35_000):
        statistics.add(white)
        statistics.add(black)
    assert (statistics.mean() == 0.5).all()
    assert (statistics.deviation() == 0.5).all()
    assert (statistics.views == 70_000).all()
