"""The documentation's pictures of the viewer, taken in a real browser: `python benchmarks/screenshots.py DIR`.

Chromium is the system's own (Debian: apt install chromium) and draws WebGL in software; nothing is downloaded.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

_log = logging.getLogger(__name__)
_FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_PATIENCE = 200
"""Seconds until a server has to answer: on a loaded machine most of them go into importing."""
_STEPS = 800
_ADAPTIVE_RATIO = re.compile(r"window\.devicePixelRatio\*\(\.2\+\.8\*[\w$]+\)")
"""Where viser's page decides how many of the window's pixels it draws (0.2.7, which nerfstudio pins)."""

_SCENE_HAS_ITS_WIDTH = """() => {
    const before = window.widthBefore
    window.widthBefore = document.querySelector("canvas[data-engine]").clientWidth
    return window.widthBefore === before
}"""
"""The panel slides in, and the scene gets narrower meanwhile."""


def find_chromium() -> str | None:
    """The system's Chromium or Chrome, or None."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@contextmanager
def browser() -> Iterator[Browser]:
    """A running browser without a window.

    Raises:
        InputError: the system has no Chromium.
    """
    from playwright.sync_api import sync_playwright

    program = find_chromium()
    if program is None:
        raise InputError("there is no Chromium on this machine", "Debian: apt install chromium")
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=program, args=_FLAGS)
        yield running
        running.close()


@contextmanager
def viewer_page(browser: Browser, *command: str | Path, width: int = 1100, height: int = 640) -> Iterator[Page]:
    """The page that a nerfstudio command's viewer serves; the command ends with the block.

    Args:
        browser: from `browser()`.
        command: `ns-viewer` or `ns-train` and its options, without the port.
        width, height: of the page, pixels.

    Raises:
        RuntimeError: the command ends, or its page does not come up.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = Path(sys.executable).with_name(str(command[0]))
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(
            [program, *command[1:], "--viewer.websocket-port", str(port)],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "CUDA_VISIBLE_DEVICES": "", "PYTHONWARNINGS": "ignore"},
        )
        try:
            _wait_for(f"http://127.0.0.1:{port}", process)
            page = browser.new_page(viewport={"width": width, "height": height})
            _keep_resolution(page)
            page.goto(f"http://127.0.0.1:{port}", timeout=1000 * _PATIENCE)
            _wait_for_elements(page)
            page.get_by_role("button", name="Hide Train Cams").click()
            page.wait_for_function(_SCENE_HAS_ITS_WIDTH, polling=500)
            yield page
            page.close()
        except RuntimeError as error:
            log.seek(0)
            raise RuntimeError(f"{error}\n{log.read()[-3000:]}") from error
        finally:
            process.kill()
            process.wait()


def _keep_resolution(page: Page) -> None:
    """Have the page draw every pixel of its window, as it does on a machine whose browser has a GPU.

    Below 38 frames a second viser's page draws fewer pixels, step by step down to a fifth of the width, and stretches
    them. WebGL in software is always slower: pictures would be the softer, the longer a page has been open.
    """

    def serve(route: Route) -> None:
        answer = route.fetch()
        script, count = _ADAPTIVE_RATIO.subn("window.devicePixelRatio", answer.text())
        if count != 1:
            _log.warning("viser's page decides on its resolution in another way than 0.2.7 does; pictures may be soft")
        route.fulfill(response=answer, body=script)

    page.route("**/assets/index-*.js", serve)


def _wait_for(address: str, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + _PATIENCE
    while True:
        if process.poll() is not None:
            raise RuntimeError("the viewer ended")
        if time.monotonic() > deadline:
            raise RuntimeError("the viewer's page did not come up")
        try:
            urllib.request.urlopen(address, timeout=5).close()
            return
        except OSError:
            time.sleep(0.3)


def _wait_for_elements(page: Page) -> None:
    """Wait for the last element; a page that connects while the viewer is being built misses some and is reloaded."""
    from playwright.sync_api import TimeoutError as TooSlow

    last = page.get_by_role("button", name="Save artifact")
    for _ in range(_PATIENCE // 10):
        try:
            last.wait_for(timeout=10_000)
        except TooSlow:
            page.reload()
        else:
            page.wait_for_timeout(1000)
            page.reload()
            last.wait_for(timeout=1000 * _PATIENCE)
            return
    raise RuntimeError("the page never had all elements")


def main(arguments: list[str]) -> None:
    """Train the demo's scene and take viewer-training.png, viewer-clean.png and viewer-overlay.png into one folder.

    Raises:
        InputError: not exactly one folder is named, or there is no Chromium.
    """
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        raise InputError("name one folder for the pictures: python -m benchmarks.screenshots docs/images")
    output = Path(arguments[0])
    scene = DemoScene()
    with tempfile.TemporaryDirectory() as scratch, browser() as running:
        data = Path(scratch) / "dashboard"
        scene.write(data, Dashboard().layers(scene.height, scene.width, np.random.default_rng(0)))
        options = ["--data", data, "--output-dir", scratch, "--timestamp", "run", "--machine.device-type", "cpu"]
        options += ["--max-num-iterations", str(_STEPS), "--pipeline.model.num-downscales", "0"]
        options += ["--pipeline.model.densify-grad-thresh", "0.006"]
        run = Path(scratch) / "dashboard" / "ssa-splatfacto" / "run"
        with viewer_page(running, "ns-train", "ssa-splatfacto", *options) as page:
            page.get_by_label("Show overlay").click()
            _look_at_the_scene(page)
            page.wait_for_function("/Step: [2-9][0-9][0-9]/.test(document.body.innerText)", timeout=1000 * _PATIENCE)
            page.wait_for_timeout(4000)
            page.screenshot(path=output / "viewer-training.png")
            deadline = time.monotonic() + 3 * _PATIENCE
            while not (run / "nerfstudio_models").exists() or not list((run / "nerfstudio_models").glob("*599.ckpt")):
                if time.monotonic() > deadline:
                    raise RuntimeError("the training did not end")
                time.sleep(1)
            time.sleep(1)  # so that the checkpoint is whole
        with viewer_page(running, "ns-viewer", "--load-config", run / "config.yml") as page:
            page.get_by_label("Show overlay").scroll_into_view_if_needed()
            _look_at_the_scene(page)
            page.wait_for_timeout(6000)
            page.screenshot(path=output / "viewer-clean.png")
            page.get_by_label("Show overlay").click()
            page.mouse.move(400, 350)  # away from the checkbox, whose hint would cover others
            page.wait_for_timeout(6000)
            page.screenshot(path=output / "viewer-overlay.png")


def _look_at_the_scene(page: Page) -> None:
    """Orbit from the viewer's first view to where the boxes are, and leave out the logo, which is on the internet."""
    page.add_style_tag(content="img[alt='NerfStudio Logo'] { visibility: hidden }")
    page.mouse.move(400, 350)
    page.mouse.down()
    page.mouse.move(700, 350, steps=8)
    page.mouse.up()


if __name__ == "__main__":
    main(sys.argv[1:])
