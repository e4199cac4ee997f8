"""Up, by what surfaces and the camera's attitude show."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import SIDES, direction_of
from bmask_slam.graph.geometry import so3_exp
from bmask_slam.semantics.objects.gravity import GravityEstimator, most_common

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 250.0
FLOOR_M = 1.2
PITCH = np.deg2rad(35.0)


def rays_of(turns: int) -> Array:
    """Rays (h, w, 3) of a camera, whose image is turned clockwise by right angles."""
    u, v = np.meshgrid(np.arange(WIDTH) - WIDTH / 2, np.arange(HEIGHT) - HEIGHT / 2)
    upright = np.stack([u / FOCAL_PX, v / FOCAL_PX, np.ones_like(u)], axis=-1)
    return np.rot90(upright @ mounted(turns), -turns)


def mounted(turns: int) -> Array:
    """R_upright_camera of a camera that is mounted with another side up."""
    return so3_exp(np.array([0.0, 0.0, -turns * np.pi / 2]))


def looking_down(side: str) -> tuple[GravityEstimator, dict[int, Array], Array]:
    """An estimator that has seen a floor, the keyframe's pose in the world, and up there."""
    turns = SIDES.index(side)
    rays = rays_of(turns)
    up_camera = mounted(turns).T @ np.array([0.0, -np.cos(PITCH), -np.sin(PITCH)])
    facing = -(rays @ up_camera)
    depth_m = np.where(facing > 0.3, FLOOR_M / np.maximum(facing, 1e-6), np.nan)
    estimator = GravityEstimator()
    estimator.add(7, depth_m.astype(np.float32), rays)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = so3_exp(np.array([0.3, -0.2, 0.5]))
    return estimator, {7: T_world_camera}, T_world_camera[:3, :3] @ up_camera


@pytest.mark.parametrize("side", SIDES)
def test_up_and_the_floor_with_any_side_of_the_image_up(side: str) -> None:
    estimator, poses, up_world = looking_down(side)
    estimator.use_side(side)
    found = estimator.up_world(poses)
    assert found == pytest.approx(up_world, abs=1e-3)
    assert estimator.floor_m(poses, found) == pytest.approx(-FLOOR_M, abs=0.02)


def test_the_top_is_up_where_that_is_not_known() -> None:
    estimator, poses, up_world = looking_down("top")
    estimator.use_side("")
    assert estimator.up_world(poses) == pytest.approx(up_world, abs=1e-3)
    assert GravityEstimator().up_world({}) == pytest.approx([0.0, -1.0, 0.0])
    assert GravityEstimator("right").up_world({}) == pytest.approx([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("side", "direction"),
    [("top", [0, -1, 0]), ("right", [1, 0, 0]), ("bottom", [0, 1, 0]), ("left", [-1, 0, 0])],
)
def test_directions_of_sides(side: str, direction: list[float]) -> None:
    assert direction_of(side).tolist() == direction


def test_keyframes_before_the_side_was_found_get_it_and_others_keep_theirs() -> None:
    """As of a merged map, of a camera that was mounted otherwise in the other run."""
    estimator, poses, up_world = looking_down("left")
    estimator.use_side("left")
    other, other_poses, other_up = looking_down("bottom")
    other.use_side("bottom")
    parts = estimator.state(), other.state()
    joint = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    joint["keyframes"][1] = 8
    both = GravityEstimator()
    both.restore(joint)
    assert both.up_world({7: poses[7]}) == pytest.approx(up_world, abs=1e-3)
    assert both.up_world({8: other_poses[7]}) == pytest.approx(other_up, abs=1e-3)


def test_the_most_common_side() -> None:
    assert most_common(["", "left", "left", "top"]) == "left"
    assert most_common(["bottom", "top"]) == "top"
    assert most_common(["", ""]) == ""


def test_the_side_is_kept_in_the_state() -> None:
    estimator, poses, up_world = looking_down("left")
    estimator.use_side("left")
    other = GravityEstimator()
    other.restore(estimator.state())
    assert other.side == "left"
    assert other.up_world(poses) == pytest.approx(up_world, abs=1e-3)
    older = {k: v for k, v in estimator.state().items() if k != "sides"}
    other.restore(older)
    assert other.side == "left"
    with pytest.raises(ValueError, match="sides of images are 0 to 4, found 5"):
        other.restore({**older, "sides": np.array([5])})
