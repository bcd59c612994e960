"""Sparse points that a training would not start from are refused; open3d, which reads them, is the oracle."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import open3d
import pytest

from ssa_nerfstudio.data.sparse_points import check_points, write_points
from ssa_nerfstudio.errors import InputError

COUNT = 50


@pytest.fixture(params=["ascii", "binary"])
def points(request, tmp_path) -> Path:
    """A file of colored points, as open3d writes it."""
    rng = np.random.default_rng(0)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(rng.normal(size=(COUNT, 3))))
    cloud.colors = open3d.utility.Vector3dVector(rng.uniform(size=(COUNT, 3)))
    path = tmp_path / "points.ply"
    open3d.io.write_point_cloud(path, cloud, write_ascii=request.param == "ascii")
    return path


def test_whole_points_are_taken(points):
    check_points(points)


def test_points_that_are_cut_off_anywhere_are_refused(points):
    content = points.read_bytes()
    for length in [*range(0, len(content) - 8, 37), len(content) - 8]:
        points.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"points.ply cannot be read as sparse points .* remove ply_file_path"):
            check_points(points)


@pytest.mark.parametrize("count", [COUNT, 1])
def test_points_are_read_as_they_were_written(tmp_path, count):
    rng = np.random.default_rng(0)
    positions, colors = rng.normal(size=(count, 3)), rng.integers(0, 256, (count, 3))
    write_points(tmp_path / "points.ply", positions, colors.astype(np.uint8))
    check_points(tmp_path / "points.ply")
    cloud = open3d.io.read_point_cloud(tmp_path / "points.ply")
    np.testing.assert_allclose(np.asarray(cloud.points), positions, rtol=1e-6)
    np.testing.assert_array_equal(np.rint(255 * np.asarray(cloud.colors)), colors)


HEADER = "ply\nformat ascii 1.0\nelement vertex {}\n{}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (HEADER.format(0, XYZ + RGB), "it holds no points"),
        (HEADER.format(2, XYZ + RGB) + "a b c d e f\n1 2 3 4 5 6\n", "could not convert string to float"),
        (HEADER.format(2, XYZ + RGB) + "1 2 nan 4 5 6\n1 inf 3 4 5 6\n", "none of its 2 points is finite"),
        (HEADER.format(10**30, XYZ + RGB) + "1 2 3 4 5 6\n", "it holds 1 of the 1000000000000000000000000000000"),
        (HEADER.format(1, XYZ) + "0 0 0\n", "have no blue, green, red"),
        (HEADER.format(2, XYZ + RGB) + "0 0 0 1 2 3\n", "1 of the 2 points"),
        (HEADER.format(-1, XYZ + RGB), "it holds no points"),
        (HEADER.format("many", XYZ + RGB), "invalid literal"),
        (HEADER.format(10**12, XYZ + RGB), "0 of the 1000000000000"),
        ("solid stl\n", "header"),
        ("ply\nelement face 1\nend_header\n", "header"),
        ("ply\nformat ascii 1.0\nelement\nproperty\nend_header\n", "it holds no points"),
        ("\N{SNOWMAN}end_header\n", "ascii"),
    ],
)
def test_what_is_wrong_with_points_is_said(content, complaint, tmp_path):
    path = tmp_path / "points.ply"
    path.write_text(content)
    with pytest.raises(InputError, match=complaint):
        check_points(path)


def test_points_that_do_not_exist_are_named(tmp_path):
    with pytest.raises(InputError, match=r"gone.ply cannot be read as sparse points"):
        check_points(tmp_path / "gone.ply")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_are_refused_where_all_of_them_are_nowhere(value, tmp_path):
    positions = np.zeros((3, 3))
    positions[:2, 2] = value
    write_points(tmp_path / "points.ply", positions, np.zeros((3, 3), np.uint8))
    check_points(tmp_path / "points.ply")
    positions[2, 0] = value
    write_points(tmp_path / "points.ply", positions, np.zeros((3, 3), np.uint8))
    with pytest.raises(InputError, match="none of its 3 points is finite"):
        check_points(tmp_path / "points.ply")


def test_a_binary_file_that_states_more_points_than_there_could_be(tmp_path):
    write_points(tmp_path / "points.ply", np.zeros((3, 3)), np.zeros((3, 3), np.uint8))
    content = (tmp_path / "points.ply").read_bytes()
    (tmp_path / "points.ply").write_bytes(content.replace(b"vertex 3", b"vertex " + b"9" * 30))
    with pytest.raises(InputError, match=r"it holds 3 of the 9{30} points"):
        check_points(tmp_path / "points.ply")


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "points.ply")
    with pytest.raises(InputError, match="it is a pipe"):
        check_points(tmp_path / "points.ply")
