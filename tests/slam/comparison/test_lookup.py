"""Finding sequences, ground truth and trajectories; messages if they are missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bmask_slam.comparison.experiment.data_folders import data_folders, locate_sequence
from bmask_slam.comparison.experiment.experiment import (
    Configuration,
    Experiment,
    OtherSystem,
    Quotation,
    SequenceSource,
)
from bmask_slam.comparison.experiment.options import (
    CompareOptions,
    parse_trajectory,
    select_part,
    with_trajectories,
)
from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.bar import JobBar
from bmask_slam.comparison.jobs.cells import CellKey, rendered_sequence, run_jobs
from bmask_slam.comparison.jobs.errors import Rules, trajectory_errors
from bmask_slam.comparison.jobs.external import (
    other_methods,
    published_cells,
    trajectory_cells,
)
from bmask_slam.comparison.jobs.job import Job, Outcome
from bmask_slam.comparison.jobs.plan import make_plan
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.rendering.config import RenderConfig

XYZ = SequenceSource("xyz", "tum/freiburg1_xyz")
OFFICE = SequenceSource("office", render=RenderConfig("office", 5))


def experiment(folder: Path, *sources: SequenceSource, **changes: object) -> Experiment:
    return Experiment("mine", "", folder / "mine.yaml", sources or (XYZ,), **changes)


def make(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text("")
    return folder


@pytest.mark.parametrize(
    "place", ["tum/freiburg1_xyz", "freiburg1_xyz", "rgbd_dataset_freiburg1_xyz"]
)
@pytest.mark.parametrize("lists", [("rgb.txt",), ("associations.txt",)])
def test_a_sequence_is_found_by_each_of_its_names(tmp_path, place, lists):
    folder = make(tmp_path / "data" / place, *lists, "groundtruth.txt")
    site = locate_sequence(XYZ, experiment(tmp_path), [tmp_path / "data"], [])
    assert (site.folder, site.reference, site.problem) == (folder, folder / "groundtruth.txt", "")


@pytest.mark.parametrize("name", ["xyz-groundtruth.txt", "freiburg1_xyz_groundtruth.txt",
                                  "fr1_xyz-groundtruth.txt"])  # fmt: skip
def test_truth_is_found_beside_a_trajectory(tmp_path, name):
    folder = make(tmp_path / "elsewhere", name)
    site = locate_sequence(XYZ, experiment(tmp_path), [], [folder / "estimate.txt"])
    assert (site.folder, site.reference) == (None, folder / name)
    assert "bmask-slam download tum/freiburg1_xyz" in site.problem


def test_a_folder_without_lists_is_reported(tmp_path):
    folder = make(tmp_path / "freiburg1_xyz", "groundtruth.txt")
    site = locate_sequence(XYZ, experiment(tmp_path), [tmp_path], [])
    assert site.folder is None
    assert site.reference == folder / "groundtruth.txt"
    assert site.problem.startswith(f"{folder}: holds no rgb.txt")


def test_data_folders_come_from_options_and_environment(monkeypatch):
    monkeypatch.setenv("BMASK_SLAM_DATA", "a:b")
    assert data_folders([Path("c")]) == (Path("c"), Path("a"), Path("b"), Path("data"))


@pytest.mark.parametrize("text", ["", "a=b", "a:=b", ":a=b", "a:b=", "a:b"])
def test_trajectory_arguments_are_parsed(text):
    with pytest.raises(InputError, match="METHOD:SEQUENCE=FILE"):
        parse_trajectory(text)


def test_a_method_name_may_contain_a_colon():
    assert parse_trajectory("A: b:xyz@2=f=1") == (("A: b", "xyz@2"), Path("f=1"))


def test_a_given_file_replaces_the_experiments(tmp_path):
    file = make(tmp_path, "f.txt") / "f.txt"
    found = with_trajectories(experiment(tmp_path), {("ORB", "xyz"): file})
    assert found.systems["ORB"].trajectories == {"xyz": str(file)}


def test_a_pattern_gives_each_sequence_its_file(tmp_path):
    make(tmp_path, "xyz-run1.txt")
    files = dict([parse_trajectory(f"ORB:*={tmp_path}/{{sequence}}-*.txt")])
    found = with_trajectories(experiment(tmp_path), files)
    assert found.systems["ORB"].trajectories == {"xyz": str(tmp_path / "xyz-run1.txt")}
    make(tmp_path, "xyz-run2.txt")
    with pytest.raises(InputError, match="make it narrower"):
        with_trajectories(experiment(tmp_path), files)
    for text, wrong in (("ORB:*=x.txt", "write {sequence}"), ("ORB:*={sequence}", "no file fits")):
        with pytest.raises(InputError, match=wrong):
            with_trajectories(experiment(tmp_path), dict([parse_trajectory(text)]))


def test_a_sequence_may_have_figures_from_two_sources(tmp_path):
    quoted = (
        Quotation("DVO", "one", figures={"ate_rmse": {"xyz": 0.01}, "tracked_share": {"xyz": 1}}),
        Quotation("DVO", "two", True, {"ate_rmse": {"xyz": 0.02}}),
    )
    cells = list(published_cells(experiment(tmp_path, published=quoted)))
    assert [(c.source, c.metrics) for c in cells] == [
        ("one", {"ate_rmse": 0.01, "tracked_share": 1}),
        ("two", {"ate_rmse": 0.02}),
    ]


def test_seeds_apply_to_rendered_images_and_to_the_system(tmp_path):
    folder = make(tmp_path / "freiburg1_xyz", "rgb.txt")
    rows = {
        "default": Configuration(segmenter="none"),
        "other": Configuration(set=("covariances=true",)),
    }
    given = experiment(tmp_path, XYZ, OFFICE, configurations=rows, seeds=(3, 7))
    plan = make_plan(given, tmp_path / "out", CompareOptions(data=(tmp_path,)))
    assert set(plan.cells()) == set(plan.jobs)
    assert len(plan.jobs) == 8
    recorded = [plan.jobs[CellKey("xyz", "default", seed)] for seed in (3, 7)]
    assert all(str(folder) in job.arguments for job in recorded)
    assert [job.arguments[-1] for job in recorded] == [
        f"loops.verification.seed={seed}" for seed in (3, 7)
    ]
    assert recorded[0].depends["sequence"] == recorded[1].depends["sequence"]
    drawn = [plan.jobs[CellKey("office", "default", seed)] for seed in (3, 7)]
    assert drawn[0].depends["sequence"] != drawn[1].depends["sequence"]
    renders = [plan.sequence("office", seed).render for seed in (3, 7)]
    for job, render, seed in zip(drawn, renders, (3, 7), strict=True):
        assert str(Path(render.product).parent) in job.arguments
        assert render.arguments[:4] == ("render", "office", "--seed", str(seed))
    assert not drawn[0].sequence
    assert plan.jobs[CellKey("office", "other", 3)].sequence, "labels are compared with the truth"


def test_a_cell_depends_on_configuration_and_images(tmp_path):
    """A change of configuration or images changes the hashes; moving the folder does not."""

    def depends(source: SequenceSource, configuration: Configuration) -> dict[str, str]:
        given = experiment(tmp_path, source, configurations={"default": configuration})
        data = rendered_sequence(source, source.render, 0, tmp_path)
        return run_jobs(given, [data], tmp_path)[CellKey("office", "default", 0)].depends

    base = depends(OFFICE, Configuration())
    assert base == depends(OFFICE, Configuration(note="told otherwise"))
    assert base != depends(OFFICE, Configuration(set=("tracking.min_inliers=21",)))
    assert base != depends(OFFICE, Configuration(max_frames=3))
    assert base != depends(
        SequenceSource("office", render=RenderConfig("office", 6)), Configuration()
    )


def test_truth_that_covers_a_part(tmp_path):
    """Only poses with a truth within the limit are compared, and their share is reported."""
    stamps = np.arange(100) / 10
    xi = np.column_stack(
        [0.1 * np.sin(stamps), 0 * stamps, 0 * stamps, stamps, stamps**2 / 9, 0 * stamps]
    )
    truth = Trajectory(stamps, se3_exp(xi))
    write_tum(tmp_path / "estimate.txt", truth.moved(se3_exp([1, 0, 0, 5, 5, 5])))
    late = Trajectory(stamps[40:90] + 0.015, truth.poses_world_camera[40:90])
    write_tum(tmp_path / "truth.txt", late)
    files = tmp_path / "estimate.txt", tmp_path / "truth.txt"
    found = trajectory_errors(*files, Rules(0.02), frames=200)
    assert found["evaluated_share"] == 0.5
    assert found["tracked_share"] == 0.5
    assert found["ate_rmse"] == pytest.approx(0, abs=1e-6)
    assert found["rpe_trans_rmse_metre"] == pytest.approx(0, abs=1e-6)
    with pytest.raises(InputError, match="0 of 100 poses"):
        trajectory_errors(*files, Rules(0.01))


def test_sim3_only_on_request(tmp_path):
    stamps = np.arange(50) / 10
    truth = Trajectory(stamps, se3_exp(np.random.default_rng(0).normal(0, 1, (50, 6))))
    half = truth.poses_world_camera.copy()
    half[:, :3, 3] /= 2
    write_tum(tmp_path / "estimate.txt", Trajectory(stamps, half))
    write_tum(tmp_path / "truth.txt", truth)
    files = tmp_path / "estimate.txt", tmp_path / "truth.txt"
    assert trajectory_errors(*files, Rules(0.02))["ate_rmse"] > 0.1
    assert trajectory_errors(*files, Rules(0.02, True))["ate_rmse"] == pytest.approx(0, abs=1e-6)


def cell_of_other(folder: Path, estimate: Trajectory, truth: Trajectory, **changes: object):
    """The cell and the row of another system, whose trajectory is given by --trajectory."""
    write_tum(folder / "estimate.txt", estimate)
    write_tum(folder / "truth.txt", truth)
    options = CompareOptions(
        references={"xyz": folder / "truth.txt"},
        trajectories={("ORB", "xyz"): folder / "estimate.txt"},
        **changes,
    )
    part = select_part(experiment(folder), options)
    plan = make_plan(part, folder, options)
    (cell,), (row,) = trajectory_cells(part, plan.sequence, plan.files), other_methods(part)
    return cell, row


def half_as_large(count: int = 50) -> tuple[Trajectory, Trajectory]:
    """A trajectory of half the size, and the true one."""
    stamps = np.arange(count) / 10
    truth = Trajectory(stamps, se3_exp(np.random.default_rng(0).normal(0, 1, (count, 6))))
    half = truth.poses_world_camera.copy()
    half[:, :3, 3] /= 2
    return Trajectory(stamps, half), truth


def test_with_scale_is_of_the_trajectories_of_other_systems_too(tmp_path):
    cell, row = cell_of_other(tmp_path, *half_as_large())
    assert cell.metrics["ate_rmse"] > 0.1 and not row.with_scale
    cell, row = cell_of_other(tmp_path, *half_as_large(), with_scale=True)
    assert cell.metrics["ate_rmse"] == pytest.approx(0, abs=1e-6) and row.with_scale


def test_no_scale_of_an_estimate_that_does_not_move_is_a_failed_cell(tmp_path):
    truth = half_as_large()[1]
    still = Trajectory(truth.timestamps_s, np.tile(np.eye(4), (50, 1, 1)))
    cell, _ = cell_of_other(tmp_path, still, truth, with_scale=True)
    assert cell.status is CellStatus.FAILED
    assert "does not move" in cell.error and "omit --with-scale" in cell.error


def test_the_remaining_time_is_estimated_from_the_same_group():
    def job(group: str, command: str = "run") -> Job:
        return Job(group, group, (command,), "", "", "")

    jobs = [job("a"), job("a"), job("b"), job("r", "render")]
    with JobBar(jobs, 2, quiet=True) as bar:
        assert bar.remaining_s() == 0
        bar.update(jobs[0], Outcome(CellStatus.DONE, wall_s=10))
        assert bar.remaining_s() == (10 + 10 + 10) / 2
        bar.update(jobs[3], Outcome(CellStatus.DONE, wall_s=100))
        assert bar.remaining_s() == (10 + 10) / 2
        bar.update(jobs[2], Outcome(CellStatus.FAILED, wall_s=1))
        assert bar.remaining_s() == 5


def test_trajectories_of_seeds_that_are_not_compared_are_left_out() -> None:
    """A rendered sequence looks otherwise with each seed; a recorded one is the same."""
    sources = SequenceSource("room", render=RenderConfig("office")), SequenceSource("desk", "desk")
    files = {f"{name}@{seed}": f"{name}{seed}.txt" for name in ("room", "desk") for seed in (0, 1)}
    systems = {"ORB": OtherSystem(trajectories=files)}
    whole = Experiment("mine", "", Path("mine.yaml"), sources, seeds=(0, 1), systems=systems)
    part = select_part(whole, CompareOptions(seeds=(1,)))
    assert set(part.systems["ORB"].trajectories) == {"room@1", "desk@0", "desk@1"}
