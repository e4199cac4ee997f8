"""Which loop edges of a pose graph agree with each other, judged from short cycles alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import chi2

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.factors.checks import mahalanobis
from bmask_slam.graph.geometry import adjoint, inverse, se3_log
from bmask_slam.graph.pose_graph.pose_graph import (
    PoseGraph,
    is_connected,
    planar_coordinates,
    spanning_tree_poses,
)

WINDOW = 3  # steps of odometry on either side of a cycle
PROBABILITY = 0.999
MIN_CYCLES = 20  # to judge the noise by
SCALE_MARGIN = 10.0  # below which a scale of the noise is not told from 1


@dataclass(frozen=True, eq=False)
class LoopSupport:
    """What short cycles say of a pose graph.

    Attributes:
        supported: (M,) bool, loop edges that another one confirms.
        noise_scale: by which the bounds of chi-squares are to be multiplied; 1 where the
            information matrices are about right, or where there are too few cycles to tell.
    """

    supported: Mask
    noise_scale: float


def loop_support(graph: PoseGraph) -> LoopSupport:
    """Which loops confirm each other; none where odometry leaves gaps.

    Two loops (i, j) and (k, l) whose ends are few odometry steps apart close a cycle,
    ``E = inverse(T_i_j) @ T_i_k @ T_k_l @ T_l_j``, the identity but for the noise of its edges. A
    random loop has no such partner. Absence of one proves nothing: the place was seen only once.

    Some files state information that is off by orders of magnitude, parking-garage's by four. All
    loops would then confirm each other, or none. Cycles of right loops, the majority, show it: the
    median of their chi-squares against that of the distribution. A margin is left, for what is
    neglected here and because unconfirmed loops may be worse than confirmed ones.
    """
    supported = np.zeros(len(graph.edges), bool)
    odometry = graph.with_edges(graph.is_odometry)
    loops = np.flatnonzero(~graph.is_odometry)
    if len(loops) < 2 or not is_connected(odometry):
        return LoopSupport(supported, 1.0)
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
    # Covariances are added as they are: cycles are short, and the gate is wide.
    S = loop_covariance[a] + loop_covariance[b] + steps[:, None, None] * step_covariance
    r = planar_coordinates(E) if graph.is_planar else se3_log(E)
    chi_squares = mahalanobis(r, S)
    expected = chi2(r.shape[1])
    scale = 1.0
    if len(chi_squares) >= MIN_CYCLES:
        ratio = float(np.median(chi_squares) / expected.median())
        scale = max(min(1.0, SCALE_MARGIN * ratio), ratio / SCALE_MARGIN)
    agree = chi_squares < scale * expected.ppf(PROBABILITY)
    supported[loops[a[agree]]] = supported[loops[b[agree]]] = True
    return LoopSupport(supported, scale)


def cycle_chi2(
    T_a_b: Array,
    covariances: Array,
    ends: tuple[Array, Array],
    pairs: tuple[Ints, Ints],
    map_covariances: Array,
) -> Array:
    """Chi-square (P,), 6 degrees of freedom, of the cycles that pairs of loops close.

    For loops (a, b) and (c, d): ``E = inverse(T_a_b) @ T_a_c @ T_c_d @ T_d_b``, whose middle steps
    are the map's. Covariances are carried to E's right side by adjoints.

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
