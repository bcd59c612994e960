"""Hard cases of the statistics of a capture and of the overlay that is initialized from them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hard_cases import Case, Family
from torch import Tensor

from ssa_nerfstudio.evidence.detection import detect
from ssa_nerfstudio.evidence.initialization import estimate, guide_of, initialize, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.point_samples import View, sample_points
from ssa_nerfstudio.evidence.present_area import present_area
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay

STATISTICS = Family("Statistics and start")
SIZE = (6, 8, 3)


def photos(views: int, size: tuple[int, int, int] = SIZE, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (views, *size), dtype=np.uint8)


def on_device(array: np.ndarray | list) -> Tensor:
    """A tensor on the default device."""
    return torch.from_numpy(np.asarray(array)).to(torch.get_default_device())


def started(statistics: ImageStatistics, resolution: int = 1) -> ScreenSpaceOverlay:
    """Initialize an overlay from the statistics and check it: finite, its matte in range, its gradients not zero."""
    overlay = ScreenSpaceOverlay(*statistics.size, resolution)
    initialize(overlay, statistics)
    transmittance, addition = overlay.layers()
    (transmittance.sum() + addition.sum()).backward()
    for parameter in overlay.parameters():
        assert torch.isfinite(parameter).all()
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()
    assert overlay.alpha_logits.grad is not None
    assert (overlay.alpha_logits.grad != 0).all()
    assert torch.isfinite(overlay.evidence).all()
    assert 0 <= overlay.evidence.min() <= overlay.evidence.max() <= 1
    assert 0.0099 <= overlay.matte().min() <= overlay.matte().max() <= 0.9901
    return overlay


def stream(images: np.ndarray | list, masks: list | None = None) -> ImageStatistics:
    masks = masks or [None] * len(images)
    return accumulate(
        (on_device(image), None if mask is None else on_device(mask)) for image, mask in zip(images, masks, strict=True)
    )


def exact(images: np.ndarray, full: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and largest deviation in float64, in two passes."""
    values = images.astype(np.float64) / full
    return values.mean(axis=0), values.std(axis=0).max(axis=-1, keepdims=True)


@STATISTICS.case("one photo many times", "exp(-0) is exactly 1, whose logit is infinite.")
def _() -> None:
    overlay = started(stream([photos(1)[0]] * 9))
    torch.testing.assert_close(overlay.matte(), torch.full((6, 8, 1), 0.99))


@STATISTICS.case("black photos", "A mean of 0 has a logit of minus infinity.", 0)
@STATISTICS.case("white photos", "A mean of 1 has a logit of infinity.", 255)
def _flat(value: int) -> None:
    overlay = started(stream(np.full((5, *SIZE), value, np.uint8)))
    assert (overlay.color() - value / 255).abs().max() < 1 / 500


@STATISTICS.case("one bit of noise", "E[x^2] - E[x]^2 in float32 would be rounding error, or negative.", 200)
@STATISTICS.case("one bit of noise on black", "The smallest deviation there is must not vanish.", 0)
def _bit(base: int) -> None:
    noisy = np.full((40, *SIZE), base, np.uint8) + (photos(40) % 2)
    statistics = stream(noisy)
    np.testing.assert_allclose(statistics.deviation().numpy(force=True), exact(noisy, 255)[1], rtol=1e-12)
    started(statistics)


@STATISTICS.case("two views", "The fewest views there can be: a deviation over n - 1 would be over 1.")
def _() -> None:
    pair = photos(2)
    np.testing.assert_allclose(stream(pair).deviation().numpy(force=True), exact(pair, 255)[1], rtol=1e-12)
    started(stream(pair))


@STATISTICS.case("a single view", "It agrees with itself everywhere and would make the whole photo an artifact.")
def _() -> None:
    assert started(stream(photos(1))).matte().max() < 0.011


@STATISTICS.case("10000 views of 8 bits", "Sums of squares exceed 32 bits, or float32 stops counting at 16 million.")
def _() -> None:
    statistics = ImageStatistics()
    ramp = np.arange(10_000) % 256
    for value in ramp:
        statistics.add(torch.full(SIZE, int(value), dtype=torch.uint8))
    np.testing.assert_allclose(statistics.mean().numpy(force=True), ramp.mean() / 255, rtol=1e-12)
    np.testing.assert_allclose(statistics.deviation().numpy(force=True), ramp.std() / 255, rtol=1e-12)
    started(statistics)


@STATISTICS.case("10000 white views", "The largest sums that 8 bits give: an overflow would show as a deviation.")
def _() -> None:
    statistics = ImageStatistics()
    white = torch.full((2, 3, 3), 255, dtype=torch.uint8)
    for _ in range(10_000):
        statistics.add(white)
    assert statistics.deviation().max() == 0
    assert statistics.mean().min() == 1


@STATISTICS.case("photos of 16 bits", "Squares of 16 bits exceed 32 bits at the second photo.")
def _() -> None:
    deep = np.random.default_rng(1).integers(0, 65536, (300, *SIZE), dtype=np.uint16)
    statistics = stream(deep)
    mean, deviation = exact(deep, 65535)
    np.testing.assert_allclose(statistics.mean().numpy(force=True), mean, rtol=1e-12)
    np.testing.assert_allclose(statistics.deviation().numpy(force=True), deviation, rtol=1e-12)
    started(statistics)


@STATISTICS.case("photos in floating point", "Their deviation must be that of the photos in 8 bits.", 1.0)
@STATISTICS.case("floating point and almost no noise", "1e-4 of noise on 0.9 is lost in float32.", 1e-4)
def _float(noise: float) -> None:
    values = (0.9 - noise * np.random.default_rng(2).random((50, *SIZE)) * 0.9).astype(np.float32)
    statistics = stream(values)
    np.testing.assert_allclose(statistics.deviation().numpy(force=True), exact(values, 1.0)[1], rtol=1e-6)
    started(statistics)


@STATISTICS.case("a hot pixel", "A sensor's hot pixel is static and is to become artifact; its neighbors are not.")
def _() -> None:
    noisy = photos(60)
    noisy[:, 3, 4] = 255
    matte = started(stream(noisy)).matte()[..., 0]
    assert matte[3, 4] > 0.98
    matte[3, 4] = 0
    assert matte.max() < 0.05


@STATISTICS.case("masks that cover all", "Sums over no view: a mean of 0 / 0 and a matte of 1.", 0)
@STATISTICS.case("masks that leave one view", "A pixel seen once agrees with itself and would become artifact.", 1)
def _masks(seen: int) -> None:
    masks = [np.full(SIZE[:2], k < seen) for k in range(5)]
    statistics = stream(photos(5), masks)
    assert (statistics.views == seen).all()
    assert started(statistics).matte().max() < 0.011


@STATISTICS.case("masks of half the frame", "What is masked must not change what is seen.")
def _() -> None:
    images, mask = photos(7), np.zeros(SIZE[:2], bool)
    mask[:, :4] = True
    spoilt = images.copy()
    spoilt[:, :, 4:] = photos(7, seed=9)[:, :, 4:]
    a, b = (started(stream(part, [mask] * 7)) for part in (images, spoilt))
    assert torch.equal(a.matte(), b.matte())
    assert torch.equal(a.color(), b.color())


@STATISTICS.case("a frame of one pixel", "No window, no edge and no neighbor exists.", (1, 1, 3))
@STATISTICS.case("a frame of one row", "Gradients across rows do not exist.", (1, 9, 3))
@STATISTICS.case("a frame of one column", "Gradients along rows do not exist.", (9, 1, 3))
def _small(size: tuple[int, int, int]) -> None:
    started(stream(photos(12, size)))


@STATISTICS.case(
    "an odd frame at half resolution", "The last column has half a block and would be averaged with nothing.", 2
)
@STATISTICS.case("an odd frame at a quarter", "Three quarters of the last block are missing.", 4)
def _reduced(resolution: int) -> None:
    overlay = started(stream(np.full((3, 7, 9, 3), 100, np.uint8)), resolution)
    assert (overlay.color() - 100 / 255).abs().max() < 1e-5


@STATISTICS.case(
    "frames of two sizes", "A photo of another size would be summed into the wrong pixels.", torch.zeros(5, 8, 3)
)
@STATISTICS.case(
    "photos of two depths", "0 to 255 and 0 to 65535 would be added.", torch.zeros(SIZE, dtype=torch.uint16)
)
def _mixed(stranger: Tensor) -> None:
    statistics, stranger = stream(photos(2)), stranger.to(torch.get_default_device())
    before = statistics.mean()
    try:
        statistics.add(stranger.to(torch.uint8) if stranger.dtype == torch.float32 else stranger)
    except ValueError:
        assert torch.equal(statistics.mean(), before)
    else:
        raise AssertionError("it was taken")


@STATISTICS.case("almost everything static", "A matte of 1 nearly everywhere, with a weight of 0 in the sparsity loss.")
def _() -> None:
    images = np.repeat(photos(1), 20, axis=0)
    images[:, 0, 0] = photos(20)[:, 0, 0]
    started(stream(images))


SCENE = (24, 32, 3)


@STATISTICS.case(
    "evidence of one photo many times", "Mean gradients over a standard error of 0.", np.repeat(photos(1, SCENE), 8, 0)
)
@STATISTICS.case("evidence of black photos", "No gradient at all is 0 / 0.", np.zeros((8, *SCENE), np.uint8))
@STATISTICS.case("evidence of two views", "The standard error of two numbers.", photos(2, SCENE))
def _detected(images: np.ndarray) -> None:
    found = detect(stream(images), draws=20)
    numbers = {name: value for name, value in vars(found).items() if isinstance(value, float)}
    assert numbers
    assert all(np.isfinite(value) for value in numbers.values()), numbers


def estimated(points: Tensor, images: np.ndarray, masks: list | None = None) -> LayerEstimate:
    """Estimate layers from points in front of a camera that looks along z in every view; and start an overlay."""
    K = torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 3.0], [0.0, 0.0, 1.0]])
    torn = [None if mask is None else on_device(mask) for mask in masks or [None] * len(images)]
    views = [View(on_device(image), mask, torch.eye(4), K) for image, mask in zip(images, torn, strict=True)]
    statistics = stream(images, masks)
    nowhere = torch.zeros(statistics.size, dtype=torch.bool)
    found = estimate(sample_points(points, views, guide_of(statistics)), guide_of(statistics), nowhere, nowhere)
    for layer in (found.transmittance, found.addition):
        assert torch.isfinite(layer).all()
        assert 0 <= layer.min() <= layer.max() <= 1
    for light in (False, True):
        overlay = ScreenSpaceOverlay(*statistics.size, adds_light=light)
        initialize_from(overlay, found, guide_of(statistics))
        assert all(torch.isfinite(parameter).all() for parameter in overlay.parameters())
    assert 0 <= found.share() <= 1
    assert found.adds_light(present_area(found.opacity(), nowhere)) in (False, True)
    return found


def scattered(count: int = 40) -> Tensor:
    """Points in the frame, at depths of 1 to 3."""
    points = torch.rand(count, 3, generator=torch.Generator("cpu").manual_seed(0), device="cpu") - 0.5
    points[:, 2] = 2 + 2 * points[:, 2]
    return points.to(torch.get_default_device())


@STATISTICS.case("points in photos of one color", "Colors without variance: a regression over 0 / 0.")
def _() -> None:
    found = estimated(scattered(), np.full((5, *SIZE), 130, np.uint8))
    assert found.transmittance.max() < 0.1, "what varies nowhere shows no scene"


@STATISTICS.case("a single point", "Every pixel but one is without a sample.")
def _() -> None:
    found = estimated(torch.tensor([[0.0, 0.0, 2.0]]), photos(6))
    assert found.transmittance.min() > 0.9


@STATISTICS.case("many points at one pixel", "A pixel's block of equations is singular within rounding.")
def _() -> None:
    estimated(torch.tensor([[0.0, 0.0, 2.0]]).repeat(20_000, 1), photos(6))


@STATISTICS.case("points seen once", "A point of one sample vouches for itself: its color is the photo.")
def _() -> None:
    found = estimated(scattered(), photos(1))
    assert found.transmittance.min() > 0.9


@STATISTICS.case("points at the camera and at infinity", "Depths of 0, 1e30 and infinity divide and overflow.")
def _() -> None:
    odd = torch.tensor([[0.0, 0.0, 0.0], [1e30, 0.0, 1e30], [torch.inf, 0.0, 1.0], [0.0, torch.nan, 1.0], [0, 0, -1.0]])
    estimated(torch.cat([odd, scattered()]), photos(6))


@STATISTICS.case("points behind masks that leave one view", "Samples of pixels that are seen once.")
def _() -> None:
    masks = [np.full(SIZE[:2], view == 0) for view in range(5)]
    estimated(scattered(), photos(5), masks)


@STATISTICS.case("points in black and white photos", "Layers at the ends of the range, whose logits are infinite.")
def _() -> None:
    images = np.zeros((6, *SIZE), np.uint8)
    images[3:] = 255
    estimated(scattered(), images)


@STATISTICS.case("points in a frame of one pixel", "No neighbor to be like, no window to guide the upsampling.")
def _() -> None:
    estimated(torch.tensor([[-0.9, -0.7, 2.0]]), photos(6, (1, 1, 3)))


@STATISTICS.parametrize
def test_statistics_and_start(case: Case) -> None:
    case.check()


@pytest.mark.stability
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@STATISTICS.parametrize
def test_statistics_and_start_on_cuda(case: Case) -> None:
    """As where nerfstudio caches the photos on the GPU."""
    with torch.device("cuda"):
        case.check()
