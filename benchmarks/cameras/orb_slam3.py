"""ORB-SLAM3 in RGB-D mode on the frames of a recording, to be set beside the system's figures.

    python -m benchmarks.cameras.orb_slam3 SEQUENCE --out FOLDER --work runs/bench

ORB-SLAM3 (Campos et al. 2021) as PyPI has it, pyorbslam3 (GPL-3), whose wheel is unpacked in
WORK/wheels and imported by a process of its own. It gets the published camera, the settings of its
TUM1.yaml for the rest, and images at their own rate, as its RGB-D example gives them, so that its
mapping keeps up. Its own vocabulary is not on PyPI: one is made of photographs by
`benchmarks.cameras.orb_vocabulary`. FOLDER gets trajectory.txt, which it writes at the end with all
that it has optimised, and odometry.json with the share of tracked frames and the milliseconds on
the clock that each took.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from benchmarks.cameras.frame_to_frame import call_with_wheel
from benchmarks.suite.measure import call
from bmask_slam.graph.camera import Camera
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.sequence import open_sequence

MODULE, WHEEL = "benchmarks.cameras.orb_slam3", "pyorbslam3==0.1.1"
SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: {k1}
Camera1.k2: {k2}
Camera1.p1: {p1}
Camera1.p2: {p2}
Camera1.k3: {k3}
Camera.width: {width}
Camera.height: {height}
Camera.fps: {fps}
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: {baseline}
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def settings_of(camera: Camera) -> str:
    """Its settings file for a camera; every number with a decimal point, which it insists on."""
    k1, k2, p1, p2, k3 = camera.distortion
    whole = {"width": camera.width, "height": camera.height, "fps": round(camera.fps)}
    values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    values |= {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3, "baseline": camera.baseline_m}
    return SETTINGS.format(**whole, **{key: f"{value:.9f}" for key, value in values.items()})


def track(folder: Path, out: Path, vocabulary: Path) -> None:
    """Track a sequence at its own rate, and write what FOLDER gets."""
    import pyorbslam3  # noqa: PLC0415 - a wheel of its own

    camera = read_camera(folder / "camera.yaml")
    out.mkdir(parents=True, exist_ok=True)
    settings = out / "orb_slam3.yaml"
    settings.write_text(settings_of(camera), encoding="utf-8")
    slam = pyorbslam3.Slam(vocabulary, settings, pyorbslam3.Sensor.RGBD)
    times_ms, tracked, begin_s = [], 0, 0.0
    for frame in open_sequence(folder, camera=camera).frames():
        now_s = time.perf_counter()
        begin_s = begin_s or now_s - frame.timestamp_s
        time.sleep(max(frame.timestamp_s + begin_s - now_s, 0.0))
        depth_m = np.nan_to_num(frame.depth_m, nan=0.0).astype(np.float32)
        start_s = time.perf_counter()
        found = slam.track_rgbd(frame.rgb, depth_m, frame.timestamp_s)
        times_ms.append(1e3 * (time.perf_counter() - start_s))
        tracked += bool(found.pose_valid)
    slam.shutdown()
    slam.save_trajectory_tum(str(out / "trajectory.txt"))
    said = {"frames": len(times_ms), "tracked": tracked / len(times_ms), "times_ms": times_ms}
    (out / "odometry.json").write_text(json.dumps(said), encoding="utf-8")


def in_its_own_process(folder: Path, out: Path, work: Path) -> None:
    """Track a sequence with the wheel and the vocabulary in ``work``, made if missing."""
    vocabulary = work.resolve() / "wheels" / "orb_vocabulary.txt"
    if not vocabulary.is_file():
        call(["-m", "benchmarks.cameras.orb_vocabulary", str(vocabulary)])
    where = [str(folder.resolve()), "--out", str(out.resolve()), "--vocabulary", str(vocabulary)]
    call_with_wheel([MODULE, *where], WHEEL, vocabulary.parent / "orb-slam3")


def main() -> None:
    """Parse; track here with a vocabulary that is given, else in a process of its own."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path("runs/bench"))
    parser.add_argument("--vocabulary", type=Path, help="pyorbslam3 can be imported here")
    given = parser.parse_args()
    if given.vocabulary is None:
        in_its_own_process(given.sequence, given.out, given.work)
    else:
        track(given.sequence, given.out, given.vocabulary)


if __name__ == "__main__":
    main()
