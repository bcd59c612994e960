"""Metrics against torchmetrics, the FLIP evaluator and values worked out by hand."""

from __future__ import annotations

import math

import flip_evaluator
import pytest
import torch
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from ssa_nerfstudio.metrics import image as metrics


def random_pair(
    seed: int = 0, height: int = 23, width: int = 31, noise: float = 0.1
) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator)
    return (target + noise * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), target


IMAGE_METRICS = (metrics.psnr, metrics.ssim, metrics.flip, metrics.mean_color_deviation)


@pytest.mark.parametrize("seed", range(3))
def test_psnr_agrees_with_torchmetrics(seed: int) -> None:
    render, target = random_pair(seed)
    expected = peak_signal_noise_ratio(render.double(), target.double(), data_range=1.0).item()
    assert metrics.psnr(render, target) == pytest.approx(expected, abs=2e-6)


def test_psnr_by_hand() -> None:
    target = torch.full((4, 5, 3), 0.5)
    assert metrics.psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    assert metrics.psnr(torch.zeros(4, 5, 3), torch.ones(4, 5, 3)) == 0.0


@pytest.mark.parametrize("noise", [0.003, 0.1, 0.5])
def test_ssim_agrees_with_torchmetrics(noise: float) -> None:
    render, target = random_pair(noise=noise)
    _, full_image = structural_similarity_index_measure(
        render.double().permute(2, 0, 1)[None],
        target.double().permute(2, 0, 1)[None],
        data_range=1.0,
        return_full_image=True,
    )
    # torchmetrics pads by reflection; what is left without the margin is "valid".
    expected = full_image[..., 5:-5, 5:-5].mean().item()
    assert metrics.ssim(render, target) == pytest.approx(expected, abs=1e-9)


def test_ssim_of_one_window_by_hand() -> None:
    """Two constant images have no variance: only the luminance term is left."""
    dark, bright = torch.full((11, 11, 3), 0.2, dtype=torch.float64), torch.full((11, 11, 3), 0.6, dtype=torch.float64)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert metrics.ssim(dark, bright) == pytest.approx(expected, abs=1e-9)


def test_ssim_does_not_center_windows_in_the_margin() -> None:
    render, target = random_pair(height=21, width=21)
    cornered = render.clone()
    cornered[0, 0] = 1 - cornered[0, 0]
    windows_with_corner = 1 / (11 * 11)
    change = abs(metrics.ssim(cornered, target) - metrics.ssim(render, target))
    assert 0 < change < 1e-3 * windows_with_corner


def test_ssim_refuses_images_smaller_than_its_window() -> None:
    with pytest.raises(ValueError, match="at least 11 x 11"):
        metrics.ssim(torch.zeros(10, 40, 3), torch.zeros(10, 40, 3))


def test_flip_is_the_evaluators_mean() -> None:
    render, target = random_pair()
    _, expected, _ = flip_evaluator.evaluate(target.numpy(), render.numpy(), "LDR", applyMagma=False)
    assert metrics.flip(render, target) == pytest.approx(expected, abs=1e-7)


def test_flip_takes_any_memory_layout_and_precision() -> None:
    render, target = random_pair()
    strided = target.permute(2, 0, 1).contiguous().permute(1, 2, 0).double()
    assert metrics.flip(render, strided) == metrics.flip(render, target)


def test_mean_color_deviation_by_hand() -> None:
    target = torch.full((6, 7, 3), 0.4)
    render = target + torch.tensor([3.0, 4.0, 0.0]) / 255
    assert metrics.mean_color_deviation(render, target) == pytest.approx(5.0, abs=1e-4)


def test_mean_color_deviation_ignores_where_the_colors_are() -> None:
    render, _ = random_pair()
    assert metrics.mean_color_deviation(render.flip(0), render) == pytest.approx(0.0, abs=1e-9)


def test_identical_images() -> None:
    image, _ = random_pair()
    assert metrics.psnr(image, image) == math.inf
    assert metrics.ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    assert metrics.flip(image, image) == 0.0
    assert metrics.mean_color_deviation(image, image) == 0.0


@pytest.mark.parametrize("metric", IMAGE_METRICS)
@pytest.mark.parametrize(
    ("render", "message"),
    [
        (torch.zeros(12, 12), r"render must be a non-empty \[H, W, 3\], got \(12, 12\)"),
        (torch.zeros(12, 12, 4), r"render must be a non-empty \[H, W, 3\]"),
        (torch.zeros(0, 12, 3), "render must be a non-empty"),
        (torch.zeros(12, 13, 3), r"render \(12, 13, 3\) and target \(12, 12, 3\) differ in shape"),
        (torch.zeros(12, 12, 3, dtype=torch.uint8), "render must be floating point"),
        (torch.full((12, 12, 3), torch.nan), "render holds NaN or infinity"),
        (torch.full((12, 12, 3), torch.inf), "render holds NaN or infinity"),
        (torch.full((12, 12, 3), 1.1), r"render must be in \[0, 1\], got values in \[1.1, 1.1\]"),
        (torch.full((12, 12, 3), -0.01), r"render must be in \[0, 1\]"),
    ],
)
def test_bad_images_are_refused(metric, render: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        metric(render, torch.zeros(12, 12, 3))


@pytest.mark.parametrize("metric", IMAGE_METRICS)
def test_rounding_beyond_the_range_is_clipped(metric) -> None:
    ones = torch.ones(12, 12, 3, dtype=torch.float64)
    assert metric(ones + 5e-7, ones) == metric(ones, ones)


def test_inputs_stay_as_they_were() -> None:
    render, target = random_pair()
    copies = render.clone(), target.clone()
    for metric in IMAGE_METRICS:
        metric(render, target)
    assert torch.equal(render, copies[0])
    assert torch.equal(target, copies[1])
