"""From files to numbers and a picture."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from repository import SHARED

from bmask_slam.evaluation import evaluate, evaluate_trajectory, format_json, format_table
from bmask_slam.evaluation.plot import plot_trajectory, view_plane
from bmask_slam.evaluation.recordings import JOINED, Part, merged_clock, write_parts
from bmask_slam.events import read_events
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose, se3_exp, so3_exp
from bmask_slam.graph.trajectory import Trajectory, write_tum

TRAJECTORIES = SHARED / "trajectories"


def arc(count: int = 300, fps: float = 30.0) -> Trajectory:
    """Two metres across in x, one in z, nothing in y, looking along the tangent."""
    angle = np.linspace(0, np.pi, count)
    positions = np.column_stack([-np.cos(angle), 0 * angle, np.sin(angle)])
    rotations = so3_exp(np.column_stack([0 * angle, angle, 0 * angle]))
    return Trajectory(100 + np.arange(count) / fps, make_pose(rotations, positions))


def shaken(t: Trajectory, sigma: float = 0.01) -> Trajectory:
    xi = np.random.default_rng(0).normal(0, sigma, (len(t), 6))
    return Trajectory(t.timestamps_s, t.poses_world_camera @ se3_exp(xi))


def test_evaluation_rows():
    reference = arc()
    result = evaluate_trajectory(shaken(reference), reference, expected_frames=400)
    units = {row["name"]: row["unit"] for row in result.rows}
    assert units == {
        "ate_rmse": "m", "ate_mean": "m", "ate_median": "m", "ate_max": "m",
        "ate_rot_rmse": "deg", "rpe_trans_rmse_metre": "m", "rpe_rot_rmse_metre": "deg",
        "rpe_trans_rmse_frame": "m", "rpe_rot_rmse_frame": "deg",
        "rpe_trans_rmse_second": "m", "rpe_rot_rmse_second": "deg",
        "associated_poses": "poses", "estimate_share": "1", "reference_share": "1",
        "drift_trans": "1", "drift_rot": "deg/m",
        "tracked_share": "1",
    }  # fmt: skip
    # Independent noise of 1 cm an axis: sqrt(3) cm at a pose, twice the variance between two.
    assert result.value("ate_rmse") == pytest.approx(0.01 * np.sqrt(3), rel=0.06)
    assert result.value("rpe_trans_rmse_frame") == pytest.approx(0.01 * np.sqrt(6), rel=0.06)
    degrees = np.rad2deg(0.01 * np.sqrt(6))
    assert result.value("rpe_rot_rmse_frame") == pytest.approx(degrees, rel=0.06)
    assert result.value("rpe_rot_rmse_second") == pytest.approx(degrees, rel=0.06)
    assert result.value("rpe_rot_rmse_metre") == pytest.approx(degrees, rel=0.06)
    rotation_deg = np.rad2deg(0.01 * np.sqrt(3))
    assert result.value("ate_rot_rmse") == pytest.approx(rotation_deg, rel=0.06)
    assert result.value("tracked_share") == pytest.approx(0.75)
    assert len(result.per_second.timestamps_s) > 250


def test_drift_is_the_error_over_the_length_of_the_path():
    """A path that is 2 % too long and turns 3 degrees a metre that the reference does not turn."""
    x_m = np.linspace(0, 10, 301)
    poses = np.tile(np.eye(4), (301, 1, 1))
    poses[:, 0, 3] = x_m
    stretched = poses.copy()
    stretched[:, 0, 3] *= 1.02
    stamps_s = x_m / 3
    reference = Trajectory(stamps_s, poses)
    longer = evaluate_trajectory(Trajectory(stamps_s, stretched), reference)
    assert longer.value("drift_trans") == pytest.approx(0.02, rel=0.02)
    assert longer.value("drift_rot") == pytest.approx(0, abs=1e-6)
    turned = poses @ se3_exp(np.deg2rad(3) * x_m[:, None] * np.eye(6)[0])
    turning = evaluate_trajectory(Trajectory(stamps_s, turned), reference)
    assert turning.value("drift_rot") == pytest.approx(3, rel=0.02)


def test_tracked_and_evaluated_shares():
    """The reference, at 90 Hz, covers the first half of the time only."""
    reference = arc(450, fps=90)
    estimate = arc(300, fps=30)
    rows = evaluate_trajectory(estimate, reference)
    assert rows.value("associated_poses") == 151  # the last is 11 ms after the reference ends
    assert rows.value("estimate_share") == pytest.approx(0.5, abs=0.004)
    assert rows.value("reference_share") == 1.0
    short = estimate.select(np.arange(75))
    covered = evaluate_trajectory(short, reference).value("reference_share")
    assert covered == pytest.approx(0.5, abs=0.01)


def test_scale_only_on_request():
    reference = arc()
    poses = reference.poses_world_camera.copy()
    poses[:, :3, 3] *= 0.5
    estimate = Trajectory(reference.timestamps_s, poses)
    assert evaluate_trajectory(estimate, reference).value("ate_rmse") > 0.1
    scaled = evaluate_trajectory(estimate, reference, with_scale=True)
    assert scaled.value("ate_rmse") < 1e-9


def test_a_scale_of_an_estimate_that_does_not_move_is_refused():
    still = Trajectory(arc().timestamps_s, np.tile(np.eye(4), (300, 1, 1)))
    with pytest.raises(InputError, match=r"does not move.*omit --with-scale"):
        evaluate_trajectory(still, arc(), with_scale=True)


def test_metrics_without_a_value_have_no_row(caplog):
    reference = arc(10)  # a third of a second
    names = [row["name"] for row in evaluate_trajectory(reference, reference).rows]
    assert "rpe_trans_rmse_frame" in names
    assert "rpe_trans_rmse_second" not in names
    assert "no RPE per second" in caplog.text


def test_table_and_json():
    rows = evaluate_trajectory(shaken(arc()), arc(), 300).rows
    assert json.loads(format_json(rows)) == rows
    table = {line.split()[0]: line.split()[1:] for line in format_table(rows).splitlines()}
    assert table["associated_poses"] == ["300", "poses"]
    assert table["tracked_share"] == ["100.0000", "%"]
    assert table["ate_rmse"] == [f"{rows[0]['value']:.4f}", "m"]


def test_run_folder_against_sequence_folder(tmp_path):
    run, sequence = tmp_path / "run", tmp_path / "sequence"
    run.mkdir()
    sequence.mkdir()
    write_tum(run / "trajectory.txt", shaken(arc()).moved(se3_exp([1, 2, 3, 4, 5, 6])))
    (run / "frames.csv").write_text("index,timestamp\n" + "0,0\n" * 600)
    write_tum(sequence / "groundtruth.txt", arc())
    result = evaluate(run, sequence, tmp_path / "picture.png")
    assert result.value("tracked_share") == pytest.approx(0.5)
    assert result.value("ate_rmse") == pytest.approx(0.0173, abs=0.001)
    assert cv2.imread(str(tmp_path / "picture.png")) is not None
    direct = evaluate(run / "trajectory.txt", sequence / "groundtruth.txt")
    assert direct.rows == result.rows


def test_map_segments_that_are_not_compared_are_named(tmp_path, caplog):
    write_tum(tmp_path / "groundtruth.txt", arc())
    write_tum(tmp_path / "trajectory.txt", shaken(arc()))
    evaluate(tmp_path, tmp_path)
    assert not caplog.messages
    for name in ("trajectory_segment_1.txt", "trajectory_segment_2.txt"):
        write_tum(tmp_path / name, arc())
    evaluate(tmp_path, tmp_path)
    (told,) = caplog.messages
    assert "only the largest map segment is compared; trajectory_segment_1.txt, traj" in told
    caplog.clear()
    evaluate(tmp_path / "trajectory_segment_1.txt", tmp_path)
    assert not caplog.messages


def test_the_picture_of_a_run_marks_its_events(tmp_path):
    write_tum(tmp_path / "groundtruth.txt", arc())
    write_tum(tmp_path / "trajectory.txt", shaken(arc()))
    (tmp_path / "frames.csv").write_text("index,timestamp\n" + "0,0\n" * 300)
    evaluate(tmp_path, tmp_path, tmp_path / "plain.svg")
    lost = f"10,{arc().timestamps_s[10]:.6f},lost,why\n"
    (tmp_path / "events.csv").write_text("index,timestamp,kind,text\n" + 2 * lost)
    evaluate(tmp_path, tmp_path, tmp_path / "marked.svg")
    colour = "#b0151b"  # of a loss
    assert colour not in (tmp_path / "plain.svg").read_text()
    assert colour in (tmp_path / "marked.svg").read_text()


def test_bad_input(tmp_path):
    write_tum(tmp_path / "late.txt", Trajectory(arc().timestamps_s + 50, arc().poses_world_camera))
    write_tum(tmp_path / "groundtruth.txt", arc())
    with pytest.raises(InputError, match="no such file; give a run folder or a traj"):
        evaluate(tmp_path / "none", tmp_path)
    with pytest.raises(InputError, match=r"trajectory\.txt: no such file"):
        evaluate(tmp_path, tmp_path)
    with pytest.raises(InputError, match="give a sequence with ground truth"):
        evaluate(tmp_path / "late.txt", tmp_path / "none")
    with pytest.raises(InputError, match=r"late\.txt against .*: 0 of 300 poses.*150\.000 to"):
        evaluate(tmp_path / "late.txt", tmp_path, tmp_path / "picture.png")
    assert not (tmp_path / "picture.png").exists()
    for name, words in (("none/picture.png", "no such folder"), ("picture.xyz", "suffix '.xyz'")):
        with pytest.raises(InputError, match=words):
            evaluate(tmp_path / "groundtruth.txt", tmp_path, tmp_path / name)


@pytest.mark.parametrize("with_reference", [False, True])
def test_picture(tmp_path, with_reference):
    """It shows the estimate in blue, and differences in red only with a reference.

    The estimate's world is 100 m away: were it not aligned, its blue would be a dot.
    """
    estimate = shaken(arc().moved(se3_exp([0, 0, 1, 100, 0, 0])), 0.05)
    estimate = estimate.select(np.r_[:100, 180:300])
    path = tmp_path / "picture.png"
    plot_trajectory(path, estimate, arc() if with_reference else None, "title")
    image = cv2.imread(str(path)).astype(int)
    blue, _, red = np.moveaxis(image, -1, 0)
    assert image.shape[1] > image.shape[0] > 500
    assert (blue - red > 80).sum() > 500
    assert ((red - blue > 80).sum() > 500) == with_reference
    assert [p.name for p in tmp_path.iterdir()] == ["picture.png"]
    before = path.read_bytes()
    plot_trajectory(path, estimate, arc() if with_reference else None, "title")
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("estimated", "late_s", "cure"), [(2, 0.0, "give a longer run"), (5, 99.0, "the same clock")]
)
def test_too_few_common_poses_are_refused_with_their_cure(estimated, late_s, cure):
    stamps_s, poses = np.arange(5) / 10, np.tile(np.eye(4), (5, 1, 1))
    estimate = Trajectory(stamps_s[:estimated] + late_s, poses[:estimated])
    with pytest.raises(InputError, match=f"at least 3 are needed.*: .*{cure}"):
        evaluate_trajectory(estimate, Trajectory(stamps_s, poses))


def test_picture_of_an_empty_trajectory(tmp_path):
    """A run that was lost from the start still has a picture."""
    empty = arc().select(np.arange(0))
    for reference in (None, arc()):
        plot_trajectory(tmp_path / "picture.png", empty, reference, "nothing")
        assert (tmp_path / "picture.png").stat().st_size > 1000


def test_view_plane_is_the_plane_of_motion():
    positions = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert view_plane(positions * [3, 1, 2]) == [0, 2]
    assert view_plane(positions * [1, 3, 2]) == [1, 2]
    assert view_plane(positions * [2, 3, 1]) == [0, 1]


@pytest.mark.skipif(not TRAJECTORIES.is_dir(), reason="no ../shared/data/trajectories here")
@pytest.mark.parametrize(
    ("estimate", "reference", "ate_cm"),
    [
        ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", 1.35),
        ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", 0.81),
    ],
)
def test_published_figures(estimate, reference, ate_cm):
    result = evaluate(TRAJECTORIES / estimate, TRAJECTORIES / reference)
    assert 100 * result.value("ate_rmse") == pytest.approx(ate_cm, abs=0.006)


def test_a_reference_of_another_body(tmp_path: Path):
    """An IMU beside the camera, with axes of its own: its lever arm is found."""
    wobble = 0.3 * np.sin(np.outer(np.arange(300) / 30, [1.1, 1.7, 2.3]))
    level = arc()
    turned = level.poses_world_camera @ make_pose(so3_exp(wobble), np.zeros((300, 3)))
    camera = Trajectory(level.timestamps_s, turned)
    T_camera_imu = make_pose(so3_exp(np.array([0.0, 1.5, 0.0])), np.array([0.08, 0.0, -0.12]))
    imu = Trajectory(camera.timestamps_s, camera.poses_world_camera @ T_camera_imu)
    write_tum(tmp_path / "camera.txt", shaken(camera, 0.002))
    write_tum(tmp_path / "imu.txt", imu)
    both = (tmp_path / "camera.txt", tmp_path / "imu.txt")
    alone = evaluate(*both)
    found = evaluate(*both, plot=tmp_path / "plot.png", with_body=True)
    assert alone.value("rpe_trans_rmse_second") > 0.05
    assert found.value("rpe_trans_rmse_second") < 0.008
    assert found.value("ate_rmse") < 0.008 and (tmp_path / "plot.png").is_file()
    place_m = [found.value(f"body_{axis}") for axis in "xyz"]
    np.testing.assert_allclose(place_m, [0.08, 0.0, -0.12], atol=0.004)
    assert found.value("body_angle") == pytest.approx(np.rad2deg(1.5), abs=0.3)
    with pytest.raises(InputError, match="--hand-eye with --with-scale"):
        evaluate(*both, with_scale=True, with_body=True)


def merged_run(folder: Path, spans: list[tuple[int, int, float]]) -> Path:
    """A merged run of parts of an arc: first and last pose of each, and the shift of its stamps."""
    folder.mkdir()
    stamps_s, poses = arc().timestamps_s, shaken(arc()).poses_world_camera
    parts = [
        Part(sequence="s", begin_s=stamps_s[a], end_s=stamps_s[b], shift_s=shift_s)
        for a, b, shift_s in spans
    ]
    write_parts(folder / JOINED, parts)
    moved_s = [stamps_s[a : b + 1] + shift_s for a, b, shift_s in spans]
    joined = np.concatenate([poses[a : b + 1] for a, b, _ in spans])
    write_tum(folder / "trajectory.txt", Trajectory(np.concatenate(moved_s), joined))
    return folder


def test_a_merged_run_is_evaluated_by_the_stamps_of_its_recordings(tmp_path, caplog):
    """Its second recording is the earlier one, and was moved to after the first."""
    write_tum(tmp_path / "truth.txt", arc())
    run = merged_run(tmp_path / "run", [(150, 299, 0.0), (0, 149, 20.0)])
    lost = f"5,{arc().timestamps_s[5] + 20:.6f},lost,why\n"
    (run / "events.csv").write_text("index,timestamp,kind,text\n" + lost)
    (run / "frames.csv").write_text("index,timestamp\n" + "0,0\n" * 300)
    found = evaluate(run, tmp_path / "truth.txt", tmp_path / "plot.svg")
    assert found.value("associated_poses") == 300
    assert found.value("ate_rmse") == pytest.approx(0.0173, abs=0.001)
    assert "overlap" not in caplog.text
    (event,) = merged_clock(run).own_events(read_events(run))
    assert event.timestamp_s == pytest.approx(arc().timestamps_s[5], abs=1e-6)


def test_recordings_that_overlap_keep_their_moved_stamps_with_a_warning(tmp_path, caplog):
    write_tum(tmp_path / "truth.txt", arc())
    run = merged_run(tmp_path / "run", [(0, 199, 0.0), (100, 299, 20.0)])
    assert evaluate(run, tmp_path / "truth.txt").value("associated_poses") == 200
    (warning,) = [r.getMessage() for r in caplog.records if "overlap" in r.getMessage()]
    assert f"{run / 'trajectory.txt'}: " in warning and "trajectory_run_N.txt" in warning
    caplog.clear()
    evaluate(
        merged_run(tmp_path / "unmoved", [(0, 99, 0.0), (150, 299, 0.0)]), tmp_path / "truth.txt"
    )
    assert "overlap" not in caplog.text
