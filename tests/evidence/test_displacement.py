"""The share of the views' deviations that a displacement explains."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from ssa_nerfstudio.evidence.displacement import displaced_share


def test_displacement_explains_moved_clouds_and_neither_noise_nor_exposure():
    """Of noise, a displacement of two parameters explains two of 21 x 21 pixels by chance."""
    rng = np.random.default_rng(0)
    clouds = cv2.GaussianBlur(rng.random((96, 128)), (0, 0), 5)
    clouds = torch.from_numpy((clouds - clouds.min()) / np.ptp(clouds)).float()
    down, right = torch.gradient(clouds)
    along, across = torch.from_numpy(rng.normal(size=(2, 12, 1, 1))).float()
    gains = torch.linspace(-0.2, 0.2, 12)[:, None, None]
    noise = torch.from_numpy(rng.normal(0, 0.1, (12, 96, 128))).float()
    gradient = torch.stack([right, down])
    for deviations, low, high in (
        (along * right + across * down, 0.9, 1.0),
        (noise, 0.0, 0.02),
        (gains * clouds, 0.0, 0.02),
    ):
        share = displaced_share(clouds + deviations - deviations.mean(dim=0), gradient, 21)
        assert low <= float(share[12:-12, 12:-12].median()) <= high
