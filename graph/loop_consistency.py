"""Which loop edges of a pose graph agree with each other, judged from short cycles alone."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import chi2

from graph.geometry import Array, inverse, se3_log
from graph.pose_graph import Mask, PoseGraph, is_connected, planar_coordinates, spanning_tree_poses

WINDOW = 3  # steps of odometry on either side of a cycle
PROBABILITY = 0.999


def supported_loops(graph: PoseGraph) -> Mask:
    """(M,) loop edges that another one confirms; all false where odometry leaves gaps.

    Two loops (i, j) and (k, l) whose ends are few odometry steps apart close a cycle,
    ``E = inverse(T_i_j) @ T_i_k @ T_k_l @ T_l_j``, the identity but for the noise of its edges. A
    random loop has no such partner. Absence of one proves nothing: the place was seen only once.
    """
    supported = np.zeros(len(graph.edges), bool)
    odometry = graph.with_edges(graph.is_odometry)
    if not is_connected(odometry):
        return supported
    loops = np.flatnonzero(~graph.is_odometry)
    i, j = graph.edges[loops].T
    swapped = i > j
    T = np.where(
        swapped[:, None, None], inverse(graph.measurements[loops]), graph.measurements[loops]
    )
    i, j = np.minimum(i, j), np.maximum(i, j)
    if len(loops) < 2:
        return supported
    a, b = KDTree(np.stack([i, j], axis=1)).query_pairs(WINDOW, p=np.inf, output_type="ndarray").T
    path = spanning_tree_poses(odometry)
    E = inverse(T[a]) @ inverse(path[i[a]]) @ path[i[b]] @ T[b] @ inverse(path[j[b]]) @ path[j[a]]
    loop_covariance = np.linalg.inv(graph.information[loops])
    step_covariance = np.linalg.inv(odometry.information).mean(axis=0)
    steps = np.abs(i[a] - i[b]) + np.abs(j[a] - j[b])
    # Covariances are added as they are: cycles are short, and the gate is wide.
    S = loop_covariance[a] + loop_covariance[b] + steps[:, None, None] * step_covariance
    r = planar_coordinates(E) if graph.is_planar else se3_log(E)
    chi_squares = _squared_norms(r, S)
    agree = chi_squares < chi2.ppf(PROBABILITY, r.shape[1])
    supported[loops[a[agree]]] = supported[loops[b[agree]]] = True
    return supported


def _squared_norms(r: Array, S: Array) -> Array:
    """``r^T inverse(S) r`` of vectors (K, d) and covariances (K, d, d)."""
    return np.sum(r * np.linalg.solve(S, r[..., None])[..., 0], axis=1)
