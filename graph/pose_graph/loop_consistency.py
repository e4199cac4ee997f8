"""Which loop edges of a pose graph agree with each other, judged from short cycles alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.factors.checks import chi2_quantile, mahalanobis
from bmask_slam.graph.geometry import adjoint, inverse, se3_log
from bmask_slam.graph.pose_graph.pose_graph import (
    PoseGraph,
    is_connected,
    planar_coordinates,
    spanning_tree_poses,
)

WINDOW = 3  # steps of odometry on either side of a cycle
PROBABILITY = 0.999
MIN_CYCLES = 20  # to estimate the noise from
SCALE_MARGIN = 10.0  # a smaller scale of the noise cannot be distinguished from 1


@dataclass(frozen=True, eq=False)
class LoopConsistency:
    """What short cycles say of the loop edges of a pose graph.

    Attributes:
        consistent: (M,) bool, loop edges that agree with another one.
        noise_scale: factor for the bounds of chi-squares; 1 where the information matrices are
            about right, or where there are too few cycles to tell.
    """

    consistent: Mask
    noise_scale: float


def loop_consistency(graph: PoseGraph) -> LoopConsistency:
    """Which loop edges agree with each other; none if odometry does not connect the graph.

    Two loops (i, j) and (k, l) whose ends are few odometry steps apart close a cycle,
    ``E = inverse(T_i_j) @ T_i_k @ T_k_l @ T_l_j``, the identity but for noise. A random loop agrees
    with no other. A loop without a partner may be right: the place was then seen only once.

    Some files state information that is off by orders of magnitude, parking-garage's by four. All
    loops would then agree, or none. The cycles of right loops, the majority, show it: the median of
    their chi-squares against that of the distribution. A margin is left for what is neglected here,
    and because other loops may be less accurate than consistent ones.
    """
    consistent = np.zeros(len(graph.edges), bool)
    odometry = graph.with_edges(graph.is_odometry)
    loops = np.flatnonzero(~graph.is_odometry)
    if len(loops) < 2 or not is_connected(odometry):
        return LoopConsistency(consistent, 1.0)
    a, b, chi_squares = _short_cycles(graph, odometry, loops)
    degrees = graph.information.shape[-1]
    scale = 1.0
    if len(chi_squares) >= MIN_CYCLES:
        ratio = float(np.median(chi_squares) / chi2_quantile(0.5, degrees))
        scale = max(min(1.0, SCALE_MARGIN * ratio), ratio / SCALE_MARGIN)
    agree = chi_squares < scale * chi2_quantile(PROBABILITY, degrees)
    consistent[loops[a[agree]]] = consistent[loops[b[agree]]] = True
    return LoopConsistency(consistent, scale)


def _short_cycles(graph: PoseGraph, odometry: PoseGraph, loops: Ints) -> tuple[Ints, Ints, Array]:
    """Pairs (P,), (P,) of rows into ``loops`` that close short cycles, and their chi-squares."""
    i, j = graph.edges[loops].T
    swapped = i > j
    T = np.where(
        swapped[:, None, None], inverse(graph.measurements[loops]), graph.measurements[loops]
    )
    i, j = np.minimum(i, j), np.maximum(i, j)
    a, b = KDTree(np.stack([i, j], axis=1)).query_pairs(WINDOW, p=np.inf, output_type="ndarray").T
    path = spanning_tree_poses(odometry)
    E = inverse(T[a]) @ inverse(path[i[a]]) @ path[i[b]] @ T[b] @ inverse(path[j[b]]) @ path[j[a]]
    loop_covariance = np.linalg.inv(graph.information[loops])
    step_covariance = np.linalg.inv(odometry.information).mean(axis=0)
    steps = np.abs(i[a] - i[b]) + np.abs(j[a] - j[b])
    # Covariances are added without adjoints: cycles are short, and the bound is wide.
    S = loop_covariance[a] + loop_covariance[b] + steps[:, None, None] * step_covariance
    r = planar_coordinates(E) if graph.is_planar else se3_log(E)
    return a, b, mahalanobis(r, S)


def cycle_chi2(
    T_a_b: Array,
    covariances: Array,
    ends: tuple[Array, Array],
    pairs: tuple[Ints, Ints],
    map_covariances: Array,
) -> Array:
    """Chi-square (P,), 6 degrees of freedom, of the cycles that pairs of loops close.

    For loops (a, b) and (c, d): ``E = inverse(T_a_b) @ T_a_c @ T_c_d @ T_d_b``, where T_a_c and
    T_d_b are the map's. Covariances are transformed to E's right side by adjoints.

    Args:
        T_a_b: (N, 4, 4) measured; covariances: (N, 6, 6) on their right side.
        ends: T_world_a and T_world_b (N, 4, 4), as in the map.
        pairs: (P,) rows of the loops (a, b), and (P,) rows of the loops (c, d).
        map_covariances: (2, P, 6, 6) of T_a_c and of T_d_b.
    """
    (first, second), (T_world_a, T_world_b) = pairs, ends
    T_a_c = inverse(T_world_a[first]) @ T_world_a[second]
    T_d_b = inverse(T_world_b[second]) @ T_world_b[first]
    E = inverse(T_a_b[first]) @ T_a_c @ T_a_b[second] @ T_d_b
    carry_c = adjoint(inverse(T_a_b[second] @ T_d_b))
    carry_d = adjoint(inverse(T_d_b))
    S = covariances[first] + map_covariances[1]
    S = S + carry_c @ map_covariances[0] @ np.swapaxes(carry_c, -1, -2)
    S = S + carry_d @ covariances[second] @ np.swapaxes(carry_d, -1, -2)
    return mahalanobis(se3_log(E), S)


def largest_clique(agree: Mask) -> Ints:
    """Indices of a large set of loops that all agree (N, N), found greedily from each member."""
    best: list[int] = []
    order = np.argsort(-agree.sum(axis=1), kind="stable").tolist()
    for start in order:
        clique = [start]
        for k in order:
            if agree[k, clique].all():
                clique.append(k)
        if len(clique) > len(best):
            best = clique
    return np.sort(np.array(best, np.int64))
