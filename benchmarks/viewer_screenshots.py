"""The documentation's pictures of the viewer, taken in a browser: `python benchmarks/viewer_screenshots.py docs/images`

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
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

_log = logging.getLogger(__name__)
_FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_TIMEOUT = 200
"""Seconds for a server to answer; most of them are spent on imports."""
_STEPS = 800
_ADAPTIVE_RATIO = re.compile(r"window\.devicePixelRatio\*\(\.2\+\.8\*[\w$]+\)")
"""Expression in viser's page for the share of the window's pixels that it draws (0.2.7, which nerfstudio pins)."""

_SCENE_HAS_ITS_WIDTH = """() => {
    const before = window.widthBefore
    window.widthBefore = document.querySelector("canvas[data-engine]").clientWidth
    return window.widthBefore === before
}"""
"""Holds once the panel has slid in, which narrows the scene."""


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
            page.goto(f"http://127.0.0.1:{port}", timeout=1000 * _TIMEOUT)
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
    """Make the page draw every pixel of its window, as it does where the browser has a GPU.

    Below 38 frames a second viser's page reduces its resolution step by step, to a fifth of the width at last. WebGL in
    software is always slower: the longer a page were open, the softer its pictures.
    """

    def serve(route: Route) -> None:
        answer = route.fetch()
        script, count = _ADAPTIVE_RATIO.subn("window.devicePixelRatio", answer.text())
        if count != 1:
            _log.warning("viser's page sets its resolution differently from 0.2.7; pictures may be soft")
        route.fulfill(response=answer, body=script)

    page.route("**/assets/index-*.js", serve)


def _wait_for(address: str, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + _TIMEOUT
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
    for _ in range(_TIMEOUT // 10):
        try:
            last.wait_for(timeout=10_000)
        except TooSlow:
            page.reload()
        else:
            page.wait_for_timeout(1000)
            page.reload()
            last.wait_for(timeout=1000 * _TIMEOUT)
            return
    raise RuntimeError("the page never had all elements")


@dataclass
class Command:
    """Train the built-in scene and write viewer-training.png, viewer-clean.png and viewer-overlay.png."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder for the pictures; must exist."""

    def run(self) -> None:
        """Train and take the pictures.

        Raises:
            InputError: the folder does not exist, or there is no Chromium.
        """
        if not self.output.is_dir():
            raise InputError(f"{self.output} is no folder", "name one that exists")
        take_pictures(self.output)


def take_pictures(output: Path) -> None:
    """Write the three pictures into a folder.

    Raises:
        InputError: there is no Chromium.
    """
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
            _orbit_to_the_boxes(page)
            page.wait_for_function("/Step: [2-9][0-9][0-9]/.test(document.body.innerText)", timeout=1000 * _TIMEOUT)
            page.wait_for_timeout(4000)
            page.screenshot(path=output / "viewer-training.png")
            deadline = time.monotonic() + 3 * _TIMEOUT
            while not (run / "nerfstudio_models").exists() or not list((run / "nerfstudio_models").glob("*599.ckpt")):
                if time.monotonic() > deadline:
                    raise RuntimeError("the training did not end")
                time.sleep(1)
            time.sleep(1)  # until the checkpoint is complete
        with viewer_page(running, "ns-viewer", "--load-config", run / "config.yml") as page:
            page.get_by_label("Show overlay").scroll_into_view_if_needed()
            _orbit_to_the_boxes(page)
            page.wait_for_timeout(6000)
            page.screenshot(path=output / "viewer-clean.png")
            page.get_by_label("Show overlay").click()
            page.mouse.move(400, 350)  # away from the checkbox, whose hint would cover others
            page.wait_for_timeout(6000)
            page.screenshot(path=output / "viewer-overlay.png")


def _orbit_to_the_boxes(page: Page) -> None:
    """Orbit from the viewer's first view to the boxes, and hide the logo, which is on the internet."""
    page.add_style_tag(content="img[alt='NerfStudio Logo'] { visibility: hidden }")
    page.mouse.move(400, 350)
    page.mouse.down()
    page.mouse.move(700, 350, steps=8)
    page.mouse.up()


if __name__ == "__main__":
    run_script(Command)
