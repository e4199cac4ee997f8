"""The annotated boxes of a rendered sequence contain the pixels of the objects."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.geometry import transform
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.rendering.annotations import OBJECTS_TRUTH
from bmask_slam.rendering.config import RenderConfig, kinect_camera
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.object_map import pixel_rays


def test_boxes_fit_the_pixels_of_their_objects(tmp_path: Path) -> None:
    small = {"width": 160, "height": 120, "noise": False}
    config = RenderConfig("office", frames=3, fps=2.0, people=6, seed=4, **small)
    folder = render_sequence(config, tmp_path / "office")
    objects = json.loads((folder / OBJECTS_TRUTH).read_text())["objects"]
    boxes = {o["instance_id"]: o for o in objects}
    assert "person" not in {o["label"] for o in objects}  # what moves is nowhere
    content = json.loads((folder / "annotations.json").read_text())
    names = {c["id"]: c["name"] for c in content["categories"]}
    of_instance = {a["instance_id"]: names[a["category_id"]] for a in content["annotations"]}
    camera, rays = kinect_camera(config), pixel_rays(kinect_camera(config), 1)
    truth, checked = read_tum(folder / "groundtruth.txt"), 0
    for k, path in enumerate(sorted((folder / "instances").iterdir())):
        instances = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(folder / "depth" / path.name), cv2.IMREAD_UNCHANGED)
        points = rays * (depth / camera.depth_scale)[..., None]
        world = transform(truth.poses_world_camera[k], points.reshape(-1, 3)).reshape(points.shape)
        for i in set(np.unique(instances).tolist()) & set(boxes):
            assert of_instance[i] == boxes[i]["label"]
            mine = world[(instances == i) & (depth > 0)]
            box = OrientedBox(
                np.array(boxes[i]["T_world_box"]), np.array(boxes[i]["size_m"]) + 0.01
            )
            assert box.contains(mine).mean() > 0.97
            checked += 1
    assert checked > 20
