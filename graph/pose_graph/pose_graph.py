"""Pose graphs as plain arrays: vertices, relative poses between them, connected components."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.geometry import inverse, make_pose


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """N poses and M relative poses. A 2-D graph is the same in the plane z = 0.

    Attributes:
        ids: (N,) int64, strictly increasing: the ids of the vertices in a file.
        poses: (N, 4, 4) T_world_vertex, metres.
        edges: (M, 2) int64, rows (i, j) into ``ids``.
        measurements: (M, 4, 4) T_i_j: ``T_world_j = T_world_i @ T_i_j`` without noise.
        information: (M, 6, 6) inverse covariances of the tangent [rotation rad, translation m] of
            each measurement; in a 2-D graph (M, 3, 3) of [x m, y m, angle rad], as Pose2 has it.
        fixed: (N,) bool, the vertices that must not move.
        has_poses: whether ``poses`` were given; if not they are identities, no initial values.

    Raises:
        ValueError: shapes that do not fit, or ids that do not increase.
    """

    ids: Ints
    poses: Array
    edges: Ints
    measurements: Array
    information: Array
    fixed: Mask
    has_poses: bool = True

    def __post_init__(self) -> None:
        n, m = len(self.ids), len(self.edges)
        tangent = self.information.shape[-1]
        shapes = {
            "poses": (self.poses.shape, (n, 4, 4)),
            "edges": (self.edges.shape, (m, 2)),
            "measurements": (self.measurements.shape, (m, 4, 4)),
            "information": (self.information.shape, (m, 6 if tangent == 6 else 3, tangent)),
            "fixed": (self.fixed.shape, (n,)),
        }
        for name, (found, expected) in shapes.items():
            if found != expected:
                raise ValueError(f"{name} has the shape {found}, expected {expected}")
        if (np.diff(self.ids) <= 0).any():
            raise ValueError("the ids of a pose graph must increase")

    @property
    def is_planar(self) -> bool:
        """Whether this is a 2-D graph."""
        return self.information.shape[-1] == 3

    @property
    def is_odometry(self) -> Mask:
        """(M,) bool: edges between vertices whose ids follow each other."""
        return np.abs(np.diff(self.ids[self.edges], axis=1)[:, 0]) == 1

    def with_poses(self, poses: Array) -> PoseGraph:
        """The same graph with poses (N, 4, 4)."""
        return replace(self, poses=poses, has_poses=True)

    def with_edges(self, keep: Ints | Mask) -> PoseGraph:
        """The same vertices with these edges alone (indices or mask over M)."""
        return replace(
            self,
            edges=self.edges[keep],
            measurements=self.measurements[keep],
            information=self.information[keep],
        )

    def with_vertices(self, keep: Mask) -> PoseGraph:
        """The vertices under a mask (N,), and the edges between them."""
        new_index = np.cumsum(keep) - 1
        inside = self.with_edges(np.asarray(keep[self.edges].all(axis=1)))
        return replace(
            inside,
            ids=self.ids[keep],
            poses=self.poses[keep],
            fixed=self.fixed[keep],
            edges=new_index[inside.edges],
        )


def planar_poses(x_y_angle: Array) -> Array:
    """Rigid transforms (..., 4, 4) in the plane from (..., 3): x m, y m, angle rad."""
    angle_rad = x_y_angle[..., 2]
    T = make_pose(np.eye(3), x_y_angle * [1.0, 1.0, 0.0])
    T[..., 0, 0] = T[..., 1, 1] = np.cos(angle_rad)
    T[..., 1, 0] = np.sin(angle_rad)
    T[..., 0, 1] = -T[..., 1, 0]
    return T


def planar_coordinates(T: Array) -> Array:
    """(..., 3) x m, y m and angle rad in (-pi, pi] of transforms (..., 4, 4) in the plane."""
    angle_rad = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    return np.concatenate([T[..., :2, 3], angle_rad[..., None]], axis=-1)


def complex_rotations(T: Array) -> NDArray[np.complex128]:
    """``exp(1j * angle)`` (N,) of transforms (N, 4, 4) in the plane."""
    return np.asarray(T[:, 0, 0] + 1j * T[:, 1, 0])


def component_labels(graph: PoseGraph) -> Ints:
    """(N,) number of the connected component of each vertex."""
    return connected_components(_adjacency(graph), directed=False)[1]


def is_connected(graph: PoseGraph) -> bool:
    """Whether edges connect every vertex with every other."""
    return not component_labels(graph).any()


def spanning_tree_poses(graph: PoseGraph) -> Array:
    """Poses (N, 4, 4) of a connected graph by chaining measurements along a tree.

    Only odometry edges are used if they connect the graph, which gives the odometry path. The
    first fixed vertex (or the first) keeps its pose.
    """
    odometry = graph.with_edges(graph.is_odometry)
    tree = odometry if is_connected(odometry) else graph
    root = int(np.argmax(graph.fixed))
    order, parent = breadth_first_order(_adjacency(tree), root, directed=False)
    edge_of = {(i, j): k for k, (i, j) in enumerate(tree.edges.tolist())}
    poses = graph.poses.copy()
    for child in order[1:].tolist():
        i = int(parent[child])
        k = edge_of.get((i, child))
        T_parent_child = (
            inverse(tree.measurements[edge_of[child, i]]) if k is None else tree.measurements[k]
        )
        poses[child] = poses[i] @ T_parent_child
    return poses


def _adjacency(graph: PoseGraph) -> coo_array:
    size = len(graph.ids)
    ones = np.ones(len(graph.edges))
    return coo_array((ones, (graph.edges[:, 0], graph.edges[:, 1])), shape=(size, size))
