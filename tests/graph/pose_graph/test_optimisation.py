"""Pose graphs: costs, initial values, optima known exactly, wrong loops found, gauge."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pose_graph_rings import PER_LAP, ring
from repository import SHARED

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.gnc import truncated_weights
from bmask_slam.graph.g2o.pose_graphs import read_g2o
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log
from bmask_slam.graph.pose_graph import optimisation
from bmask_slam.graph.pose_graph.certificate import certify
from bmask_slam.graph.pose_graph.chordal import chordal_poses
from bmask_slam.graph.pose_graph.factors import pose_graph_cost
from bmask_slam.graph.pose_graph.loop_consistency import loop_consistency
from bmask_slam.graph.pose_graph.loop_prediction import pose_draws, predicted_chi2
from bmask_slam.graph.pose_graph.optimisation import PoseGraphConfig, optimise_pose_graph
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, planar_poses, spanning_tree_poses
from bmask_slam.graph.pose_graph.solver import PoseGraphSolver

FOLDER = SHARED / "posegraphs"
BOTH = pytest.mark.parametrize("planar", [True, False], ids=["2-D", "3-D"])


def disturbed(graph: PoseGraph, sigma: float = 0.05) -> PoseGraph:
    """The graph with all poses but the first moved at random."""
    xi = sigma * np.random.default_rng(1).normal(size=(len(graph.ids), 6))
    if graph.is_planar:
        xi[:, [0, 1, 5]] = 0
    xi[0] = 0
    return graph.with_poses(graph.poses @ se3_exp(xi))


def with_wrong_loops(graph: PoseGraph, count: int) -> tuple[PoseGraph, np.ndarray]:
    """The graph with its last loops turned by 1 rad and moved by metres, each differently."""
    rng = np.random.default_rng(5)
    measurements = graph.measurements.copy()
    wrong = np.zeros(len(graph.edges), bool)
    wrong[np.flatnonzero(~graph.is_odometry)[::3][:count]] = True
    if graph.is_planar:
        measurements[wrong] = planar_poses(rng.uniform(-3, 3, (count, 3)))
    else:
        measurements[wrong] = se3_exp(rng.uniform(-2, 2, (count, 6)))
    return replace(graph, measurements=measurements), wrong


@BOTH
def test_the_cost_is_that_of_the_docstring(planar: bool) -> None:
    graph = disturbed(ring(30, planar, sigma=0.02))
    total = 0.0
    for (i, j), T, omega in zip(graph.edges, graph.measurements, graph.information, strict=True):
        E = inverse(T) @ inverse(graph.poses[i]) @ graph.poses[j]
        r = se3_log(E)[[3, 4, 2]] if planar else se3_log(E)
        total += 0.5 * r @ omega @ r
    assert pose_graph_cost(graph) == pytest.approx(total, rel=1e-9)


@BOTH
def test_initial_values_are_exact_without_noise(planar: bool) -> None:
    graph = ring(40, planar)
    lost = replace(graph.with_poses(np.tile(graph.poses[0], (40, 1, 1))), has_poses=False)
    np.testing.assert_allclose(spanning_tree_poses(lost), graph.poses, atol=1e-9)
    np.testing.assert_allclose(chordal_poses(lost), graph.poses, atol=1e-6)


@BOTH
def test_a_tree_against_the_direction_of_its_edges(planar: bool) -> None:
    graph = ring(20, planar)
    turned = replace(
        graph, edges=graph.edges[:, ::-1].copy(), measurements=inverse(graph.measurements)
    )
    np.testing.assert_allclose(spanning_tree_poses(turned), graph.poses, atol=1e-9)


@BOTH
@pytest.mark.parametrize("method", ["lm", "dogleg", "gnc"])
def test_the_truth_is_found_from_disturbed_poses(planar: bool, method: str) -> None:
    truth = ring(40, planar)
    result = optimise_pose_graph(disturbed(truth), PoseGraphConfig(method=method))
    np.testing.assert_allclose(result.graph.poses, truth.poses, atol=1e-5)
    assert result.final_cost < 1e-6 < result.given_cost
    assert not result.is_outlier.any()


@BOTH
def test_the_optimum_moves_with_the_world(planar: bool) -> None:
    graph = ring(30, planar, sigma=0.05)
    T = planar_poses(np.array([5.0, -3.0, 2.0])) if planar else se3_exp(np.arange(6) - 2.0)
    a = optimise_pose_graph(graph)
    b = optimise_pose_graph(graph.with_poses(T @ graph.poses))
    np.testing.assert_allclose(b.graph.poses, T @ a.graph.poses, atol=1e-4)
    assert b.final_cost == pytest.approx(a.final_cost, rel=1e-6)


@BOTH
def test_the_noise_says_how_large_the_cost_is(planar: bool) -> None:
    """Twice the cost is chi-square distributed with the redundant degrees of freedom."""
    graph = ring(120, planar, sigma=0.02)
    d = graph.information.shape[-1]
    white = np.eye(d) / 0.02**2
    result = optimise_pose_graph(
        replace(graph, information=np.tile(white, (len(graph.edges), 1, 1)))
    )
    freedom = d * (len(graph.edges) - len(graph.ids) + 1)
    assert 2 * result.final_cost == pytest.approx(freedom, abs=5 * np.sqrt(2 * freedom))


def test_fixed_vertices_stay() -> None:
    graph = ring(30, False, sigma=0.05)
    graph.fixed[[4, 17]] = True
    moved = disturbed(graph, 0.2)
    result = optimise_pose_graph(moved)
    np.testing.assert_allclose(result.graph.poses[[4, 17]], moved.poses[[4, 17]], atol=1e-5)
    assert np.abs(result.graph.poses[0] - moved.poses[0]).max() > 1e-3


@BOTH
def test_a_single_fixed_vertex_is_the_anchor_of_a_graph_without_poses(planar: bool) -> None:
    truth = ring(40, planar)
    lost = replace(truth.with_poses(np.tile(np.eye(4), (40, 1, 1))), has_poses=False)
    lost.fixed[25] = True
    result = optimise_pose_graph(lost)
    assert (result.given, result.start) in {("odometry", "odometry"), ("odometry", "chordal")}
    expected = inverse(truth.poses[25]) @ truth.poses
    np.testing.assert_allclose(result.graph.poses, expected, atol=1e-5)


def test_bad_poses_in_the_file_are_replaced_by_chordal_ones() -> None:
    truth = ring(40, False, sigma=0.01)
    bad = truth.with_poses(se3_exp(np.random.default_rng(0).normal(size=(40, 6)) * 2))
    result = optimise_pose_graph(bad)
    assert (result.given, result.start) == ("file", "chordal")
    assert result.given_cost > 100 * result.initial_cost >= result.final_cost
    good = optimise_pose_graph(result.graph)
    assert good.final_cost == pytest.approx(result.final_cost, rel=1e-6)


def twisted(turns: int) -> PoseGraph:
    """A planar ring of exact steps in 3-D, its poses wound round so many more times."""
    truth = ring(24, False)
    count = len(truth.ids)
    closed = np.stack([np.arange(count), np.roll(np.arange(count), -1)], axis=1)
    step = se3_exp(np.array([0, 0, 2 * np.pi / count, 1.0, 0, 0]))
    wound = se3_exp(np.array([0, 0, 2 * np.pi * (1 + turns) / count, 1.0, 0, 0]))
    poses = np.stack([np.linalg.matrix_power(wound, k) for k in range(count)])
    return replace(
        truth.with_poses(poses),
        edges=closed,
        measurements=np.tile(step, (count, 1, 1)),
        information=np.tile(np.eye(6), (count, 1, 1)),
    )


def test_a_local_optimum_is_told_from_the_global_one() -> None:
    """A ring wound once too often is a local optimum, each step 2 pi / N too wide."""
    graph = twisted(1)
    solver = PoseGraphSolver(graph, PoseGraphConfig(), lambda iteration, cost: None)
    solver.poses = graph.poses
    local = solver.run(100)
    assert local.cost == pytest.approx(0.5 * (2 * np.pi) ** 2 / len(graph.edges))
    best = optimise_pose_graph(graph)
    assert best.final_cost < 1e-9
    assert certify(best).status == "global"
    wound = replace(best, graph=graph.with_poses(solver.poses), final_cost=local.cost)
    certificate = certify(wound)
    assert certificate.status == "not global"
    assert certificate.cost < 1e-9
    with pytest.raises(InputError, match="3-D"):
        certify(optimise_pose_graph(ring(20, True)))


def test_a_start_that_costs_less_but_ends_in_a_local_optimum_loses(monkeypatch) -> None:
    graph = twisted(1)
    exact = twisted(0).poses
    xi = 0.2 * np.random.default_rng(1).normal(size=(len(exact), 6)) * (np.arange(24) > 0)[:, None]
    rough = exact @ se3_exp(xi)
    assert pose_graph_cost(graph.with_poses(rough)) > 1.2 * pose_graph_cost(graph)
    monkeypatch.setattr(optimisation, "chordal_poses", lambda graph: rough)
    result = optimise_pose_graph(graph)
    assert (result.given, result.start) == ("file", "chordal")
    assert result.final_cost < 1e-9


@BOTH
def test_gnc_finds_the_wrong_loops_and_the_clean_optimum(planar: bool) -> None:
    graph = ring(90, planar, seed=2, sigma=0.01)
    wrong_graph, wrong = with_wrong_loops(graph, 20)
    right = optimise_pose_graph(wrong_graph.with_edges(~wrong)).graph.poses
    result = optimise_pose_graph(wrong_graph, PoseGraphConfig(method="gnc"))
    assert result.is_outlier[wrong].all()
    assert result.is_outlier[~wrong].sum() <= 1
    assert np.abs(result.graph.poses - right)[:, :3, 3].max() < 5e-3
    with_wrong = optimise_pose_graph(wrong_graph).graph.poses
    assert np.abs(with_wrong - right)[:, :3, 3].max() > 0.05


def test_gnc_without_odometry_keeps_the_graph_connected() -> None:
    """Without consecutive ids there is no odometry, and every vertex must stay connected."""
    graph = ring(60, False, seed=2, sigma=0.01)
    graph = replace(graph, ids=3 * graph.ids)
    measurements = graph.measurements.copy()
    last = np.flatnonzero((graph.edges == 59).any(axis=1))
    measurements[last[-1]] = measurements[last[-1]] @ se3_exp(np.full(6, 1.5))
    measurements[70] = measurements[70] @ se3_exp(np.full(6, -1.0))
    result = optimise_pose_graph(
        replace(graph, measurements=measurements), PoseGraphConfig(method="gnc")
    )
    assert result.is_outlier[70]
    assert result.is_outlier[last].sum() <= len(last) - 1
    assert np.isfinite(result.graph.poses).all()


def far_loops(graph: PoseGraph) -> PoseGraph:
    """Odometry, the loops of the first lap, and one loop in nine of the others."""
    loops = np.flatnonzero(~graph.is_odometry)
    keep = graph.is_odometry.copy()
    keep[loops[:PER_LAP]] = True
    keep[loops[PER_LAP::9]] = True
    return graph.with_edges(keep)


def test_edges_without_any_error_are_predicted_to_cost_nothing() -> None:
    """Exact in floating point: GTSAM's sparse system has no entry for the right-hand side then."""
    T = make_pose(np.eye(3), np.array([[k % 6, k // 6, 0.0] for k in range(12)]))
    edges = np.array([*((k, k + 1) for k in range(11)), (0, 6), (0, 11)])
    information = np.tile(100.0 * np.eye(6), (len(edges), 1, 1))
    measurements = inverse(T[edges[:, 0]]) @ T[edges[:, 1]]
    fixed = np.zeros(len(T), bool)
    graph = PoseGraph(np.arange(12), T, edges, measurements, information, fixed)
    used = np.arange(len(edges)) < 11
    np.testing.assert_array_equal(predicted_chi2(graph, used, np.array([11, 12])), 0.0)
    assert pose_draws(graph, used).shape == (100, 12, 6)


@BOTH
def test_the_predicted_cost_of_a_loop_equals_the_increase(planar: bool) -> None:
    """With drifted poses, each loop alone is added to the odometry and the graph is optimised."""
    graph = far_loops(ring(90, planar, seed=2, sigma=0.01))
    used = graph.is_odometry
    drifted = optimise_pose_graph(graph.with_edges(used)).graph.poses
    unused = np.flatnonzero(~used)
    predicted = predicted_chi2(graph.with_poses(drifted), used, unused)
    rises = []
    for k in unused:
        with_one = used.copy()
        with_one[k] = True
        rises.append(2 * optimise_pose_graph(graph.with_edges(with_one)).final_cost)
    assert max(rises) > 5
    assert np.abs(np.log(predicted / rises)).max() < 0.7
    assert abs(np.log(predicted / rises).mean()) < 0.2
    alone = graph.with_poses(drifted)
    E = inverse(alone.measurements) @ inverse(drifted[alone.edges[:, 0]])
    r = se3_log(E @ drifted[alone.edges[:, 1]])[unused]
    r = r[:, [3, 4, 2]] if planar else r
    plain = np.einsum("mi,mij,mj->m", r, graph.information[unused], r)
    assert plain.max() > 10 * predicted.max()


@BOTH
def test_right_loops_that_close_a_long_drift_are_kept_without_consistent_ones(planar: bool) -> None:
    graph = far_loops(ring(120, planar, seed=4, sigma=0.02))
    loops = np.flatnonzero(~graph.is_odometry)
    assert 0 < loop_consistency(graph).consistent.sum() < len(loops) - 5
    wrong = np.zeros(len(graph.edges), bool)
    wrong[loops[PER_LAP + 2 :: 4]] = True
    T = graph.measurements.copy()
    shift = np.array([4.0, -5.0, 2.5])
    T[wrong] = T[wrong] @ (planar_poses(shift) if planar else se3_exp(np.r_[1.5, -1, 1, shift]))
    result = optimise_pose_graph(replace(graph, measurements=T), PoseGraphConfig(method="gnc"))
    np.testing.assert_array_equal(result.is_outlier, wrong)


@BOTH
def test_neighbouring_loops_are_consistent(planar: bool) -> None:
    graph, wrong = with_wrong_loops(ring(90, planar, seed=2, sigma=0.01), 10)
    consistent = loop_consistency(graph).consistent
    assert not consistent[wrong].any()
    assert consistent[~wrong & ~graph.is_odometry].mean() > 0.95
    turned = graph.edges[:, ::-1].copy(), inverse(graph.measurements)
    loops = ~graph.is_odometry
    edges, measurements = graph.edges.copy(), graph.measurements.copy()
    edges[loops], measurements[loops] = turned[0][loops], turned[1][loops]
    again = loop_consistency(replace(graph, edges=edges, measurements=measurements)).consistent
    assert (again == consistent).mean() > 0.98
    assert PER_LAP > 6  # no loop of a lap lies in the window of another lap's


@BOTH
@pytest.mark.parametrize(("stated", "scale"), [(1e-5, 1e-4), (1.0, 1.0), (100.0, 10.0)])
def test_wrong_loops_are_found_with_a_wrong_information_scale(
    planar: bool, stated: float, scale: float
) -> None:
    """Information 1e-5 of that of the noise, as in parking-garage: random loops would fit."""
    graph, wrong = with_wrong_loops(ring(90, planar, seed=2, sigma=0.01), 20)
    graph = replace(graph, information=stated * graph.information)
    assert 1.0 <= loop_consistency(graph).noise_scale / scale < 10.0
    result = optimise_pose_graph(graph, PoseGraphConfig(method="gnc"))
    assert result.is_outlier[wrong].all()
    assert result.is_outlier[~wrong].sum() <= 1


def test_truncated_weights_fall_from_one_to_zero() -> None:
    chi_squares = np.array([0.0, 5.0, 10.0, 20.0, 1e9])
    sharp = truncated_weights(chi_squares, 10.0, 1e6)
    np.testing.assert_allclose(sharp, [1, 1, 0.5, 0, 0], atol=1e-5)
    soft = truncated_weights(chi_squares, 10.0, 1.0)
    np.testing.assert_allclose(soft, [1, 1, np.sqrt(2) - 1, 0, 0], atol=1e-9)


COSTS = {  # plain GTSAM Levenberg-Marquardt from the best initial value
    "tinyGrid3D": 9.313909,
    "smallGrid3D": 517.9253,
    "MIT": 20.60347,
    "intel": 22.50212,
    "manhattan": 1774.521,
    "parking-garage": 0.6341924,
    "sphere2500": 675.7010,
}


@pytest.mark.parametrize("name", COSTS)
def test_public_graphs_reach_their_optimum(name: str) -> None:
    result = optimise_pose_graph(public(name))
    assert result.final_cost <= COSTS[name] * (1 + 5e-5)


@pytest.mark.parametrize("name", ["MIT", "intel", "manhattan", "smallGrid3D"])
def test_public_graphs_have_no_wrong_loops(name: str) -> None:
    graph = public(name)
    result = optimise_pose_graph(graph, PoseGraphConfig(method="gnc"))
    assert result.is_outlier.sum() <= 0.001 * (~graph.is_odometry).sum()


def public(name: str) -> PoseGraph:
    file = FOLDER / f"{name}.g2o"
    if not file.is_file():
        pytest.skip(f"{file} is not there: the pose graphs are no part of the repository")
    return read_g2o(file)


def test_edges_that_are_too_long_for_numbers_are_no_traceback(tmp_path: Path) -> None:
    """GNC left a vertex without an edge, with which the certificate then failed in GTSAM."""
    triangle = " ".join("100" if r == c else "0" for r in range(6) for c in range(r, 6))
    rest = f"0 0 0.6 0.8 {triangle}"
    ends = ("20 26 6 0 0", "26 30 4 1e20 0", "30 31 1 1e100 0", "20 30 10 0 0")
    file = tmp_path / "far.g2o"
    file.write_text("".join(f"EDGE_SE3:QUAT {end} {rest}\n" for end in ends))
    with pytest.raises(InputError, match="cannot be solved: edges of a finite cost do not connect"):
        optimise_pose_graph(read_g2o(file), PoseGraphConfig(method="gnc"))


def test_a_singular_prediction_of_a_loop_is_an_input_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of an edge of 1e100 m whose information is 1e-100."""

    def predicted(*_: object) -> np.ndarray:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("bmask_slam.graph.pose_graph.gnc.predicted_chi2", predicted)
    graph, _ = with_wrong_loops(ring(60, False, seed=2, sigma=0.01), 5)
    with pytest.raises(InputError, match="cannot be solved: Singular matrix"):
        optimise_pose_graph(graph, PoseGraphConfig(method="gnc"))


def test_rotations_without_positions_certify_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of edges whose weights differ by a hundred orders of magnitude."""

    def positions(*_: object) -> np.ndarray:
        raise RuntimeError("Factor is exactly singular")

    monkeypatch.setattr("bmask_slam.graph.pose_graph.certificate.poses_of_rotations", positions)
    result = optimise_pose_graph(ring(30, False, sigma=0.01))
    assert certify(result).status == "undecided"
