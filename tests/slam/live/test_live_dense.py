"""``live --map``: if its process crashes, hangs or the disk is full, only submaps are lost."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from faults import Clock, fill, running, wait_until
from feeding import track_frames
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.config.configuration import resolve
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.growing.frames import FrameOptions
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.processes import supervision
from bmask_slam.live.processes.remote_dense import LATE
from bmask_slam.live.processes.supervision import RestartPolicy
from bmask_slam.mapping.surface.parts import SurfacePart
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus

SETTINGS = ["keyframes.min_interval_frames=2", "keyframes.max_shared=1.1"]
SETTINGS += ["mapping.redundant_share=1.0"]  # the same plane again and again
CONFIG = resolve(SystemConfig, None, SETTINGS)
FRAMES = PlaneViews(sideways_path(0.02 * np.arange(20)))


def wait_for(slam: LiveSlam, crashes: int) -> None:
    """Wait until the dense map's process has crashed this often and nothing waits for it."""

    def is_done() -> bool:
        slam.catch_up()
        health = slam.health()
        return health.dense_deaths >= crashes and not health.submaps_waiting

    wait_until(is_done)


def keyframes_without(run: Path) -> dict[int, str]:
    """Keyframes of the map without a submap, and the reasons in dense.json."""
    folder = DenseFolder.open(run)
    ids = [k.id for k in read_saved_map(run).keyframes]
    done = [k for k in range(100) if folder.is_done(k)]
    assert len(done) > 3
    assert set(done) <= set(ids)
    reasons = json.loads((run / "dense" / "dense.json").read_text())["keyframes_left_out"]
    assert sorted(map(int, reasons)) == sorted(set(ids) - set(done))
    return {int(k): str(reason) for k, reason in reasons.items()}


def off_the_plane_m(run: Path) -> float:
    """The 95 % quantile of distances from the cloud's points to the plane."""
    cloud = read_ply(run / "dense" / "cloud.ply")
    world_camera = read_tum(run / "trajectory.txt").poses_world_camera[0]
    depth_m = float(FRAMES[0].depth_m[240, 320])
    at_centre = world_camera[:3, :3] @ [0, 0, depth_m] + world_camera[:3, 3]
    points = np.stack([cloud[c] for c in "xyz"], axis=1)
    return float(np.percentile(np.abs((points - at_centre)[:, 2]), 95))


def test_a_process_that_is_killed_and_one_that_hangs_are_replaced_without_losing_keyframes(
    tmp_path, monkeypatch
) -> None:
    clock, run = Clock(), tmp_path / "run"
    monkeypatch.setattr(supervision, "time", clock)
    options = LiveOptions(run, dense=True, mesh_voxel_m=0.03, surface_frames=FrameOptions(30, 0.01))
    parts: list[SurfacePart] = []
    with LiveSlam(CAMERA, CONFIG, options) as slam:
        slam.on_surface(parts.append)
        track_frames(slam, FRAMES[:7], 0)
        killed = slam.processes()["dense"]
        os.kill(killed, signal.SIGKILL)
        statuses = track_frames(slam, FRAMES[7:13], 0)
        wait_for(slam, crashes=1)
        hanging = slam.processes()["dense"]
        os.kill(hanging, signal.SIGSTOP)
        statuses += track_frames(slam, FRAMES[13:], 0)
        while slam.health().dense_deaths < 2:
            clock.pass_s(RestartPolicy.answer_s + 1)
            slam.catch_up()
        wait_for(slam, crashes=2)
        wait_until(lambda: slam.catch_up() or slam.processes().get("dense", hanging) != hanging)
        pids = [killed, hanging, *slam.processes().values()]
    assert set(statuses) == {TrackingStatus.OK}
    assert len(set(pids)) == len(pids)
    assert set(keyframes_without(run).values()) <= {LATE}  # busy machines restart it slowly
    assert off_the_plane_m(run) < 0.01
    health = json.loads((run / "health.json").read_text())
    assert (health["dense_deaths"], health["map_deaths"]) == (2, 0)
    assert health["submaps"] > 3
    assert slam.dense is not None
    assert health["surface_frames"] == slam.dense.frames > 0
    assert not (run / "dense" / "frames").exists()
    assert parts[-1].vertices.shape[1] == 3
    assert not running(pids)


@pytest.mark.parametrize("small_disk", ["150m"], indirect=True)
def test_on_a_full_disk_tracking_continues_and_missing_submaps_are_reported(
    small_disk, caplog
) -> None:
    run = small_disk / "run"
    with LiveSlam(CAMERA, CONFIG, LiveOptions(run, dense=True, mesh_voxel_m=0.03)) as slam:
        track_frames(slam, FRAMES[:4], 0)
        ballast = fill(small_disk)
        assert set(track_frames(slam, FRAMES[4:], 0)) == {TrackingStatus.OK}
        wait_until(lambda: slam.catch_up() or slam._system.dense.unwritten)
        assert slam.health().unwritten > 0
        assert slam.health().dense_deaths == 0
        ballast.unlink()
        pids = list(slam.processes().values())
    missing = keyframes_without(run)
    assert slam.dense is not None
    assert slam.dense.missing == sorted(missing)
    assert f"--sequence adds the {len(missing)} keyframes left out" in caplog.text
    assert any("No space left" in reason for reason in missing.values())
    assert not running(pids)


def test_dense_mapping_without_a_run_folder_is_rejected() -> None:
    with pytest.raises(InputError, match="run folder"):
        LiveSlam(CAMERA, CONFIG, LiveOptions(dense=True))


@pytest.mark.parametrize(
    ("option", "said"),
    [({"mesh_voxel_m": 0.03}, "voxel 0.03"), ({"surface_frames": FrameOptions(2)}, "frames 2")],
)
def test_options_of_a_dense_map_without_one_are_refused(option: dict, said: str) -> None:
    with pytest.raises(InputError, match=f"--.*{said}: is for the dense map; give --map too"):
        LiveOptions(**option)
