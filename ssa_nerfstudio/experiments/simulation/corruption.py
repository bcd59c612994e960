"""Training photos with the artifact in front of them, and files of its true layers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from ssa_nerfstudio._system.ordered_map import ordered_map
from ssa_nerfstudio.cameras.groups import group_frames
from ssa_nerfstudio.cameras.image_circle import Circle, brightest, image_circle, sampled
from ssa_nerfstudio.cameras.lens import Lens, undistort, undistorted_lens
from ssa_nerfstudio.data.dataset import Dataset, View
from ssa_nerfstudio.data.photos import write_photo
from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.simulation.exposure_variation import acts_on_artifact, draw_exposures, expose
from ssa_nerfstudio.experiments.simulation.layer_files import add_layers, write_view
from ssa_nerfstudio.experiments.simulation.scene import Scene


def corrupt(dataset: Dataset, scene: Scene, names: dict[str, str], folder: Path, threads: int) -> Iterator[None]:
    """Write the training photos and the layers, one raw frame size after the other; yield after every photo.

    Args:
        dataset: what to read.
        scene: effects to put in front, or an exposure that varies.
        names: each photo's path in the output.
        folder: the output.
        threads: photos in flight at once.

    Raises:
        InputError: a photo cannot be read, or differs in size from transforms.json; exposure varies, and its place is
            not defined (`acts_on_artifact`).
    """
    numbered = [(number, view) for number, view in enumerate(dataset.views) if view.role == "train"]
    # In the output's order, in which nerfstudio numbers cameras.
    cameras = _first_views(sorted((view for _, view in numbered), key=lambda view: Path(names[view.path])))
    exposed = _exposures(scene, [view for _, view in numbered], names, folder)
    after = acts_on_artifact(name for name, _ in scene.effects) if scene.exposure else False
    if scene.effects:
        (folder / "layers").mkdir()

    for size in dict.fromkeys(view.size for _, view in numbered):
        artifact = scene.draw(*size)
        circle = _image_circle(dataset, [view for _, view in numbered if view.size == size])
        if circle is not None:
            artifact = artifact.within(circle.coverage(*size))

        def work(item: tuple[int, View], artifact: Composition = artifact) -> Layers | None:
            number, view = item
            photo = dataset.read_photo(view)
            if exposed and not after:
                photo = expose(photo, *exposed[view.path])
            inside = None
            if artifact.box is not None:
                inside = artifact.view(scene.view_generators(artifact, number))
                path = folder / "layers" / "views" / PurePosixPath(view.path).with_suffix(".npz")
                write_view(path, inside, artifact.box, view.size)
            photo = artifact.apply(photo, inside)
            if exposed and after:
                photo = expose(photo, *exposed[view.path])
            write_photo(folder / names[view.path], photo)
            return inside

        views = [item for item in numbered if item[1].size == size]
        # Added in the views' order: the mean is reproducible.
        total = np.zeros((2, *(side.stop - side.start for side in artifact.box or ()), 3))
        for inside in ordered_map(work, views, threads):
            if inside is not None:
                total += (inside.transmittance, inside.addition)
            yield
        mean = None if artifact.box is None else Layers(*(total / len(views)).astype(np.float32))
        layers = artifact.whole(mean, *size)
        for camera, view in enumerate(cameras) if scene.effects else ():
            if view.size == size:
                both = (("raw", layers), ("undistorted", undistorted_layers(layers, view.lens)))
                suffix = str(camera) if len(cameras) > 1 else ""
                # Their compression takes as long as dozens of photos.
                list(
                    ordered_map(lambda pair, suffix=suffix: add_layers(folder / "layers", suffix, *pair), both, threads)
                )


def _exposures(
    scene: Scene, views: list[View], names: dict[str, str], folder: Path
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Gain and offset [3] of each view by its path, which are also written to exposure.json; empty without any."""
    if not scene.exposure:
        return {}
    drawn = list(zip(*draw_exposures(scene.exposure, len(views), scene.seed), strict=True))
    described = [
        {"photo": names[view.path], "gain": gain.tolist(), "offset": offset.tolist()}
        for view, (gain, offset) in zip(views, drawn, strict=True)
    ]
    (folder / "exposure.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return {view.path: exposure for view, exposure in zip(views, drawn, strict=True)}


def undistorted_layers(layers: Layers, lens: Lens) -> Layers:
    """Warp an artifact of the raw frame to the undistorted, cropped frame: T and B like photos, premultiplied."""
    # Bilinear weights add up to 1 only within rounding.
    return Layers(undistort(layers.transmittance, lens).clip(0, 1), undistort(layers.addition, lens))


def _image_circle(dataset: Dataset, views: list[View]) -> Circle | None:
    """The image circle of a fisheye camera's photos; None where they have none."""
    if views[0].lens.model != "fisheye":
        return None
    return image_circle(brightest(dataset.read_photo(view) for view in sampled(views)))


def _first_views(views: list[View]) -> list[View]:
    """The first view of each camera, in order of appearance."""
    lenses = [undistorted_lens(view.lens) for view in views]
    described = np.array([(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) for lens in lenses])
    groups = group_frames(described)
    return [views[groups.index(group)] for group in range(max(groups) + 1)]
