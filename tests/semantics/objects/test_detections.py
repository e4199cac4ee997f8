"""Instances as pieces of surface: which pixels count, and how their depth is smoothed."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.camera import Camera
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.objects.detections import DetectionConfig, Detections, detect
from bmask_slam.semantics.objects.object_map import pixel_rays

CAMERA = Camera(width=120, height=90, fx=100.0, fy=100.0, cx=59.5, cy=44.5)
SIZE = (90, 120)
RAYS = pixel_rays(CAMERA, 2)
SIGMA_M = 0.002
ALL = DetectionConfig(max_points=10_000, depth_sigma_m=SIGMA_M)


def found(depth_m: np.ndarray, score: float, config: DetectionConfig = ALL) -> Detections:
    instances = []
    for label, columns in ((1, slice(20, 60)), (2, slice(60, 100))):
        mask = np.zeros(SIZE, bool)
        mask[20:70, columns] = True
        instances.append(Instance(mask, mask_box(mask), label, certain(label, 3), 1.0, score))
    assignment = assign_pixels(instances, depth_m, SIZE, VoteConfig())
    return detect(assignment, depth_m, RAYS, config)


def noisy(rng: np.random.Generator) -> np.ndarray:
    """A plane at 3 m, a second instance a sigma behind it, some pixels far off or missing."""
    depth_m = np.full((45, 60), 3.0)
    depth_m[:, 30:] += SIGMA_M * 9
    depth_m += rng.normal(0, SIGMA_M * 9, depth_m.shape)
    depth_m[rng.random(depth_m.shape) < 0.1] += 0.12
    depth_m[rng.random(depth_m.shape) < 0.1] = np.nan
    return depth_m.astype(np.float32)


def test_depths_are_means_of_inverse_depth_over_similar_pixels() -> None:
    depth_m = noisy(np.random.default_rng(0))
    points = found(depth_m, 1.0).points_camera
    assert len(points) > 400
    for x, y, z in points[::7]:
        u, v = round((100 * x / z + 59.5) / 2), round((100 * y / z + 44.5) / 2)
        own, values = float(depth_m[v, u]), []
        for row in range(max(v - 2, 10), min(v + 3, 35)):
            for column in range(u - 2, u + 3):
                inside = 10 <= column < 30 if u < 30 else 30 <= column < 50
                other = float(depth_m[row, column])
                if inside and abs(other - own) < 3 * SIGMA_M * own**2:
                    values.append(1 / other)
        assert z == pytest.approx(1 / np.mean(values), rel=1e-5)


def test_smoothed_points_lie_nearer_to_the_surface() -> None:
    depth_m = noisy(np.random.default_rng(1))
    raw = found(depth_m, 1.0, DetectionConfig(max_points=10_000, smooth_px=0))
    smooth = found(depth_m, 1.0)
    spread = [np.percentile(f.points_camera[f.owners == 0, 2], (5, 50)) for f in (raw, smooth)]
    assert spread[1][1] - spread[1][0] < 0.5 * (spread[0][1] - spread[0][0])


def test_only_uncertain_masks_are_eroded() -> None:
    depth_m = np.full((45, 60), 2.0, np.float32)
    columns = {}
    for score in (1.0, 0.9):
        points = found(depth_m, score, DetectionConfig(max_points=10_000)).points_camera
        columns[score] = np.unique(np.rint((points[:, 0] * 100 / 2 + 59.5) / 2)).astype(int)
    assert columns[1.0].tolist() == list(range(10, 50))
    assert columns[0.9].tolist() == [*range(11, 30), *range(31, 50)]


@pytest.mark.parametrize(
    ("label", "rows", "alone"),
    [(1, slice(20, 70), False), (2, slice(20, 70), True), (1, slice(0, 90), True)],
    ids=["of-them", "other-class", "more-than-them"],
)
def test_a_mask_covered_by_others_of_its_class_is_dropped(
    label: int, rows: slice, alone: bool
) -> None:
    """A mask over two others."""
    both = (1, slice(20, 70), slice(20, 50), 0.9), (1, slice(20, 70), slice(55, 80), 0.8)
    instances = []
    for of_class, its_rows, its_columns, score in (*both, (label, rows, slice(20, 90), 0.5)):
        mask = np.zeros(SIZE, bool)
        mask[its_rows, its_columns] = True
        distribution = certain(of_class, 3)
        instances.append(Instance(mask, mask_box(mask), of_class, distribution, 1.0, score))
    depth_m = np.full((45, 60), 3.0, np.float32)
    assignment = assign_pixels(instances, depth_m, SIZE, VoteConfig())
    number = detect(assignment, depth_m, RAYS, ALL).number
    assert (number[:-1] >= 0).tolist() == [True, True, alone]
