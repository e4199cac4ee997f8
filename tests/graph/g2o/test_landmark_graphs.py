"""g2o files with landmarks: g2o's error function, round trips, files of other programs, errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_room import CAMERA, make_room

from bmask_slam.graph.batch.bundle_adjustment import adjust
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.checks import reprojection
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import PosePrior, RelativePose, reference_frame_id
from bmask_slam.graph.g2o.landmark_graphs import has_landmarks, write_landmark_graph
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.geometry import inverse, rotation_from_quaternion, se3_exp


def room_graph() -> FactorTables:
    """Keyframes 3, 5, 7, ..., landmarks from 0 on; views with and without depth, all factors."""
    rng = np.random.default_rng(7)
    room = make_room(noise_px=0.7, mono_share=0.3, disparity_noise_px=0.1)
    observations = room.observations
    tables = FactorTables()
    ids, landmarks = (
        3 + 2 * np.arange(len(room.initial_poses)),
        np.unique(observations.landmark_ids),
    )
    tables.keyframes.insert(ids, room.initial_poses)
    tables.landmarks.insert(landmarks, room.initial_points[landmarks])
    tables.observations.add(replace(observations, keyframe_ids=ids[observations.keyframe_ids]))
    root = rng.normal(size=(4, 6, 6))
    covariances = 1e-4 * (root @ root.swapaxes(1, 2) + np.eye(6))
    T_a_b = [
        inverse(room.poses_world_camera[a]) @ room.poses_world_camera[b] @ se3_exp(0.01 * xi)
        for (a, b), xi in zip([(0, 1), (0, 9), (4, 2)], rng.normal(size=(3, 6)), strict=True)
    ]
    tables.add_pose_factors(
        [
            PosePrior(3, room.initial_poses[0], covariances[0]),
            RelativePose(3, 5, T_a_b[0], covariances[1]),
            RelativePose(3, 21, T_a_b[1], covariances[2], "cauchy", "loop"),
            RelativePose(11, 7, T_a_b[2], covariances[3], "dcs", "bridge"),
        ]
    )
    return tables


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.g2o"
    write_landmark_graph(path, room_graph(), CAMERA)
    return path


def test_everything_is_read_back(file: Path) -> None:
    before, (after, camera) = room_graph(), read_landmark_graph(file)
    assert [p.name for p in file.parent.iterdir()] == ["a.g2o"]
    assert camera == CAMERA
    for name in ("keyframes", "landmarks"):
        np.testing.assert_array_equal(getattr(after, name).ids, getattr(before, name).ids)
        np.testing.assert_allclose(
            getattr(after, name).values, getattr(before, name).values, atol=1e-12
        )
    observations, expected = (g.observations.all() for g in (after, before))
    np.testing.assert_array_equal(observations.keyframe_ids, expected.keyframe_ids)
    np.testing.assert_array_equal(observations.landmark_ids, expected.landmark_ids)
    np.testing.assert_allclose(observations.measurements, expected.measurements, atol=1e-11)
    stereo = np.isfinite(expected.measurements[:, 2])
    assert 0 < stereo.sum() < len(stereo)
    np.testing.assert_allclose(observations.sigmas_px[:, :2], expected.sigmas_px[:, :2], rtol=1e-12)
    np.testing.assert_allclose(
        observations.sigmas_px[stereo], expected.sigmas_px[stereo], rtol=1e-12
    )
    factors = [[f.factor for f in g.pose_factors.values()] for g in (after, before)]
    for found, given in zip(*factors, strict=True):
        assert type(found) is type(given)
        for name, value in vars(given).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(getattr(found, name), value, rtol=1e-9, atol=1e-14)
            else:
                assert getattr(found, name) == value


def test_reference_frames_are_numbered_behind_the_keyframes(tmp_path: Path) -> None:
    """Their ids do not fit into g2o's 32 bits."""
    tables, path = room_graph(), tmp_path / "b.g2o"
    frame, (*_, last) = reference_frame_id(2), tables.keyframes.ids.tolist()
    T_world_reference, T_a_b = se3_exp(np.arange(6) / 10), se3_exp(np.arange(6) / 7)
    tables.keyframes.insert(np.array([frame]), T_world_reference[None])
    tables.add_pose_factors([RelativePose(frame, 5, T_a_b, np.eye(6), "cauchy", "position")])
    write_landmark_graph(path, tables, CAMERA)
    words = [line.split() for line in path.read_text().splitlines() if line[0] != "#"]
    vertices = [int(w[1]) for w in words if w[0].startswith("VERTEX")]
    assert len(vertices) == len(set(vertices))
    assert max(vertices) < 1 << 31
    found, _ = read_landmark_graph(path)
    assert found.keyframes.ids[-1] == last + 1
    np.testing.assert_allclose(found.keyframes.values[-1], T_world_reference, atol=1e-12)
    np.testing.assert_array_equal(found.landmarks.ids, tables.landmarks.ids)
    (factor,) = found.relative_poses("position")
    assert (factor.keyframe_a, factor.keyframe_b) == (last + 1, 5)
    np.testing.assert_allclose(factor.T_a_b, T_a_b, atol=1e-12)


def test_the_cost_equals_g2os(file: Path) -> None:
    """EdgeSE3PointXYZDisparity in g2o's source: p = K T^-1 x, e = (px/pz, py/pz, 1/pz) - z."""
    lines = [line.split() for line in file.read_text().splitlines() if line[0] != "#"]
    numbers = {
        tag: [list(map(float, w[1:])) for w in lines if w[0] == tag]
        for tag in {w[0] for w in lines}
    }
    (camera,) = numbers["PARAMS_CAMERACALIB"]
    assert camera[:8] == [0, 0, 0, 0, 0, 0, 0, 1]
    fx, fy, cx, cy = camera[8:]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    poses = {
        int(v[0]): (np.array(v[1:4]), K @ rotation_from_quaternion(np.array(v[4:])).T)
        for v in numbers["VERTEX_SE3:QUAT"]
    }
    points = {int(v[0]): np.array(v[1:]) for v in numbers["VERTEX_TRACKXYZ"]}
    assert not set(poses) & set(points)
    edges = np.array(numbers["EDGE_PROJECT_DISPARITY"])
    assert (edges[:, 2] == camera[0]).all()
    seen = []
    for k, point in edges[:, :2].astype(int).tolist():
        t, KR = poses[k]
        seen.append(KR @ (points[point] - t))
    px, py, pz = np.transpose(seen)
    e = np.stack([px / pz, py / pz, 1 / pz], axis=1) - edges[:, 3:6]
    omega = np.zeros((len(edges), 3, 3))
    above = np.triu_indices(3)
    omega[:, above[0], above[1]] = omega[:, above[1], above[0]] = edges[:, 6:]
    total = np.einsum("ni,nij,nj->", e, omega, e)
    tables = room_graph()
    observations = tables.observations.all()
    chi2 = reprojection(observations, *tables.values_of(observations), CAMERA)[1]
    assert total == pytest.approx(chi2.sum(), rel=1e-9)


def test_adjusting_the_file_equals_adjusting_the_graph(file: Path) -> None:
    graph, (read, camera) = room_graph(), read_landmark_graph(file)
    here, there = adjust(graph, CAMERA), adjust(read, camera)
    assert there.initial_cost == pytest.approx(here.initial_cost, rel=1e-9)
    assert there.final_cost == pytest.approx(here.final_cost, rel=1e-9)
    np.testing.assert_allclose(read.keyframes.values, graph.keyframes.values, atol=1e-6)


IDENTITY = "0 0 0 0 0 0 1"
CALIBRATION = f"PARAMS_CAMERACALIB 0 {IDENTITY} 500 510 320 240\n"
POSES = f"VERTEX_SE3:QUAT 0 {IDENTITY}\nVERTEX_SE3:QUAT 1 0.1 0 0 0 0 0 1\n"
POINTS = "VERTEX_TRACKXYZ 2 0 0 2\nVERTEX_TRACKXYZ 3 0.5 0 2.5\n"
VIEWS = (
    "EDGE_PROJECT_DISPARITY 0 2 0 320 240 0.5 4 0 0 1 0 10000\n"
    "EDGE_PROJECT_DISPARITY 1 2 0 295 240 0.5 4 0 0 1 0 10000\n"
    "EDGE_PROJECT_DISPARITY 1 3 0 400 240 0.4 1 0 0 1 0 0\n"
    "EDGE_PROJECT_DISPARITY 0 3 0 420 240 0.4 1 0 0 1 0 10000\n"
)
TRIANGLE = "1 0 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6"
EDGE = f"EDGE_SE3:QUAT 0 1 0.1 0 0 0 0 0 1 {TRIANGLE}\n"
OFFSET = f"PARAMS_SE3OFFSET 2 {IDENTITY}\n"
WITH_PRIOR = f"{OFFSET}EDGE_SE3_PRIOR 0 2 {IDENTITY} {TRIANGLE}\n"
WHOLE = CALIBRATION + POSES + POINTS + VIEWS


def read_text(tmp_path: Path, text: str) -> FactorTables:
    path = tmp_path / "b.g2o"
    path.write_text(text)
    return read_landmark_graph(path)[0]


def test_a_file_of_another_program(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = "# theirs\n" + WHOLE + EDGE + "VERTEX_TRACKXYZ 9 1 1 1\nROBOTLASER1 3 4\n"
    tables = read_text(tmp_path, text)
    _, camera = read_landmark_graph(tmp_path / "b.g2o")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320, 240)
    assert (camera.width, camera.height) == (641, 481)
    assert tables.landmarks.ids.tolist() == [2, 3]
    observations = tables.observations.all()
    disparity_px = observations.measurements[:, 0] - observations.measurements[:, 2]
    np.testing.assert_allclose(disparity_px[:3], camera.stereo_bf_px_m * np.array([0.5, 0.4, 0.5]))
    assert np.isnan(disparity_px[3])
    np.testing.assert_allclose(observations.sigmas_px[0], [0.5, 1, 0.01 * camera.stereo_bf_px_m])
    edge, prior = (factor.factor for factor in tables.pose_factors.values())
    assert isinstance(edge, RelativePose)
    assert edge.kind == "odometry"
    assert edge.robust is None
    np.testing.assert_allclose(np.diag(np.linalg.inv(edge.covariance)), [4, 5, 6, 1, 2, 3])
    assert isinstance(prior, PosePrior)  # nothing held it: the first keyframe does
    assert prior.keyframe_id == 0
    assert "1 landmarks without observations" in caplog.text
    assert "unknown type ROBOTLASER1" in caplog.text
    assert adjust(tables, camera).final_cost < 1


def test_fixed_keyframes_stand_still(tmp_path: Path) -> None:
    tables = read_text(tmp_path, WHOLE.replace("295", "297") + "FIX 0 1\n")
    before = tables.keyframes.values.copy()
    adjust(tables, CAMERA)
    np.testing.assert_allclose(tables.keyframes.values, before, atol=1e-6)


@pytest.mark.parametrize("prior", [False, True])
def test_the_component_with_fixed_keyframes_or_the_largest_is_used(
    tmp_path: Path, caplog, prior
) -> None:
    """Keyframes 0 and 1 observe landmarks 2 and 3; only keyframe 10 observes landmark 11."""
    other = f"VERTEX_SE3:QUAT 10 {IDENTITY}\nVERTEX_TRACKXYZ 11 0 0 2\n"
    other += "EDGE_PROJECT_DISPARITY 10 11 0 320 240 0.5 4 0 0 1 0 10000\n"
    fixed = WITH_PRIOR.replace("PRIOR 0", "PRIOR 10") if prior else ""
    tables = read_text(tmp_path, WHOLE + other + fixed)
    assert tables.keyframes.ids.tolist() == ([10] if prior else [0, 1])
    assert tables.landmarks.ids.tolist() == ([11] if prior else [2, 3])
    assert "2 parts that no edge connects" in caplog.text
    if prior:  # both held: both stay
        tables = read_text(tmp_path, WHOLE + other + fixed + "FIX 0\n")
        assert tables.keyframes.ids.tolist() == [0, 1, 10]


BAD = {
    "columns": (
        WHOLE + VIEWS[:40] + "\n",
        ":10: 6 values after EDGE_PROJECT_DISPARITY, expected 12",
    ),
    "nan": (WHOLE.replace("295", "nan"), ":7: 'nan' is not a finite number"),
    "keyframe": (WHOLE.replace("DISPARITY 1 3", "DISPARITY 7 3"), ":8: an edge to vertex 7"),
    "landmark": (WHOLE.replace("DISPARITY 1 3", "DISPARITY 1 7"), ":8: an edge to vertex 7"),
    "swapped": (WHOLE.replace("DISPARITY 1 3", "DISPARITY 3 1"), ":8: an edge to vertex 3"),
    "indefinite": (WHOLE.replace("400 240 0.4 1", "400 240 0.4 -1"), ":8: an information matrix"),
    "correlated": (WHOLE.replace("0.4 1 0 0", "0.4 1 0.5 0"), ":8: information that correlates"),
    "twice": (WHOLE + VIEWS, ":10: vertex 0 sees vertex 2 twice"),
    "point id": (WHOLE + "VERTEX_TRACKXYZ 1 0 0 2\n", ":10: vertex 1 is there twice"),
    "no camera": (POSES + POINTS + VIEWS, ":5: EDGE_PROJECT_DISPARITY with the parameter 0, but"),
    "two cameras": (
        WHOLE + CALIBRATION.replace("0 0 0 0 0", "1 0 0 0 0", 1).replace("500", "501"),
        ":10: another camera",
    ),
    "offset": (WHOLE.replace("0 0 0 0 0 0 1 500", "0.1 0 0 0 0 0 1 500"), ":1: an offset between"),
    "focal": (WHOLE.replace("500", "-500"), ":1: a focal length"),
    "prior parameter": (
        WHOLE + WITH_PRIOR.replace(OFFSET, ""),
        ":10: EDGE_SE3_PRIOR with the para",
    ),
    "prior vertex": (WHOLE + WITH_PRIOR.replace("PRIOR 0", "PRIOR 5"), ":11: an edge to vertex 5"),
    "prior": (WHOLE + WITH_PRIOR.replace("0 5 0 6", "0 5 0 -6"), ":11: an information matrix that"),
    "edge": (WHOLE + EDGE.replace("0 5 0 6", "0 5 9 6"), ":10: an information matrix that is not"),
    "self": (WHOLE + EDGE.replace("0 1", "1 1", 1), ":10: an edge from vertex 1 to itself"),
    "fix": (WHOLE + "FIX 2\n", ":10: FIX 2, a vertex that is not there"),
    "comment": ("# bmask-slam landmarks many\n" + WHOLE, ":1: 'many' is not a whole number"),
    "cut camera": (
        "# bmask-slam camera 640 480 40 5000\n" + WHOLE,
        ":1: 4 numbers of the camera, expected 10",
    ),
    "kernel": ("# bmask-slam edge loop tukey\n" + WHOLE, ":1: the kernel 'tukey'; use one of none"),
    "keyframe number": (
        WHOLE + f"VERTEX_SE3:QUAT {2**62} {IDENTITY}\n",
        f":10: a vertex {2**62} of this type, where they are numbered from 0 to below",
    ),
    "landmark number": (
        "# bmask-slam landmarks 3\n" + WHOLE,
        ":5: a vertex 2 of this type, where they are numbered from 3 to below",
    ),
    "nothing seen": (CALIBRATION + POSES + POINTS, "no EDGE_PROJECT_DISPARITY line"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD.keys())
def test_broken_files_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_text(tmp_path, text)
    assert str(error.value).startswith(f"{tmp_path / 'b.g2o'}:")
    assert message in str(error.value)


def test_graphs_with_landmarks_are_recognised_by_their_observations(
    file: Path, tmp_path: Path
) -> None:
    assert has_landmarks(file)
    (tmp_path / "poses.g2o").write_text(POSES + EDGE)
    assert not has_landmarks(tmp_path / "poses.g2o")
    assert not has_landmarks(tmp_path / "none.g2o")
