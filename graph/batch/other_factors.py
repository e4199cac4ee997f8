"""All factors of a graph but the observations, linearised by GTSAM as sparse matrices."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.sparse import csr_array

from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.gtsam_factors import FactorMaker, make_graph, make_values
from bmask_slam.graph.factors.keys import keyframe_keys
from bmask_slam.graph.factors.own_factors import own_gtsam_factors
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.inertial.preintegration import inertial_graph, insert_states, read_states


class OtherFactors:
    """All factors but the observations, by GTSAM.

    Attributes:
        states: velocities, biases and directions of gravity.
    """

    def __init__(self, tables: FactorTables, camera: Camera, config: SmootherConfig) -> None:
        maker = FactorMaker(camera, config)
        poses = [
            maker.pose_factor(entry.factor) for _, entry in sorted(tables.pose_factors.items())
        ]
        inertial, change = inertial_graph(tables.inertial)
        self._graph = make_graph([*poses, *own_gtsam_factors(tables), *inertial])
        self._tables, self._keys = tables, keyframe_keys(tables.keyframes.ids)
        self.states = gtsam.Values()
        insert_states(self.states, tables.inertial, change)

    @property
    def width(self) -> int:
        """Length S of the tangent of all states."""
        return self.states.dim()

    def moved(self, shift: Array) -> gtsam.Values:
        """The states, moved by a tangent (S,) in the order of their keys."""
        zeros, step, at = self.states.zeroVectors(), gtsam.VectorValues(), 0
        for key in sorted(self.states.keys()):
            step.insert(key, shift[at : at + zeros.dim(key)])
            at += zeros.dim(key)
        return self.states.retract(step)

    def keep_states(self) -> None:
        """Write the states into the tables."""
        read_states(self.states, self._tables.inertial)

    def cost(self, poses: Array, points: Array, states: gtsam.Values) -> float:
        """Half the sum of squared errors, with kernels, at keyframes (K, 4, 4), points (L, 3)."""
        return float(self._graph.error(self._values(poses, points, states)))

    def linearised(self, poses: Array, points: Array, width: int) -> tuple[csr_array, Array]:
        """A (R, width + S) and b (R,) of the error |A x - b|^2 / 2.

        x are six for each keyframe first, then, after ``width``, the states.
        """
        values = self._values(poses, points, self.states)
        gaussian = self._graph.linearize(values)
        rows, columns, entries = gaussian.sparseJacobian_()
        rows, columns = rows.astype(int) - 1, columns.astype(int) - 1
        place = self._columns(gaussian, values, width)
        end = columns == len(place) - 1
        count = rows.max(initial=-1) + 1
        b = np.zeros(count)
        b[rows[end]] = entries[end]
        used = ~end & (place[columns] >= 0)
        shape = count, width + self.width
        return csr_array((entries[used], (rows[used], place[columns[used]])), shape), b

    def _columns(self, gaussian: Any, values: gtsam.Values, width: int) -> Ints:
        """Where each column of GTSAM's Jacobian is in x; -1 for variables that keep their values.

        GTSAM has the variables in the order of their keys.
        """
        zeros, at = values.zeroVectors(), {key: 6 * k for k, key in enumerate(self._keys)}
        for key in sorted(self.states.keys()):
            at[key], width = width, width + zeros.dim(key)
        parts = [
            at[key] + np.arange(zeros.dim(key)) if key in at else np.full(zeros.dim(key), -1)
            for key in sorted(gaussian.keyVector())
        ]
        return np.concatenate([*parts, [-1]])

    def _values(self, poses: Array, points: Array, states: gtsam.Values) -> gtsam.Values:
        tables = self._tables
        ids = tables.landmarks.ids if tables.own_factors else no_ids()
        values = make_values(tables.keyframes.ids, poses, ids, points[: len(ids)])
        values.insert(states)
        return values
