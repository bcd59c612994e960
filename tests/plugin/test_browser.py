"""The viewer in a real browser: the page of a trained model, toggled as a user would."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from benchmarks import viewer_screenshots
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.overlay.layer import letterboxed_layers
from ssa_nerfstudio.overlay.resampling import straight_color

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def config(tiny_scene, tmp_path_factory, configure_training, train_and_evaluate) -> Path:
    """A tiny model trained on the CPU rasterizer."""
    folder = tmp_path_factory.mktemp("run")
    return train_and_evaluate(configure_training("ssa-splatfacto", tiny_scene, folder, 80, {"num_downscales": 0}))[2]


@pytest.fixture(scope="module")
def page(config) -> Iterator:
    if viewer_screenshots.find_chromium() is None:
        pytest.skip("no Chromium on this machine; Debian: apt install chromium")
    pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    command = "ns-viewer", "--load-config", config
    with (
        viewer_screenshots.browser() as browser,
        viewer_screenshots.viewer_page(browser, *command, width=900, height=500) as page,
    ):
        yield page


def scene(page) -> np.ndarray:
    """What the canvas shows, [H, W, 3] in [0, 1]."""
    box = page.locator("canvas").last.bounding_box()
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    top, left = round(box["y"]), round(box["x"])
    return picture[top : top + round(box["height"]), left : left + round(box["width"])] / 255.0


def eventually(page, holds: Callable[[np.ndarray], bool], what: str) -> np.ndarray:
    """The first picture of which a condition holds, and that stays: viser draws a coarse one first."""
    before = None
    for _ in range(120):
        seen = scene(page)
        if holds(seen) and before is not None and np.abs(seen - before).mean() < 1e-3:
            return seen
        before = seen
        page.wait_for_timeout(500)
    raise AssertionError(f"after a minute: {what}")


def test_it_opens_at_the_middle_photo(page, config, tiny_scene):
    """Of all training photos that one is most alike to what the page shows, where no artifact is."""
    seen = eventually(page, lambda seen: seen.std() > 0.02, "no frame came")
    transforms = json.loads((tiny_scene / "transforms.json").read_text())
    width, height = transforms["w"], transforms["h"]
    shown = round(height * seen.shape[1] / seen.shape[0])  # the page is a little narrower than the photo
    view = cv2.resize(seen, (shown, height), interpolation=cv2.INTER_AREA)
    margin = slice((width - shown) // 2, (width - shown) // 2 + shown)
    clear = Checkpoint.read(config).artifacts()[0].layers()[0].detach().numpy()[:, margin, 0] > 0.98
    clear[-height // 3 :, : width // 3] = False  # viser's axes
    photos = [np.asarray(Image.open(tiny_scene / name)) for name in transforms["train_filenames"]]
    alike = [np.corrcoef(photo[:, margin][clear].ravel(), view[clear].ravel())[0, 1] for photo in photos]
    assert np.argmax(alike) == len(photos) // 2, np.round(alike, 2)


def test_the_artifact_appears_and_disappears(page, config):
    first = eventually(page, lambda seen: seen.std() > 0.02, "no frame came")
    height, width = first.shape[:2]
    color, alpha = straight_color(*letterboxed_layers(Checkpoint.read(config).artifacts()[0], height, width))
    color, opaque = color.detach().numpy(), alpha.detach().numpy()[..., 0] > 0.9
    # The axes that viser draws into the lower left corner.
    opaque[-80:, :80] = False

    def distance(seen: np.ndarray) -> float:
        return float(np.abs(seen - color)[opaque].mean())

    assert opaque.mean() > 0.1
    # The default is off: the clean scene.
    assert distance(first) > 0.1
    page.get_by_label("Show overlay").click()
    shown = eventually(page, lambda seen: distance(seen) < 0.05, "the artifact did not appear")
    page.get_by_label("Show overlay").click()
    hidden = eventually(page, lambda seen: distance(seen) > 0.1, "the artifact did not disappear")
    clear = alpha.detach().numpy()[..., 0] < 0.02
    assert np.abs(shown - hidden)[clear].mean() < 0.02
    assert np.abs(first - hidden).mean() < 0.02


def test_the_picture_does_not_become_softer_with_time(page):
    # Software draws fewer frames a second than viser's page wants; it would have lowered its resolution meanwhile.
    page.wait_for_timeout(3000)
    drawn, shown = page.locator("canvas[data-engine]").evaluate("it => [it.width, it.clientWidth]")
    assert drawn == pytest.approx(shown, abs=1)


def test_the_summary_and_the_saved_picture_are_the_artifacts(page, config, tmp_path):
    overlay = Checkpoint.read(config).artifacts()
    page.get_by_text(overlay.summary(0)).wait_for(timeout=60_000)
    with page.expect_download(timeout=60_000) as download:
        page.get_by_role("button", name="Save artifact").click()
    assert download.value.suggested_filename == "artifact-camera-0.png"
    download.value.save_as(tmp_path / "saved.png")
    saved = np.asarray(Image.open(tmp_path / "saved.png"))
    transmittance, _ = overlay[0].layers()
    np.testing.assert_allclose(saved[..., 3] / 255, 1 - transmittance.detach().numpy()[..., 0], atol=0.5 / 255 + 1e-6)
