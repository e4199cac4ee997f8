"""objects.png: what is drawn of the camera's path, and where names stand."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from bmask_slam.graph.geometry import make_pose
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.run_folder.object_picture import _write_names, draw_objects
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.publication import MapObject

UP = np.array([0.0, -1.0, 0.0])
COUNT = 40


def dark_pixels(path: Path, stamps_s: np.ndarray) -> int:
    """Of the picture of a camera that moves 4 m along x, halfway from 1 to 3 m in one step."""
    steps_m = np.linspace(0, 1, COUNT // 2)
    places = np.zeros((COUNT, 3))
    places[:, 0] = np.concatenate([steps_m, 3 + steps_m])
    none = np.zeros(0, np.int64)
    cloud = LandmarkCloud(none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none)
    walked = Trajectory(stamps_s, make_pose(np.eye(3), places))
    draw_objects(path, cloud, MapObjects(LabelSet(("background", "cup")), [], UP), walked)
    return int((cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) < 100).sum())


def test_no_line_is_drawn_where_the_camera_was_lost(tmp_path: Path) -> None:
    stamps_s = np.arange(COUNT) / 30
    whole = dark_pixels(tmp_path / "a.png", stamps_s)
    stamps_s[COUNT // 2 :] += 2.0
    apart = dark_pixels(tmp_path / "b.png", stamps_s)
    assert 0.5 * whole < apart < whole - 500


def test_names_of_objects_at_the_upper_border_stay_in_the_picture() -> None:
    """Above it they would be below the title."""
    axes = Figure().add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    none, names = np.zeros(0, np.int64), LabelSet(("background", "cup"))
    centre_world = np.array([0.5, 0.97, 0.0])
    box = OrientedBox(make_pose(np.eye(3), centre_world), np.full(3, 0.02))
    cups = [
        MapObject(k, 1, np.array([0.1, 0.9]), centre_world, box, none, none, 0.0, 1.0)
        for k in range(3)
    ]
    corners = [box.corners_world[:, :2]] * len(cups)
    _write_names(axes, cups, corners, MapObjects(names, cups, UP))
    heights = sorted(text.xy[1] for text in axes.texts)
    assert heights[-1] < 0.98
    assert np.diff(heights).min() > 0.04
