"""Images from their gradients."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.evidence.poisson import add_divergence, divergence, solve_poisson


@settings(max_examples=25, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40))
def test_an_image_comes_back_from_its_gradients_up_to_its_mean(height: int, width: int) -> None:
    image = np.random.default_rng(height * 41 + width).random((height, width))
    found = solve_poisson(divergence(np.diff(image, axis=1), np.diff(image, axis=0)))
    np.testing.assert_allclose(found, image - image.mean(), atol=1e-9)


def test_gradients_of_no_image_are_fitted_in_least_squares() -> None:
    rng = np.random.default_rng(0)
    across, down = rng.normal(size=(5, 5)), rng.normal(size=(4, 6))
    rows = []
    for y in range(5):
        for x in range(6):
            for (to_y, to_x), value in (
                ((y, x + 1), across[y, x] if x < 5 else 0),
                ((y + 1, x), down[y, x] if y < 4 else 0),
            ):
                if to_y < 5 and to_x < 6:
                    row = np.zeros((5, 6))
                    row[to_y, to_x], row[y, x] = 1, -1
                    rows.append((row.ravel(), value))
    matrix, values = np.array([row for row, _ in rows]), np.array([value for _, value in rows])
    expected = np.linalg.lstsq(matrix, values, rcond=None)[0].reshape(5, 6)
    np.testing.assert_allclose(solve_poisson(divergence(across, down)), expected - expected.mean(), atol=1e-9)


@pytest.mark.parametrize("band", [1, 3, 7])
def test_bands_of_rows_add_up_to_the_whole(band: int) -> None:
    image = np.random.default_rng(1).random((7, 5))
    total = np.zeros_like(image)
    for top in range(0, 7, band):
        rows = image[top : top + band + 1]
        add_divergence(total[top:], np.diff(rows[:band], axis=1), np.diff(rows, axis=0))
    np.testing.assert_allclose(total, divergence(np.diff(image, axis=1), np.diff(image, axis=0)), atol=1e-12)
