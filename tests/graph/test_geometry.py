"""Rotations, rigid transforms and quaternions against simple references."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from bmask_slam.graph.geometry import (
    carried_along,
    inverse,
    make_pose,
    orthonormalised,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3_exp,
    se3_log,
    skew,
    so3_exp,
    so3_log,
    transform,
)

RNG = np.random.default_rng(7)
ANGLES_RAD = [0.0, 1e-12, 1e-8, 0.99e-4, 1.01e-4, 1e-3, 0.5, 2.0, 3.0, np.pi - 1e-4, np.pi - 1e-8]


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def deviation(T: np.ndarray) -> float:
    """Largest deviation of a rotation block from orthonormality."""
    R = T[:3, :3]
    return float(np.abs(R.T @ R - np.eye(3)).max())


def hat4(xi: np.ndarray) -> np.ndarray:
    """The (4, 4) matrix whose exponential is se3_exp, from the definition of the cross product."""
    M = np.zeros((4, 4))
    M[:3, :3] = np.stack([np.cross(xi[:3], e) for e in np.eye(3)], axis=1)
    M[:3, 3] = xi[3:]
    return M


def test_skew_is_the_cross_product() -> None:
    v, w = RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose((skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)
    np.testing.assert_array_equal(skew(v[0]), skew(v)[0])


def test_so3_exp_turns_x_towards_y_about_z() -> None:
    R = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_exponentials_equal_matrix_exponentials(angle_rad: float) -> None:
    axes = unit(RNG.normal(size=(20, 3)))
    xi = np.concatenate([angle_rad * axes, RNG.normal(size=(20, 3))], axis=1)
    expected = np.array([expm(hat4(row)) for row in xi])
    np.testing.assert_allclose(se3_exp(xi), expected, atol=1e-12)
    np.testing.assert_allclose(so3_exp(xi[:, :3]), expected[:, :3, :3], atol=1e-12)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_logarithms_invert_exponentials(angle_rad: float) -> None:
    axes = np.concatenate([unit(RNG.normal(size=(20, 3))), np.eye(3), -np.eye(3)])
    omega = angle_rad * axes
    np.testing.assert_allclose(so3_log(so3_exp(omega)), omega, rtol=0, atol=1e-12)
    xi = np.concatenate([omega, RNG.normal(size=omega.shape)], axis=1)
    np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, rtol=0, atol=1e-10)


def test_half_a_turn_has_the_axis_of_either_sign() -> None:
    axes = np.concatenate([np.eye(3), unit(RNG.normal(size=(20, 3)))])
    omega = so3_log(so3_exp(np.pi * axes))
    np.testing.assert_allclose(np.linalg.norm(omega, axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(omega * axes, axis=1)), np.pi, atol=1e-12)


@settings(deadline=None)
@given(st.lists(st.floats(-1.8, 1.8), min_size=6, max_size=6))
def test_log_of_small_motions_inverts_exp(xi: list[float]) -> None:
    omega = np.array(xi[:3])
    if np.linalg.norm(omega) < 3.0:
        np.testing.assert_allclose(se3_log(se3_exp(np.array(xi))), xi, atol=1e-9)


def test_update_is_on_the_right_and_translation_is_in_the_camera() -> None:
    """T @ se3_exp moves along the camera's own axes."""
    T_world_camera = make_pose(so3_exp(np.array([0.0, np.pi / 2, 0.0])), np.array([1.0, 2.0, 3.0]))
    forward = T_world_camera @ se3_exp(np.array([0, 0, 0, 0, 0, 0.5]))
    np.testing.assert_allclose(forward[:3, 3], [1.5, 2.0, 3.0], atol=1e-15)


def test_quaternions_are_x_y_z_w_as_in_scipy() -> None:
    R = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternion_from_rotation(R), [0, 0, half, half], atol=1e-15)
    np.testing.assert_allclose(quaternion_from_rotation(np.eye(3)), [0, 0, 0, 1], atol=0)
    q = unit(RNG.normal(size=(50, 4)))
    expected = Rotation.from_quat(q)  # x y z w too
    np.testing.assert_allclose(rotation_from_quaternion(q), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation_from_quaternion(3.0 * q), expected.as_matrix(), atol=1e-14)
    canonical = np.where(q[:, 3:] < 0, -q, q)
    np.testing.assert_allclose(
        quaternion_from_rotation(expected.as_matrix()), canonical, atol=1e-12
    )


@pytest.mark.parametrize("largest", range(4))
def test_quaternion_of_every_branch_of_shepperds_method(largest: int) -> None:
    """Half turns about each axis and no turn, each slightly off: all four formulas are used."""
    q = np.full((8, 4), 1e-3) * RNG.normal(size=(8, 4))
    q[:, largest] = 1.0
    q = unit(q)
    back = quaternion_from_rotation(rotation_from_quaternion(q))
    assert (back[:, 3] >= 0).all()
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1.0, atol=1e-14)
    np.testing.assert_allclose(
        rotation_from_quaternion(back), rotation_from_quaternion(q), atol=1e-13
    )


def test_inverse_of_stacks_of_transforms() -> None:
    T = se3_exp(RNG.normal(size=(2, 3, 6)))
    assert inverse(T).shape == (2, 3, 4, 4)
    np.testing.assert_allclose(inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-14)
    np.testing.assert_allclose(inverse(T), np.linalg.inv(T), atol=1e-13)


def test_transform_is_the_matrix_product_point_by_point() -> None:
    T, points = se3_exp(RNG.normal(size=(4, 6))), RNG.normal(size=(4, 7, 3))
    slow = np.array(
        [[(T[i] @ np.append(points[i, j], 1.0))[:3] for j in range(7)] for i in range(4)]
    )
    np.testing.assert_allclose(transform(T, points), slow, atol=1e-14)
    one_cloud = transform(T, points[0])
    assert one_cloud.shape == (4, 7, 3)
    np.testing.assert_allclose(one_cloud[2], transform(T[2], points[0]), atol=1e-14)
    one_pose = transform(T[1], points)
    assert one_pose.shape == (4, 7, 3)
    np.testing.assert_allclose(one_pose[3], transform(T[1], points[3]), atol=1e-14)
    assert transform(T[0], np.zeros((0, 3))).shape == (0, 3)


def test_make_pose_broadcasts_rotations_and_translations() -> None:
    R, t = so3_exp(RNG.normal(size=(5, 3))), RNG.normal(size=(5, 3))
    T = make_pose(R, t)
    np.testing.assert_array_equal(T[:, :3, :3], R)
    np.testing.assert_array_equal(T[:, :3, 3], t)
    np.testing.assert_array_equal(T[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))
    np.testing.assert_array_equal(make_pose(np.eye(3), t)[:, :3, 3], t)
    assert make_pose(R, np.zeros(3)).shape == (5, 4, 4)


def predicted_and_tracked(orthonormalise: bool) -> np.ndarray:
    """A constant-velocity loop: the pose is predicted from the previous motion."""
    T_last, T = np.eye(4), se3_exp(np.array([0.01, -0.02, 0.015, 0.01, 0.02, -0.01]))
    for _ in range(200):
        T_next = T @ inverse(T_last) @ T
        T_last, T = T, orthonormalised(T_next) if orthonormalise else T_next
        if not np.abs(T).max() < 1e3:
            break
    return T


def test_orthonormalised_gives_the_nearest_rotations() -> None:
    T = se3_exp(RNG.normal(size=(2, 5, 6)))
    disturbed = T.copy()
    disturbed[..., :3, :3] += 1e-3 * RNG.normal(size=(2, 5, 3, 3))
    U, _, Vt = np.linalg.svd(disturbed[..., :3, :3])
    nearest = disturbed.copy()
    nearest[..., :3, :3] = U @ Vt
    np.testing.assert_allclose(orthonormalised(disturbed), nearest, atol=1e-12)


def test_a_prediction_loop_stays_a_rotation_only_if_orthonormalised() -> None:
    assert deviation(predicted_and_tracked(True)) < 1e-14
    with np.errstate(all="ignore"):
        assert not deviation(predicted_and_tracked(False)) < 1e-2


def test_orthonormalised_changes_little_and_keeps_the_translation() -> None:
    T = se3_exp(RNG.normal(size=(6, 6)))
    np.testing.assert_allclose(orthonormalised(T), T, atol=1e-14)
    disturbed = T.copy()
    disturbed[:, :3, :3] += 1e-6 * RNG.normal(size=(6, 3, 3))
    fixed = orthonormalised(disturbed)
    assert max(deviation(one) for one in fixed) < 1e-14
    assert np.abs(fixed - T).max() < 1e-5
    np.testing.assert_array_equal(fixed[:, :3, 3], disturbed[:, :3, 3])


def test_a_pose_composed_a_thousand_times_stays_rigid():
    rng = np.random.default_rng(5)
    step = se3_exp(np.array([0.02, -0.01, 0.03, 0.05, 0.0, 0.02]))
    reference, T = np.eye(4), step
    for _ in range(1000):
        moved = reference @ se3_exp(0.01 * rng.normal(size=6))
        T = carried_along(T, reference, moved)
        np.testing.assert_allclose(inverse(moved) @ T, step, atol=1e-9)
        reference, T = T, T @ step
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
