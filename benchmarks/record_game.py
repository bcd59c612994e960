"""A game as a capture with a real artifact and its exact truth: `python benchmarks/record_game.py --output game_hud`

The same walk through a map of Doom is played twice with equal poses: with HUD, crosshair and weapon, and with nothing
in front of the scene. Every view has a clean counterpart in clean/; test views are clean. With --side, a second camera
looks to the right, behind a HUD of its own: a rig. Before, the map is made static: nothing is left in it but the
player, no door opens, no light flickers. The points are where rays meet the map's lines and heights. ViZDoom (MIT)
plays the game and brings Freedoom's maps and pictures (modified BSD).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from games.doom_map import Map
from games.random_walk import random_walk
from PIL import Image

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.data.sparse_points import write_points
from ssa_nerfstudio.data.writing import staged_folder
from ssa_nerfstudio.errors import InputError

SCALE = 2
"""The game draws so many times as many pixels along each side as a view has, for anti-aliasing."""
TALL = 1.2
"""Doom's pixels were this much taller than wide; heights are stretched by it, and the dataset's pixels are square."""
CENTER = np.array([0.34, -0.26])
"""How far the principal point is from the middle of the game's screen, pixels: the game does not sample all mid-pixel.
Measured with SIFT matches triangulated by pycolmap."""
UNIT = 1 / 64
"""Of the dataset, in the map's."""
TICS_PER_SECOND = 35
ARRIVED = 25.0
"""Distance from a waypoint, in the map's units, at which the next is walked to."""
POINTS = 20_000
TEST_EVERY = 8
SETTLED = 126
"""Tics until the weapon is up and the game's messages are gone."""
CONSOLE = ("give all", "r_visibility 200", "crosshair 2", "crosshairscale 1")
"""Typed before the walk; visibility: without it the player carries a lamp, and brightness would depend on the view."""
ASIDE = -60.0
"""Direction of the side camera from the front camera's, degrees; clockwise is negative."""
SIDE_WEAPON = "Pistol"
WALK = (
    *("-150,-200,0", "-70,-60,-20", "60,-50,-5", "100,-215,20", "230,-200,35", "260,-60,50", "340,-40,20"),
    *("360,-130,-40", "280,-210,-20", "190,-120,0", "220,-60,20"),
)
"""Through the first rooms of Freedoom 2's MAP01."""


def steer(x: float, y: float, yaw: float, goal: np.ndarray) -> list[float]:
    """What to press to walk and turn slowly towards a waypoint: forward, right, clockwise (degrees).

    Args:
        x, y, yaw: where the player is, and looks, degrees.
        goal: x, y and the direction to look in there.
    """
    step, ahead = goal[:2] - (x, y), np.radians(yaw)
    step = 10 * step / max(np.linalg.norm(step), 20.0)
    turn = (goal[2] - yaw + 180) % 360 - 180
    forward, right = np.array([np.cos(ahead), np.sin(ahead)]), np.array([np.sin(ahead), -np.cos(ahead)])
    return [float(step @ forward), float(step @ right), -float(np.clip(turn, -1, 1))]


def camera_axes(yaw: float) -> np.ndarray:
    """The camera's right, up and forward in the map's axes, rows of [3, 3]; Doom's camera does not tilt."""
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    return np.array([[s, -c, 0], [0, 0, 1], [c, s, 0]])


class Stuck(Exception):
    """A walk that ends at a wall."""


@dataclass(frozen=True)
class Game:
    """What is played, and how it is drawn."""

    wad: Path
    static: Path
    """WAD with the static map, that is played in place of the game's."""
    map: str
    weapon: str
    width: int
    height: int

    def play(
        self, waypoints: np.ndarray, tics: int, artifact: bool, keys: list[list[float]] | None = None
    ) -> tuple[np.ndarray, np.ndarray, list[list[float]]]:
        """Walk along waypoints, or press the same keys again.

        Args:
            waypoints: [P, 3], x, y, and the direction to look in, degrees.
            tics: between two views.
            artifact: draw HUD, crosshair and weapon.
            keys: what an earlier walk pressed.

        Returns:
            Frames uint8 [N, SCALE height, SCALE width, 3], cameras [N, 4] (x, y, z, yaw), and the keys.

        Raises:
            Stuck: a waypoint was not reached.
        """
        game, (x, y, z, yaw) = self._start(artifact)
        frames, cameras, pressed, goals = [], [], [], list(waypoints)
        patience = 10 * TICS_PER_SECOND * len(goals)
        while len(pressed) < len(keys) if keys is not None else goals:
            state = game.get_state()
            assert state is not None
            assert state.game_variables is not None
            x, y, z, yaw = state.game_variables
            if len(pressed) % tics == 0:
                frames.append(state.screen_buffer.copy())
                cameras.append((x, y, z, yaw))
            pressed.append(steer(x, y, yaw, goals[0]) if keys is None else keys[len(pressed)])
            game.make_action(pressed[-1], 1)
            if keys is None and np.hypot(*(goals[0][:2] - (x, y))) < ARRIVED:
                goals.pop(0)
            if len(pressed) > patience:
                game.close()
                goal = ",".join(f"{value:g}" for value in goals[0])
                raise Stuck(f"the way to waypoint {goal} is blocked near {x:.0f},{y:.0f}")
        game.close()
        return np.stack(frames), np.array(cameras), pressed

    def _start(self, artifact: bool) -> tuple[Any, tuple[float, ...]]:
        """A game that waits at the start of the walk, and where that is."""
        import vizdoom as vzd

        game = vzd.DoomGame()
        game.set_doom_game_path(str(self.wad))
        game.set_doom_scenario_path(str(self.static))
        game.set_doom_config_path(str(self.static.with_suffix(".ini")))
        game.set_doom_map(self.map)
        game.set_screen_resolution(getattr(vzd.ScreenResolution, f"RES_{self.width * SCALE}X{self.height * SCALE}"))
        game.set_screen_format(vzd.ScreenFormat.RGB24)
        game.set_render_hud(artifact)
        game.set_render_minimal_hud(artifact)  # over the scene; the other is a bar below it
        game.set_render_weapon(artifact)
        game.set_render_crosshair(artifact)
        game.set_window_visible(False)
        game.set_seed(1)
        button, variable = vzd.Button, vzd.GameVariable
        game.set_available_buttons(
            [button.MOVE_FORWARD_BACKWARD_DELTA, button.MOVE_LEFT_RIGHT_DELTA, button.TURN_LEFT_RIGHT_DELTA]
        )
        position = (variable.CAMERA_POSITION_X, variable.CAMERA_POSITION_Y, variable.CAMERA_POSITION_Z)
        game.set_available_game_variables([*position, variable.CAMERA_ANGLE])
        game.set_episode_timeout(0)
        game.init()
        game.new_episode()
        for command in (*CONSOLE, f"use {self.weapon}"):
            game.make_action([0, 0, 0], 2)
            game.send_game_command(command)
        for _ in range(SETTLED):
            game.make_action([0, 0, 0], 1)
        state = game.get_state()
        assert state is not None
        assert state.game_variables is not None
        return game, tuple(state.game_variables)


@dataclass(frozen=True)
class Recording:
    """What one camera saw."""

    clean: np.ndarray
    """The game's frames without the artifact, uint8 [N, SCALE H, SCALE W, 3]."""
    marked: np.ndarray
    """The same with it."""
    cameras: np.ndarray
    """[N, 4] in the map's units: x, y, z, yaw (degrees)."""
    name: str = ""
    """Of the camera, where there are several: the folder of its photos."""


def write_dataset(folder: Path, world: Map, recordings: Sequence[Recording], quality: int) -> list[str]:
    """Write photos, their clean counterparts, masks of the artifact, points and transforms.json.

    Args:
        folder: an empty one.
        world: the map.
        recordings: of one camera, or of each camera of a rig.
        quality: of the JPEGs, 1 to 100.

    Returns:
        What was written of each camera, as a phrase.
    """
    splits: dict[str, list[str]] = {"train": [], "test": []}
    frames: list[dict[str, Any]] = []
    points, colors, said = [], [], []
    for recording in recordings:
        own, xyz, rgb, phrase = _write_camera(folder, world, recording, quality, splits)
        frames += own
        points.append(xyz)
        colors.append(rgb)
        said.append(phrase)
    write_points(folder / "sparse_pc.ply", np.concatenate(points), np.concatenate(colors))
    test = splits["test"]
    stated = {"train_filenames": splits["train"], "val_filenames": test, "test_filenames": test}
    stated |= {"camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(stated, indent=1))
    return said


def _write_camera(
    folder: Path, world: Map, recording: Recording, quality: int, splits: dict[str, list[str]]
) -> tuple[list[dict[str, Any]], np.ndarray, np.ndarray, str]:
    """Write a camera's photos and masks, and add the photos to the splits.

    Returns:
        Its frames in transforms.json, points [P, 3] of the scene with colors [P, 3], and what was written.
    """
    height, width = (side // SCALE for side in recording.clean.shape[1:3])
    focal = height * 2 / 3  # 90 degrees across 4:3; a wider frame shows more
    cx, cy = np.array([width, height]) / 2 + CENTER / SCALE
    lens = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": cx, "cy": cy}
    stretch = UNIT * np.array([1, 1, TALL])
    rng = np.random.default_rng(0)
    frames, differing, points, colors = [], [], [], []
    for kind in ("images", "clean"):
        (folder / kind / recording.name).mkdir(parents=True)
    for number, camera in enumerate(recording.cameras):
        file = Path(recording.name) / f"frame_{number:05d}.jpg"
        pure, view = (
            Image.fromarray(frame[number]).resize((width, height), Image.Resampling.BILINEAR)
            for frame in (recording.clean, recording.marked)
        )
        is_test = number % TEST_EVERY == 0
        splits["test" if is_test else "train"].append(f"images/{file.as_posix()}")
        for picture, place in ((pure if is_test else view, "images"), (pure, "clean")):
            picture.save(folder / place / file, quality=quality, subsampling=0, optimize=True, progressive=True)
        if not is_test:
            differing.append((np.asarray(pure) != np.asarray(view)).any(axis=2))
        right, up, forward = camera_axes(camera[3])
        pixels = rng.integers(0, [width, height], (POINTS // len(recording.cameras), 2))
        across, upwards = (pixels[:, 0] + 0.5 - cx) / focal, (cy - pixels[:, 1] - 0.5) / focal / TALL
        rays = across[:, None] * right + upwards[:, None] * up + forward
        depth, solid = world.trace(camera[:3], rays)
        points.append((camera[:3] + rays * depth[:, None])[solid] * stretch)
        colors.append(np.asarray(pure)[pixels[:, 1], pixels[:, 0]][solid])
        pose = np.eye(4)
        pose[:3] = np.stack([right, up, -forward, camera[:3] * stretch], axis=1)
        frames.append({"file_path": f"images/{file.as_posix()}", "transform_matrix": pose.tolist(), **lens})
    ever, always = np.any(differing, axis=0), np.all(differing, axis=0)
    for kind, mask in (("ever", ever), ("always", always)):
        Image.fromarray(mask).save(folder / "_".join(filter(None, ("artifact", recording.name, f"{kind}.png"))))
    tests = len(frames) - len(differing)
    phrase = f"{len(frames)} views, {tests} of them clean test views, {sum(map(len, points)):,} points; "
    phrase += f"the artifact covers {always.mean():.1%} of the frame always, {ever.mean():.1%} at some time"
    return frames, np.concatenate(points), np.concatenate(colors), phrase


def _record(game: Game, waypoints: np.ndarray, tics: int, name: str) -> Recording:
    """Play a walk without and with the artifact.

    Raises:
        Stuck: a waypoint was not reached.
        InputError: the second walk differs from the first.
    """
    clean, cameras, keys = game.play(waypoints, tics, artifact=False)
    marked, again, _ = game.play(waypoints, tics, artifact=True, keys=keys)
    if not np.array_equal(cameras, again):
        raise InputError("the walk did not repeat itself", "keep away from what pushes the player")
    return Recording(clean, marked, cameras, name)


@dataclass
class Command:
    """Record a walk through a game as a dataset with an artifact and its exact truth."""

    output: Path
    """Folder to make."""
    wad: str = "freedoom2"
    """freedoom1 or freedoom2, which ViZDoom brings, or the path of another game's .wad file."""
    map: str = "MAP01"
    """A map of it: MAP01 to MAP32 in freedoom2, E1M1 to E4M9 in freedoom1."""
    weapon: Literal[
        "Fist", "Chainsaw", "Pistol", "Shotgun", "SuperShotgun", "Chaingun", "RocketLauncher", "PlasmaRifle", "BFG9000"
    ] = "Chaingun"
    """What the player holds; freedoom1 has no SuperShotgun."""
    path: Annotated[tuple[str, ...], tyro.conf.arg(metavar="X,Y,YAW")] = WALK
    """Waypoints in the map's units, each with the direction to look in, degrees; the walk starts at the first."""
    random_walk: int | None = None
    """Walk where chance leads from the map's start, instead of along `path`; the number seeds it."""
    width: int = 800
    """Of a view, pixels; the game draws twice as many, in one of ViZDoom's resolutions."""
    height: int = 450
    """Of a view, pixels; at most 3 / 4 of the width."""
    side: tuple[int, int] | None = None
    """Width and height of a second camera's views, which looks to the right; not those of the first."""
    views_per_second: float = 7.0
    """35 divided by a whole number is met exactly."""
    quality: int = 95
    """Of the JPEGs."""

    def run(self) -> None:
        """Play the walk twice and write it.

        Raises:
            InputError: ViZDoom is not installed, an option cannot be used, or the walk got stuck.
        """
        try:
            import vizdoom as vzd
        except ImportError as error:
            raise InputError("ViZDoom is not installed", "pip install 'ssa-nerfstudio[games]'") from error
        front = (self.width, self.height)
        for width, height in (front, self.side or front):
            drawn = f"RES_{width * SCALE}X{height * SCALE}" in vzd.ScreenResolution.__members__
            if not drawn or width * 3 < height * 4:
                raise InputError(f"views of {width} x {height} cannot be drawn", "800 x 450 or 640 x 480 can")
        if self.side == front:
            raise InputError("--side has the size of the first camera's views", "cameras are told apart by it")
        tics = round(TICS_PER_SECOND / self.views_per_second)
        wad = Path(self.wad) if self.wad.endswith(".wad") else Path(vzd.__path__[0]) / f"{self.wad}.wad"
        original = Map.read(wad, self.map)
        waypoints = self._waypoints(original)
        world = original.static(waypoints[0])
        with staged_folder(self.output) as folder, TemporaryDirectory() as scratch:
            world.write(static := Path(scratch) / "static.wad")
            game = Game(wad, static, self.map, self.weapon, self.width, self.height)
            name = "" if self.side is None else "front"
            try:
                recordings = [_record(game, waypoints, tics, name)]
                if self.side is not None:
                    aside = Game(wad, static, self.map, SIDE_WEAPON, *self.side)
                    recordings.append(_record(aside, waypoints + np.array([0, 0, ASIDE]), tics, "side"))
            except Stuck as stuck:
                remedy = f"walk around it; in {self.map} the game starts players at {original.start}"
                remedy = remedy if self.random_walk is None else "choose another --random-walk"
                raise InputError(str(stuck), remedy) from stuck
            for said in write_dataset(folder, world, recordings, self.quality):
                print(f"{self.output}: {said}")

    def _waypoints(self, world: Map) -> np.ndarray:
        if self.random_walk is not None:
            if self.path != WALK:
                raise InputError("--path and --random-walk were both given", "leave one of them out")
            if self.random_walk < 0:
                raise InputError(f"--random-walk must be 0 or more, got {self.random_walk}")
            if (found := random_walk(world, self.random_walk)) is None:
                problem = f"--random-walk {self.random_walk} leads nowhere in {self.map}"
                raise InputError(problem, "choose another number, or another --map")
            return found
        try:
            waypoints = np.array([[float(value) for value in point.split(",")] for point in self.path])
            if waypoints.shape != (len(self.path), 3) or len(self.path) < 2 or not np.isfinite(waypoints).all():
                raise ValueError("each needs three finite numbers, and there must be two")
        except ValueError as error:
            raise InputError(f"--path {' '.join(self.path)}: {error}", "for example --path 0,0,90 100,0,90") from error
        return waypoints


if __name__ == "__main__":
    run_script(Command)
