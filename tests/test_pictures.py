"""What is drawn: unknown voxels dark, nearer ones in front, labels in their colours."""

import numpy as np
import pytest

from daemon.maps import depth_picture, write_ply
from daemon.pictures import coloured, draw_voxels
from surfclass.map_file import MapFile
from surfclass.voxel_map import MapLayers

CLASS_RGB = np.array([[200, 0, 0], [0, 200, 0]], np.uint8)
DARK = [40, 40, 40]


def layers():
    p = np.array([[0.9, 0.1], [0.2, 0.8], [0.5, 0.5]], np.float32)
    index = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.int32)
    ones = np.ones(3, np.float32)
    return MapLayers(index, p, p, p, ones, ones.astype(np.int32))


def test_unknown_points_are_dark_in_the_ply(tmp_path):
    pytest.importorskip("open3d", exc_type=ImportError)
    import open3d

    write_ply(tmp_path / "map.ply", MapFile(0.01, ("a", "b"), layers()), CLASS_RGB)
    cloud = open3d.io.read_point_cloud(tmp_path / "map.ply")
    np.testing.assert_allclose(np.asarray(cloud.points)[:, 0], [0.005, 0.015, 0.025])
    found = np.round(np.asarray(cloud.colors) * 255).astype(int)
    assert found.tolist() == [[200, 0, 0], [0, 200, 0], DARK]


def test_labels_have_their_colours_and_zero_is_dark():
    found = coloured(np.array([[0, 1, 2]], np.uint8), CLASS_RGB)
    assert found[0].tolist() == [DARK, [200, 0, 0], [0, 200, 0]]


def test_the_voxel_in_front_hides_the_one_behind():
    index = np.array([[0, 0, 0], [5, 0, 0]], np.int32)
    for eye, wanted in ((1.0, 1), (-1.0, 0)):
        picture = draw_voxels(index, 0.01, CLASS_RGB, np.array([eye, 0.0, 1e-6]), width=200)
        middle = picture[picture.shape[0] // 2, 100]
        assert middle.argmax() == wanted
        assert middle[1 - wanted] == 0


def test_depth_without_return_is_black():
    depth = np.array([[0, 500, 1500]], np.uint16)
    picture = depth_picture(depth)
    assert picture[0, 0].tolist() == [0, 0, 0]
    assert picture[0, 1, 2] > picture[0, 1, 0]  # near is blue
    assert picture[0, 2, 0] > picture[0, 2, 2]  # far is red
    assert not depth_picture(np.zeros((2, 2), np.uint16)).any()
