"""Adjustment of a whole graph together with the frames that are no keyframes.

ISAM2 and the batch optimiser hold keyframes alone, since every variable costs them time at every
update. At the end of a run the other frames' observations are known too, four times as many. Here
all poses and landmarks are variables: Gauss-Newton steps, damped as Levenberg and Marquardt do, in
which the landmarks are eliminated and the poses found by conjugate gradients on the Schur
complement, which is never formed (Agarwal et al., Bundle Adjustment in the Large, ECCV 2010).
All other factors (priors, loops, sensors, users' own) are linearised by GTSAM, together with the
states of inertial ones (velocities, biases, directions of gravity).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import block_diag, bsr_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.batch.group_sums import GroupSums
from bmask_slam.graph.batch.other_factors import OtherFactors
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.checks import OBSERVATION_PROBABILITY, chi2_quantile, reprojection
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations, concatenate
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.marginals.point_elimination import POINT_FLOOR_PER_M2, linearise
from bmask_slam.graph.smoother.isam2 import SolverError

CHUNK = 4096
"""Observations that are linearised at once: some megabytes."""
FIRST_DAMPING, LAST_DAMPING = 1e-5, 1e2
MAX_STEPS = (3, 4)
"""Before and after the frames' outliers are left out: what further steps move is tenths of a mm."""
LEAST_DECREASE = 1e-4
"""Of the cost, relative: a step that gains less is the last."""
CG_STEPS, CG_TOLERANCE = 150, 3e-3


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames that are no keyframes.

    Attributes:
        poses_world_camera: (F, 4, 4).
        observations: of landmarks of the graph; ``keyframe_ids`` are rows of the poses, ascending.
        weight: of all factors that are no observations; 1 as in the graph.
    """

    poses_world_camera: Array
    observations: Observations
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class JointResult:
    """What a joint adjustment found.

    Attributes:
        poses_world_camera: (F, 4, 4) of the frames.
        cost_before, cost_after: without the outliers of frames, when these were left out after the
            first steps, and in the end.
        steps: that were taken, also the first ones.
        outliers: observations of frames that were left out.
    """

    poses_world_camera: Array
    cost_before: float
    cost_after: float
    steps: int
    outliers: int


def adjust_jointly(
    tables: FactorTables, frames: Frames, camera: Camera, config: SmootherConfig
) -> JointResult:
    """Adjust a graph in place with the observations of other frames; returns the frames' poses.

    Observations of frames beyond their 95 % bound are left out after the first steps.

    Raises:
        SolverError: a factor cannot be evaluated, or the graph not be solved; nothing is changed.
    """
    try:
        problem = _Problem(tables, frames, camera, config)
        problem.descend(MAX_STEPS[0])
        outliers = problem.drop_outliers()
        before = problem.cost
        problem.descend(MAX_STEPS[1])
    except Exception as error:  # a user's factor may raise any
        raise SolverError(str(error).strip().partition("\n")[0], None) from error
    count = len(tables.keyframes.ids)
    tables.keyframes.values = problem.poses[:count].copy()
    tables.landmarks.values = problem.points
    problem.factors.keep_states()
    return JointResult(problem.poses[count:], before, problem.cost, problem.steps, outliers)


class _Problem:
    """All observations and factors with the present values of poses and points."""

    def __init__(
        self, tables: FactorTables, frames: Frames, camera: Camera, config: SmootherConfig
    ) -> None:
        own, others = tables.observations.all(), frames.observations
        self._camera, self._config, self._count = camera, config, len(tables.keyframes.ids)
        known = np.searchsorted(tables.keyframes.ids, own.keyframe_ids)
        pose = np.concatenate([known, others.keyframe_ids + self._count])
        both = concatenate([own, others])
        order = np.lexsort((both.landmark_ids, pose))
        self._observations, self._pose = both.select(order), pose[order]
        self._point = np.searchsorted(tables.landmarks.ids, self._observations.landmark_ids)
        self.poses = np.concatenate([tables.keyframes.values, frames.poses_world_camera])
        self.points = tables.landmarks.values.copy()
        self.factors, self._weight = OtherFactors(tables, camera, config), frames.weight
        self._damping, self.steps = FIRST_DAMPING, 0
        self.cost = self._cost(self.poses, self.points, self.factors.states)

    def drop_outliers(self) -> int:
        """Leave out observations of frames beyond their bound; returns their number."""
        bound = chi2_quantile(OBSERVATION_PROBABILITY, np.where(self._stereo, 3, 2))
        kept = np.ones(len(bound), bool)
        for rows in _chunks(len(self._pose)):
            kept[rows] = self._chi2(rows, self.poses, self.points) <= bound[rows]
        kept |= self._pose < self._count
        self._observations = self._observations.select(kept)
        self._pose, self._point = self._pose[kept], self._point[kept]
        self.cost = self._cost(self.poses, self.points, self.factors.states)
        return int(np.count_nonzero(~kept))

    @property
    def _stereo(self) -> Mask:
        """(M,) which observations have depth."""
        return np.isfinite(self._observations.measurements[:, 2])

    def descend(self, max_steps: int) -> None:
        """Take steps until the cost hardly falls."""
        for _ in range(max_steps):
            before = self.cost
            if not self._improve() or before - self.cost <= LEAST_DECREASE * before:
                return

    def _improve(self) -> bool:
        """Take a step by which the cost falls, with as much damping as that needs; False: none."""
        system = self._linearised()
        while not self._step(system):
            self._damping *= 10
            if self._damping > LAST_DAMPING:
                self._damping = FIRST_DAMPING
                return False
        self._damping = max(self._damping / 10, FIRST_DAMPING)
        self.steps += 1
        return True

    def _step(self, system: _System) -> bool:
        """Take a step if the cost falls; whether it does."""
        xi, shift, change = system.solve(self._damping)
        poses, points = self.poses @ se3_exp(xi), self.points + shift
        states = self.factors.moved(change)
        cost = self._cost(poses, points, states)
        if not cost < self.cost:
            return False
        self.poses, self.points, self.factors.states, self.cost = poses, points, states, cost
        return True

    def _cost(self, poses: Array, points: Array, states: gtsam.Values) -> float:
        """Half the sum of squared errors with Huber's kernel; infinite beyond all values."""
        config = self._config
        total = self._weight * self.factors.cost(poses[: self._count], points, states)
        for rows in _chunks(len(self._pose)):
            squares = self._chi2(rows, poses, points)
            k = np.where(self._stereo[rows], config.huber_stereo, config.huber_mono)
            outer = config.robust & (squares > k**2)
            total += float(np.sum(np.where(outer, k * np.sqrt(squares) - k**2 / 2, squares / 2)))
        return total if math.isfinite(total) else math.inf

    def _chi2(self, rows: Ints, poses: Array, points: Array) -> Array:
        """Squared errors (M,) of observations, without the kernel."""
        observations = self._observations.select(rows)
        own_poses, own_points = poses[self._pose[rows]], points[self._point[rows]]
        return reprojection(observations, own_poses, own_points, self._camera)[1]

    def _linearised(self) -> _System:
        P, L = len(self.poses), len(self.points)
        H_pose, g_pose = np.zeros((P, 6, 6)), np.zeros((P, 6))
        H_point, g_point = np.zeros((L, 3, 3)), np.zeros((L, 3))
        cross = np.zeros((len(self._pose), 6, 3))
        for rows in _chunks(len(self._pose)):
            r, J_pose, J_point = linearise(
                self._observations.select(rows),
                self.poses[self._pose[rows]],
                self.points[self._point[rows]],
                self._camera,
                self._config,
            )
            of_poses, of_points = GroupSums(self._pose[rows], P), GroupSums(self._point[rows], L)
            J_pose_T, J_point_T = J_pose.swapaxes(1, 2), J_point.swapaxes(1, 2)
            cross[rows] = J_pose_T @ J_point
            H_pose += of_poses(J_pose_T @ J_pose)
            H_point += of_points(J_point_T @ J_point)
            g_pose += of_poses((J_pose_T @ r[:, :, None])[:, :, 0])
            g_point += of_points((J_point_T @ r[:, :, None])[:, :, 0])
        A, b = self.factors.linearised(self.poses[: self._count], self.points, 6 * P)
        A, b = A * math.sqrt(self._weight), b * math.sqrt(self._weight)
        g = np.concatenate([g_pose.ravel(), np.zeros(self.factors.width)]) - A.T @ b
        return _System(H_pose, H_point, g, g_point, A, cross, self._pose, self._point)


def _chunks(count: int) -> list[Ints]:
    """Rows 0 to count - 1, CHUNK at a time."""
    return np.split(np.arange(count), range(CHUNK, count, CHUNK))


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of poses, S states and points at one place.

    Blocks H_pose (P, 6, 6), H_point (L, 3, 3) and cross (M, 6, 3), by pose and then point, with
    gradients g (6P + S,) and g_point (L, 3); ``A`` (R, 6P + S) are the other factors.
    """

    H_pose: Array
    H_point: Array
    g: Array
    g_point: Array
    A: csr_array
    cross: Array
    pose: Ints
    point: Ints

    def solve(self, damping: float) -> tuple[Array, Array, Array]:
        """Tangents (P, 6) of the poses, on the right side, shifts (L, 3) of points, states (S,)."""
        P, L = len(self.H_pose), len(self.H_point)
        starts = np.searchsorted(self.pose, np.arange(P + 1))
        C = bsr_array((self.cross, self.point, starts), shape=(6 * P, 3 * L))
        C_T = C.T
        damped = self.H_point * (1 + damping * np.eye(3)) + POINT_FLOOR_PER_M2 * np.eye(3)
        inverse_point = np.asarray(np.linalg.inv(damped), float)
        H_pose = self.H_pose * (1 + damping * np.eye(6))
        squares = self.A.multiply(self.A).sum(axis=0)[6 * P :]
        H = csc_array(self.A.T @ self.A + diags_array(np.r_[np.zeros(6 * P), damping * squares]))

        def times(x: Array) -> Array:
            """The Schur complement times x (6P + S,)."""
            poses = x[: 6 * P]
            inner = (inverse_point @ (C_T @ poses).reshape(L, 3, 1)).ravel()
            y = np.asarray(H @ x)
            y[: 6 * P] += (H_pose @ poses.reshape(P, 6, 1)).ravel() - C @ inner
            return y

        right = (inverse_point @ self.g_point[:, :, None]).ravel()
        b = -self.g
        b[: 6 * P] += C @ right
        size = len(b), len(b)
        schur = LinearOperator(size, times)
        nearby = LinearOperator(size, self._preconditioner(H_pose, inverse_point, H).solve)
        x, _ = cg(schur, b, rtol=CG_TOLERANCE, maxiter=CG_STEPS, M=nearby)
        poses, states = x[: 6 * P], x[6 * P :]
        shift = -right - (inverse_point @ (C_T @ poses).reshape(L, 3, 1)).ravel()
        return poses.reshape(P, 6), shift.reshape(L, 3), states

    def _preconditioner(self, H_pose: Array, inverse_point: Array, H: csc_array) -> SuperLU:
        """The Schur complement without what points join of different poses, factorised."""
        blocks = H_pose.copy()
        for rows in _chunks(len(self.pose)):
            cross = self.cross[rows]
            known = cross @ inverse_point[self.point[rows]] @ cross.swapaxes(1, 2)
            blocks -= GroupSums(self.pose[rows], len(blocks))(known)
        P, S = len(blocks), H.shape[0] - 6 * len(blocks)
        alone = block_diag([bsr_array((blocks, np.arange(P), np.arange(P + 1))), csr_array((S, S))])
        return splu(csc_array(alone + H), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
