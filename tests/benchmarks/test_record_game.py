"""The recorder of games: map files, rays, walks and datasets without the game, and a walk in it where it is there."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from games import doom_map
from games.doom_map import Map
from games.random_walk import FAR, LENGTHS, MARGIN, MIN_STEPS, free_way, random_walk
from PIL import Image

from benchmarks import record_game
from benchmarks.record_game import Command, Recording, camera_axes, steer, write_dataset
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.sparse_points import check_points
from ssa_nerfstudio.errors import InputError

EYE = np.array([64.0, 128.0, 41.0])


@pytest.fixture
def rooms() -> Map:
    """Two rooms of 128 x 256: the left from 0 to 128 high, the right from 32 to 96 and open to the sky."""
    corners = np.array([[0, 0], [0, 256], [128, 256], [256, 256], [256, 0], [128, 0]], "<i2")
    lines = np.zeros(7, doom_map.LINE)
    lines["ends"] = [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 0], [5, 2]]
    lines["special"] = 7
    lines["sides"] = [[0, 0xFFFF], [0, 0xFFFF], [1, 0xFFFF], [1, 0xFFFF], [1, 0xFFFF], [0, 0xFFFF], [1, 0]]
    sides = np.zeros(2, doom_map.SIDE)
    sides["sector"] = [0, 1]
    sectors = np.zeros(2, doom_map.SECTOR)
    sectors["floor"], sectors["ceiling"], sectors["special"] = [0, 32], [128, 96], 9
    sectors["flats"] = [[b"FLOOR0_1", b"CEIL1_1"], [b"FLOOR0_1", b"F_SKY1"]]
    things = np.array([(10, 20, 90, 3004, 7), (32, 64, 45, 1, 7)], doom_map.THING)
    lumps = {"THINGS": things, "LINEDEFS": lines, "SIDEDEFS": sides, "VERTEXES": corners, "SECTORS": sectors}
    others = dict.fromkeys(("SEGS", "SSECTORS", "NODES", "REJECT", "BLOCKMAP"), b"abc")
    return Map("MAP01", {name: lump.tobytes() for name, lump in lumps.items()} | others)


@pytest.mark.parametrize(
    ("direction", "depth", "solid"),
    [
        ((1, 0, 0), 192, True),  # over the step, to the far wall
        ((-1, 0, 0), 64, True),
        ((2, 0, 0), 96, True),  # depth counts directions
        ((0, 1, 0.25), 128, True),
        ((1, 0, -0.2), 64, True),  # the step
        ((1, 0, -1), 41, True),  # the floor
        ((1, 0, 2), 43.5, True),  # the ceiling
        ((1, 0, 1), 64, True),  # the wall above the opening
        ((1, 0, 0.5), 110, False),  # the sky
        ((1, 0, -0.07), 9 / 0.07, True),  # the higher floor of the right room
    ],
)
def test_a_ray_ends_at_the_first_surface(rooms, direction, depth, solid):
    found, surface = rooms.trace(EYE, np.array([direction], float))
    assert found[0] == pytest.approx(depth)
    assert surface[0] == solid


def test_a_map_is_written_and_read_and_static_it_keeps_its_walls_alone(rooms, tmp_path):
    rooms.write(tmp_path / "rooms.wad")
    read = Map.read(tmp_path / "rooms.wad", "MAP01")
    assert read.lumps == rooms.lumps
    assert read.start == "32,64,45"
    static = read.static(np.array([50.4, 60.0, 90.0]))
    assert static.start == "50,60,90"
    assert len(static.lumps["THINGS"]) == doom_map.THING.itemsize
    for lump, row in (("LINEDEFS", doom_map.LINE), ("SECTORS", doom_map.SECTOR)):
        before, after = np.frombuffer(rooms.lumps[lump], row), np.frombuffer(static.lumps[lump], row)
        assert not after["special"].any()
        for name in set(row.names or ()) - {"special"}:
            np.testing.assert_array_equal(after[name], before[name])
    assert list(static.lumps) == list(rooms.lumps)


def test_a_map_without_a_player_is_named(rooms):
    with pytest.raises(InputError, match="MAP01 has no start of a player; choose another map"):
        _ = _changed(rooms, "THINGS", lambda things: things["kind"].fill(3004)).start


def test_a_file_or_map_that_is_not_there_is_named(rooms, tmp_path):
    rooms.write(tmp_path / "rooms.wad")
    with pytest.raises(InputError, match=r"has no map E1M1; choose one of MAP01"):
        Map.read(tmp_path / "rooms.wad", "E1M1")
    with pytest.raises(InputError, match=r"nowhere\.wad is no WAD file"):
        Map.read(tmp_path / "nowhere.wad", "MAP01")


def _enlarged(world: Map, factor: float) -> Map:
    """The same rooms, so many times as wide."""
    corners = factor * np.frombuffer(world.lumps["VERTEXES"], "<i2")
    return Map(world.name, world.lumps | {"VERTEXES": corners.astype("<i2").tobytes()})


def _changed(world: Map, lump: str, change: Callable[[np.ndarray], object]) -> Map:
    """With other rows of a lump."""
    row = {"LINEDEFS": doom_map.LINE, "SECTORS": doom_map.SECTOR, "THINGS": doom_map.THING}[lump]
    rows = np.frombuffer(world.lumps[lump], row).copy()
    change(rows)
    return Map(world.name, world.lumps | {lump: rows.tobytes()})


def test_the_floor_is_that_of_the_room_and_a_step_too_high_ends_the_way(rooms):
    assert rooms.floor(64, 128) == 0
    assert rooms.floor(192, 128) == 32
    assert free_way(rooms, 64, 128, 0, 0) == pytest.approx(64)  # the step to the right room
    assert free_way(rooms, 192, 128, 32, 180) == pytest.approx(192)  # down it goes on
    assert free_way(rooms, 64, 128, 0, 90) == pytest.approx(128)
    low = _changed(rooms, "SECTORS", lambda sectors: sectors.__setitem__(1, (8, 50, *list(sectors[1])[2:])))
    assert free_way(low, 64, 128, 0, 0) == pytest.approx(64)  # a player would have to duck
    closed = _changed(rooms, "LINEDEFS", lambda lines: lines["flags"].__setitem__(6, 1))
    assert free_way(closed, 192, 128, 32, 180) == pytest.approx(64)
    assert closed.trace(np.array([192, 128, 73.0]), np.array([[-1.0, 0, 0]]))[0][0] == pytest.approx(192)


@pytest.mark.parametrize("seed", range(5))
def test_a_random_walk_has_a_free_way_from_each_waypoint_to_the_next(rooms, seed):
    # The other room is low enough to be climbed into, and too high for a step.
    hall = _changed(_enlarged(rooms, 8), "SECTORS", lambda sectors: sectors["floor"].__setitem__(1, 22))
    walk = random_walk(hall, seed)
    assert walk is not None
    assert len(walk) > MIN_STEPS
    assert np.array_equal(walk, np.asarray(random_walk(hall, seed)))
    assert not np.array_equal(walk, np.asarray(random_walk(hall, seed + 1)))
    for (x, y, _), (there_x, there_y, _) in itertools.pairwise(walk):
        toward = np.degrees(np.arctan2(there_y - y, there_x - x))
        distance = np.hypot(there_x - x, there_y - y)
        assert MARGIN - 1 < distance < LENGTHS[1] + 1
        assert free_way(hall, x, y, hall.floor(x, y), toward) > distance
        assert hall.floor(there_x, there_y) == 0
    sights = [free_way(hall, x, y, 0, look) for x, y, look in walk[1:]]
    assert np.median(sights) > FAR / 2


def test_a_random_walk_that_ends_in_a_corner_is_none(rooms):
    assert random_walk(_enlarged(rooms, 0.5), 0) is None


@pytest.mark.parametrize("seed", range(5))
def test_steering_reaches_a_waypoint_and_its_direction_without_a_jerk(seed):
    rng = np.random.default_rng(seed)
    x, y, yaw = rng.uniform(-100, 100, 3)
    goal = np.array([*rng.uniform(-100, 100, 2), rng.uniform(-180, 180)])
    for _ in range(400):
        forward, right, clockwise = steer(x, y, yaw, goal)
        assert np.hypot(forward, right) <= 10 + 1e-9
        assert abs(clockwise) <= 1
        ahead, side = camera_axes(yaw)[2, :2], camera_axes(yaw)[0, :2]
        (x, y), yaw = (x, y) + 0.5 * (forward * ahead + right * side), yaw - clockwise
    assert np.hypot(*(goal[:2] - (x, y))) < 1
    assert abs((goal[2] - yaw + 180) % 360 - 180) < 1e-6


def test_the_dataset_has_what_differs_as_its_mask_and_clean_test_views(rooms, tmp_path):
    clean = np.random.default_rng(0).integers(0, 256, (10, 72, 96, 3), np.uint8)
    marked = clean.copy()
    marked[:, 40:60, 20:40] = 255
    marked[3, 10:20, 60:70] = 255
    cameras = np.array([[64.0 + k, 128.0, 41.0, 5.0 * k] for k in range(10)])
    (said,) = write_dataset(tmp_path, rooms, [Recording(clean, marked, cameras)], 95)
    assert said.startswith("10 views, 2 of them clean test views, ")
    dataset = Dataset.read(tmp_path, eval_interval=8)
    assert [view.role for view in dataset.views].count("test") == 2
    ever, always = (np.asarray(Image.open(tmp_path / f"artifact_{name}.png")) for name in ("ever", "always"))
    assert always[21:29, 11:19].all()
    assert not always[:18].any()
    assert ever[6:9, 31:34].all()
    for view in dataset.views:
        counterpart = (tmp_path / view.path.replace("images", "clean")).read_bytes()
        assert (dataset.source(view.path).read_bytes() == counterpart) == (view.role == "test")
    check_points(tmp_path / "sparse_pc.ply")


def test_a_rig_has_a_folder_a_lens_and_masks_for_each_camera(rooms, tmp_path):
    rng = np.random.default_rng(0)
    recordings = []
    for name, size, yaw in (("front", (72, 96), 0.0), ("side", (48, 64), -60.0)):
        clean = rng.integers(0, 256, (9, *size, 3), np.uint8)
        marked = clean.copy()
        marked[:, :20] = 255
        cameras = np.array([[64.0 + k, 128.0, 41.0, yaw] for k in range(9)])
        recordings.append(Recording(clean, marked, cameras, name))
    assert len(write_dataset(tmp_path, rooms, recordings, 95)) == 2
    views = Dataset.read(tmp_path, eval_interval=8).views
    assert {(Path(view.path).parent.name, view.role) for view in views} == {
        (name, role) for name in ("front", "side") for role in ("train", "test")
    }
    assert {(view.lens.width, view.lens.height, view.lens.fx) for view in views} == {(48, 36, 24.0), (32, 24, 16.0)}
    for name, height in (("front", 36), ("side", 24)):
        mask = np.asarray(Image.open(tmp_path / f"artifact_{name}_always.png"))
        assert mask[:9].all()
        assert not mask[12:].any()
        assert len(mask) == height


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--side", "800", "450"], "--side has the size of the first camera's views"),
        (["--side", "500", "50"], "views of 500 x 50 cannot be drawn"),
        (["--width", "700"], "views of 700 x 450 cannot be drawn"),
        (["--path", "0,0,0", "1,2"], "--path 0,0,0 1,2: "),
        (["--map", "E1M1"], "has no map E1M1"),
        (["--random-walk", "-1"], "--random-walk must be 0 or more, got -1"),
        (["--random-walk", "0", "--map", "MAP20"], "--random-walk 0 leads nowhere in MAP20; choose another number, or"),
        (["--random-walk", "0", "--path", "0,0,0", "9,9,0"], "--path and --random-walk were both given"),
        (["--path", "-192,-192,0", "5000,5000,0"], "in MAP01 the game starts players at -192,-192,0"),
    ],
)
def test_what_cannot_be_recorded_is_refused_in_one_line_and_leaves_nothing(options, said, tmp_path):
    pytest.importorskip("vizdoom")
    command = [sys.executable, record_game.__file__, "--output", str(tmp_path / "out"), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def _project(meta: dict, pose: np.ndarray, points: np.ndarray, focal: float) -> np.ndarray:
    local = (points - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1]
    return focal * local[:, :2] / local[:, 2:] + (meta["cx"], meta["cy"])


def test_the_pictures_of_a_walk_agree_with_its_cameras_and_points(tmp_path):
    pytest.importorskip("vizdoom")
    walk = ("-150,-200,0", "-70,-60,-20", "60,-50,-5")
    Command(tmp_path / "walk", path=walk, width=320, height=200, weapon="Pistol").run()
    meta = json.loads((tmp_path / "walk" / "transforms.json").read_text())
    meta |= meta["frames"][0]
    assert len(meta["frames"]) > 10
    poses = [np.array(frame["transform_matrix"]) for frame in meta["frames"]]
    photos = [np.asarray(Image.open(path), float) for path in sorted((tmp_path / "walk" / "clean").iterdir())]
    import open3d

    cloud = open3d.io.read_point_cloud(tmp_path / "walk" / "sparse_pc.ply")
    points, colors = np.asarray(cloud.points), 255 * np.asarray(cloud.colors)

    def error(focal: float) -> float:
        """Median difference of the points' colors in the views that show them, of the nearest to each camera."""
        differences = []
        for pose, photo in zip(poses[::3], photos[::3], strict=True):
            ahead = (pose[:3, 3] - points) @ pose[:3, 2]
            near = (ahead > 0.3) & (ahead < 3)
            pixels = _project(meta, pose, points[near], focal)
            inside = ((pixels > 1) & (pixels < [meta["w"] - 1, meta["h"] - 1])).all(axis=1)
            u, v = pixels[inside].astype(int).T
            differences.append(np.abs(photo[v, u] - colors[near][inside]).mean(axis=1))
        return float(np.median(np.concatenate(differences)))

    right = error(meta["fl_x"])
    assert right < 0.8 * min(error(0.98 * meta["fl_x"]), error(1.02 * meta["fl_x"]))
