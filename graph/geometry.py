"""Rigid transforms as (4, 4) float64 arrays, vectorised, in numpy alone.

``T_a_b`` maps coordinates of frame b to frame a: ``p_a = T_a_b @ p_b``. Tangent vectors are
``[rotation, translation]`` (GTSAM's order), and updates are on the right:
``T <- T @ se3_exp(xi)``.
"""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array


def make_pose(R: Array, t: Array) -> Array:
    """Stack rotations (..., 3, 3) and translations (..., 3) in metres into (..., 4, 4)."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T_a_b: Array) -> Array:
    """Inverse of rigid transforms (..., 4, 4): ``T_b_a``."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros(T_a_b.shape)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3:] = -(R_b_a @ T_a_b[..., :3, 3:])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def orthonormalised(T: Array) -> Array:
    """The rigid transforms (..., 4, 4) nearest to products with accumulated rounding errors.

    Where a prediction and its update depend on each other (``T <- T @ inverse(T_last) @ T``), a
    deviation from orthonormality doubles every frame; such code must call this.
    """
    R = T[..., :3, :3]
    for _ in range(3):  # Newton's iteration for the polar factor: the error e becomes 3/4 e^2
        R = 1.5 * R - 0.5 * R @ (np.swapaxes(R, -1, -2) @ R)
    nearest = np.zeros(T.shape)
    nearest[..., :3, :3] = R
    nearest[..., :3, 3] = T[..., :3, 3]
    nearest[..., 3, 3] = 1.0
    return nearest


def carried_along(T_world_a: Array, T_world_old: Array, T_world_new: Array) -> Array:
    """The pose of a (4, 4) after a body that it is fixed to has moved from old to new.

    The result is orthonormalised: in a chain of such steps an error of the rotations would double
    with every step.
    """
    return orthonormalised(T_world_new @ inverse(T_world_old) @ T_world_a)


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Points (..., N, 3) in metres from frame b to frame a."""
    return points_b @ np.swapaxes(T_a_b[..., :3, :3], -1, -2) + T_a_b[..., None, :3, 3]


def skew(v: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(v) @ w = v x w``."""
    v = np.asarray(v, float)
    S = np.zeros((*v.shape, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return S - np.swapaxes(S, -1, -2)


def adjoint(T_a_b: Array) -> Array:
    """Adjoints (..., 6, 6): ``T_a_b @ se3_exp(xi) = se3_exp(adjoint(T_a_b) @ xi) @ T_a_b``."""
    R = T_a_b[..., :3, :3]
    A = np.zeros((*T_a_b.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., 3:, :3] = skew(T_a_b[..., :3, 3]) @ R
    return A


def _series(theta_rad: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1-cos a)/a^2 and (a-sin a)/a^3, by Taylor series near zero."""
    small = theta_rad < 1e-4
    a = np.where(small, 1.0, theta_rad)
    a2 = theta_rad**2
    return (
        np.where(small, 1 - a2 / 6, np.sin(a) / a),
        np.where(small, 0.5 - a2 / 24, (1 - np.cos(a)) / a**2),
        np.where(small, 1 / 6 - a2 / 120, (a - np.sin(a)) / a**3),
    )


def so3_exp(omega_rad: Array) -> Array:
    """Rotations (..., 3, 3) from rotation vectors (..., 3) in radians (Rodrigues)."""
    omega_rad = np.asarray(omega_rad, float)
    A, B, _ = _series(np.linalg.norm(omega_rad, axis=-1))
    W = skew(omega_rad)
    return np.eye(3) + A[..., None, None] * W + B[..., None, None] * (W @ W)


def so3_log(R: Array) -> Array:
    """Rotation vectors (..., 3) in radians of rotations (..., 3, 3), right up to pi."""
    q = quaternion_from_rotation(R)
    n = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2 * np.arctan2(n, q[..., 3])
    scale = np.where(n < 1e-12, 2.0, angle / np.where(n < 1e-12, 1.0, n))
    return scale[..., None] * q[..., :3]


def step_lengths(T_world_a: Array, T_world_b: Array) -> Array:
    """Radians and metres (N, 2) of the steps from poses (N, 4, 4) to others (N, 4, 4)."""
    turns = np.linalg.norm(so3_log((inverse(T_world_a) @ T_world_b)[:, :3, :3]), axis=1)
    moves = np.linalg.norm(T_world_b[:, :3, 3] - T_world_a[:, :3, 3], axis=1)
    return np.stack([turns, moves], axis=1)


def se3_exp(xi: Array) -> Array:
    """Rigid transforms (..., 4, 4) from tangents (..., 6) ``[rotation rad, translation m]``."""
    xi = np.asarray(xi, float)
    omega, v = xi[..., :3], xi[..., 3:]
    _, B, C = _series(np.linalg.norm(omega, axis=-1))
    W = skew(omega)
    V = np.eye(3) + B[..., None, None] * W + C[..., None, None] * (W @ W)
    return make_pose(so3_exp(omega), (V @ v[..., None])[..., 0])


def se3_log(T: Array) -> Array:
    """Tangents (..., 6) ``[rotation rad, translation m]`` of rigid transforms (..., 4, 4)."""
    omega = so3_log(T[..., :3, :3])
    _, B, C = _series(np.linalg.norm(omega, axis=-1))
    W = skew(omega)
    V = np.eye(3) + B[..., None, None] * W + C[..., None, None] * (W @ W)
    v = np.linalg.solve(V, T[..., :3, 3:])[..., 0]
    return np.concatenate([omega, v], axis=-1)


def rotation_from_quaternion(q_xyzw: Array) -> Array:
    """Rotations (..., 3, 3) from quaternions (..., 4) in TUM order x y z w, normalised here."""
    q = np.asarray(q_xyzw, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3, None, None]
    S = skew(v)
    return np.eye(3) + 2 * w * S + 2 * (S @ S)


_OFF_DIAGONAL = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def quaternion_from_rotation(R: Array) -> Array:
    """Unit quaternions (..., 4) in TUM order x y z w with w >= 0 from rotations (..., 3, 3).

    Shepperd's method, vectorised: of four equivalent formulas it uses the best conditioned.
    """
    R = np.asarray(R, float)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    a, b, c = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    d, e, f = (
        R[..., 1, 0] + R[..., 0, 1],
        R[..., 0, 2] + R[..., 2, 0],
        R[..., 2, 1] + R[..., 1, 2],
    )
    K = np.empty((*m00.shape, 4, 4))
    K[..., 0, 0], K[..., 1, 1] = 1 + m00 - m11 - m22, 1 - m00 + m11 - m22
    K[..., 2, 2], K[..., 3, 3] = 1 - m00 - m11 + m22, 1 + m00 + m11 + m22
    for (i, j), value in zip(_OFF_DIAGONAL, (d, e, a, f, b, c), strict=True):
        K[..., i, j] = K[..., j, i] = value
    best = np.argmax(np.diagonal(K, axis1=-2, axis2=-1), axis=-1)
    q = K.reshape(-1, 4, 4)[np.arange(best.size), best.ravel()].reshape(K.shape[:-1])
    q = q / np.sqrt((q * q).sum(axis=-1, keepdims=True))
    return np.where(q[..., 3:] < 0, -q, q)
