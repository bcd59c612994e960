"""The child process of `reconstruction.py`: structure from motion with pycolmap, resumable.

Features and matches that an earlier run stored in the database are kept.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from itertools import count, islice
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap: loaded the other way round, saving a PNG aborts the process
import pycolmap

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio._system.process_lifetime import end_with_parent
from ssa_nerfstudio.sfm import square_pixels
from ssa_nerfstudio.sfm.false_joins import rejoin, torn_links
from ssa_nerfstudio.sfm.held_lens import map_with_held_lens, most_registered
from ssa_nerfstudio.sfm.image_pairs import EXHAUSTIVE_UP_TO, exhaustive_pairs, sequential_pairs
from ssa_nerfstudio.sfm.known_poses import align, triangulate
from ssa_nerfstudio.sfm.progress_display import ProgressCallback
from ssa_nerfstudio.sfm.reconstruction import JOB, KEPT, MODEL, TORN, Mount, Pass, SfmSettings
from ssa_nerfstudio.sfm.registration import better, is_complete

_PAIRS_PER_CALL = 64
"""Pairs that are matched and stored at once: the loss when the process is killed, and the grain of the progress bar."""
_PHOTOS_PER_THREAD = 2
_MAX_REJOINS = 3
"""Times that a model is cut and joined again."""

pycolmap.logging.minloglevel = 3


class StructureFromMotion:
    """A database of features and matches, and the model that is mapped from it."""

    def __init__(self, images: Path, passes: Sequence[Pass], folder: Path, settings: SfmSettings) -> None:
        """Store the arguments.

        Args:
            images: folder of the photos.
            passes: each has a camera of its own; all are mapped together.
            folder: exists; what an earlier run with the same arguments left there is used.
            settings: settings of structure from motion.
        """
        self._images, self._passes, self._folder, self._settings = images, passes, folder, settings
        self._database = folder / "database.db"

    def extract(self, on_progress: ProgressCallback) -> None:
        """Extract SIFT features of all photos that have none yet; one camera per pass; and build the rigs."""
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = self._settings.threads
        options.max_image_size = self._settings.max_image_size
        total = sum(len(each.photos) for each in self._passes)
        with pycolmap.Database.open(self._database) as database:
            done = {image.name for image in database.read_all_images() if database.exists_keypoints(image.image_id)}
        for number, each in enumerate(self._passes, 1):
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model = self._settings.camera_model
            if each.mask is not None:
                reader.camera_mask_path = each.mask
            with pycolmap.Database.open(self._database) as database:
                if not database.exists_camera(number):
                    camera = pycolmap.infer_camera_from_image(self._images / each.photos[0], reader)
                    camera.camera_id = number
                    if each.lens is not None:
                        camera.params = each.lens
                        camera.has_prior_focal_length = True
                    database.write_camera(camera, use_camera_id=True)
            reader.existing_camera_id = number
            remaining = iter([name for name in each.photos if name not in done])
            while names := list(islice(remaining, _PHOTOS_PER_THREAD * self._threads)):
                on_progress("features", len(done), total)
                pycolmap.extract_features(
                    self._database,
                    each.folder,
                    image_names=names,
                    reader_options=reader,
                    extraction_options=options,
                )
                done |= {*names}
        self._build_rigs()
        on_progress("features", total, total)

    def match(self, on_progress: ProgressCallback) -> None:
        """Match all pairs that have not been matched yet, and verify the matches geometrically."""
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads = self._settings.threads
        matching.skip_image_pairs_in_same_frame = True
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.filter_stationary_matches = self._settings.filter_stationary
        geometry.ransac.random_seed = 0
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = self._folder / "pairs.txt"
        pairs = self._pairs()
        with pycolmap.Database.open(self._database) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            frame = {image.name: image.frame_id for image in database.read_all_images()}
            pairs = [pair for pair in pairs if frame[pair[0]] != frame[pair[1]]]
            remaining = [pair for pair in pairs if not database.exists_two_view_geometry(*(ids[n] for n in pair))]
        done = len(pairs) - len(remaining)
        batches = iter(remaining)
        while batch := list(islice(batches, _PAIRS_PER_CALL)):
            on_progress("matches", done, len(pairs))
            Path(pairing.match_list_path).write_text("".join(f"{one} {other}\n" for one, other in batch))
            pycolmap.match_image_pairs(self._database, matching, pairing, geometry)
            done += len(batch)
        on_progress("matches", len(pairs), len(pairs))

    def map(self, on_progress: ProgressCallback, poses: Mapping[str, np.ndarray]) -> None:
        """Map incrementally and store the model of most photos; none where no two photos match.

        Args:
            on_progress: called after every photo.
            poses: those that are known; those that agree with the photos are where the mapping starts.
        """
        total = sum(len(each.photos) for each in self._passes)
        models = self._folder / "models"
        for earlier in (models, self._folder / MODEL):
            shutil.rmtree(earlier, ignore_errors=True)
        models.mkdir()
        kept = triangulate(self._database, self._images, poses, start := models / "start") if poses else set()
        (self._folder / KEPT).write_text(json.dumps(sorted(kept)), encoding="utf-8")
        rigs = {number if each.mount is None else each.mount.rig for number, each in enumerate(self._passes)}
        at_once = len(self._passes) // len(rigs)

        def mapped(into: str) -> pycolmap.Reconstruction | None:
            registered = len(kept) or 2 * at_once

            def on_registered() -> None:
                nonlocal registered
                registered += at_once
                on_progress("poses", min(registered, total), total)

            (folder := models / into).mkdir()
            found = pycolmap.incremental_mapping(
                *(self._database, self._images, folder, self._mapping_options(total)),
                input_path=start if kept else "",
                next_image_callback=on_registered,
            )
            return most_registered(found)

        on_progress("poses", 0, total)
        model, guess_all = None, not poses and all(each.lens is None for each in self._passes)
        if guess_all and self._settings.camera_model == "OPENCV":
            square_pixels.hold(self._database)
            model = mapped("square")
            square_pixels.free(self._database)
        if not is_complete(model, total):
            model = better(model, mapped("free"))
        free = [number for number, each in enumerate(self._passes, 1) if each.mount is None]
        if not kept and free and not is_complete(model, total):
            guessed = [number for number in free if not self._is_lens_known(number)]
            # Several mappings, each of up to all photos.
            again = count(1)
            other = map_with_held_lens(
                *(self._database, self._images, models / "held", lambda: self._mapping_options(total)),
                *(guessed, model and square_pixels.with_opencv_lenses(model)),
                lambda: on_progress("other lenses", next(again) * at_once % total, total),
            )
            on_progress("other lenses", total, total)
            model = better(model, other)
        if model is not None:
            if is_square := square_pixels.are_held(model):
                square_pixels.hold(self._database)
            if not kept:
                model = self._joined_again(model, models, total)
            if is_square:
                square_pixels.free(self._database)
                model = square_pixels.refined(square_pixels.with_opencv_lenses(model), self._settings.threads)
            (self._folder / TORN).write_text(json.dumps(torn_links(self._database, model)), encoding="utf-8")
            if kept:
                align(model, {name: poses[name] for name in kept})
            (self._folder / MODEL).mkdir()
            model.write_binary(self._folder / MODEL)
        on_progress("poses", total, total)

    def _joined_again(self, model: pycolmap.Reconstruction, folder: Path, total: int) -> pycolmap.Reconstruction:
        """The model, with parts of the photos where their strongest matches have them."""
        torn = torn_links(self._database, model)
        for number in range(_MAX_REJOINS):
            if not torn:
                break
            start, out = folder / f"rejoined_{number}", folder / f"refined_{number}"
            out.mkdir()
            if not rejoin(self._database, self._images, model, start):
                break
            options = self._mapping_options(total)
            found = most_registered(
                pycolmap.incremental_mapping(self._database, self._images, out, options, input_path=start)
            )
            if found is None or better(found, model) is model:
                break
            left = torn_links(self._database, found)
            if len(left) >= len(torn):
                break
            model, torn = found, left
        return model

    def _mapping_options(self, total: int) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = self._settings.threads
        options.random_seed = 0
        # COLMAP's default would drop the complete model of a capture of few photos.
        options.min_model_size = min(10, max(3, total // 2))
        # What is known stays as it is.
        options.constant_cameras = {number for number, each in enumerate(self._passes, 1) if each.mount is not None}
        options.ba_refine_sensor_from_rig = False
        return options

    def _is_lens_known(self, number: int) -> bool:
        """Whether the photos or the caller say where a camera's lens starts."""
        with pycolmap.Database.open(self._database) as database:
            return database.read_camera(number).has_prior_focal_length

    def _build_rigs(self) -> None:
        """Join cameras whose places on a rig are known."""
        mounts = [each.mount for each in self._passes if each.mount is not None]
        configs = []
        for rig in dict.fromkeys(mount.rig for mount in mounts):
            members = [mount for mount in mounts if mount.rig == rig]
            first = np.array(members[0].from_rig)
            cameras = [pycolmap.RigConfigCamera(image_prefix=members[0].prefix, ref_sensor=True)]
            for mount in members[1:]:
                turn = pycolmap.Rotation3d(np.array(mount.from_rig) @ first.T)
                pose = pycolmap.Rigid3d(turn, np.zeros(3))
                cameras.append(pycolmap.RigConfigCamera(image_prefix=mount.prefix, cam_from_rig=pose))
            configs.append(pycolmap.RigConfig(cameras=cameras))
        if configs:
            with pycolmap.Database.open(self._database) as database:
                pycolmap.apply_rig_config(configs, database)

    def _pairs(self) -> list[tuple[str, str]]:
        photos = [each.photos for each in self._passes]
        exhaustive = self._settings.matching == "exhaustive" or (
            self._settings.matching == "auto" and sum(map(len, photos)) <= EXHAUSTIVE_UP_TO
        )
        return exhaustive_pairs(photos) if exhaustive else sequential_pairs(photos)

    @property
    def _threads(self) -> int:
        return self._settings.threads if self._settings.threads > 0 else usable_cores()


def _main(folder: Path) -> None:
    """Do the job in a folder, report progress as lines of JSON, and end when the parent does."""

    def on_progress(*values: str | int) -> None:
        print(json.dumps(values), flush=True)

    end_with_parent()
    job = json.loads((folder / JOB).read_text(encoding="utf-8"))
    passes = [Pass(**each | {"mount": each["mount"] and Mount(**each["mount"])}) for each in job["passes"]]
    sfm = StructureFromMotion(Path(job["images"]), passes, folder, SfmSettings(**job["settings"]))
    sfm.extract(on_progress)
    sfm.match(on_progress)
    sfm.map(on_progress, {name: np.array(pose) for name, pose in job["poses"].items()})


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
