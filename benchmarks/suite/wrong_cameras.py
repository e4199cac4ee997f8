"""What a run makes of a wrong camera: faults put into recordings, and what it finds or warns of.

    python -m benchmarks.suite.wrong_cameras [--into DIR] [--only NAME ...] [--faults NAME ...]
        [--live]

Faulty copies of the recordings under ../shared/data and a rendered office are made in ``--into``
and run by default options; images that stay as they are are linked. Nothing of them belongs into
the repository. ``--live``: by `live`, as fast as it tracks, the whole recordings; the ATE is that
of the largest map segment, of which the number of frames is printed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.suite.measure import call
from bmask_slam.graph.camera import Camera
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.cameras import read_camera, write_camera

NAMES = ("tum_fr1_rpy", "bonn_crowd", "redkitchen", "office")
MAX_FRAMES = 300
KINECT_READOUT_S = 0.026
Fault = Callable[[Path, Camera], Camera]
"""Changes the images or lists of a copied folder, and returns the camera to write into it."""


def _focal(share: float) -> Fault:
    return lambda folder, camera: replace(
        camera, fx=camera.fx * (1 + share), fy=camera.fy * (1 + share)
    )


def _depth_scale(share: float) -> Fault:
    return lambda folder, camera: replace(camera, depth_scale=camera.depth_scale * (1 + share))


def _stamps(shift_s: float) -> Fault:
    def fault(folder: Path, camera: Camera) -> Camera:
        lines = []
        for line in (folder / "depth.txt").read_text(encoding="utf-8").splitlines():
            if line and not line.startswith("#"):
                stamp, name = line.split(maxsplit=1)
                lines.append(f"{float(stamp) + shift_s:.6f} {name}\n")
        (folder / "depth.txt").unlink()
        (folder / "depth.txt").write_text("".join(lines), encoding="utf-8")
        return camera

    return fault


def _unlinked(folder: Path) -> list[Path]:
    """The files of a folder that is a link; it becomes an empty folder."""
    files = sorted(folder.resolve().iterdir())
    folder.unlink()
    folder.mkdir()
    return files


def _moved(baseline_m: float, scale: float, shift_px: tuple[float, float] = (0, 0)) -> Fault:
    """Depth as of a camera beside the colour camera, with ``scale`` times its focal lengths."""

    def fault(folder: Path, camera: Camera) -> Camera:
        for path in _unlinked(folder / "depth"):
            stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            v, u = np.nonzero(stored)
            beside_px = camera.fx * baseline_m * camera.depth_scale / stored[v, u]
            to_u = scale * (u - camera.cx + beside_px) + camera.cx + shift_px[0]
            to_v = scale * (v - camera.cy) + camera.cy + shift_px[1]
            moved = _nearest(stored[v, u], to_u, to_v, stored.shape)
            cv2.imwrite(str(folder / "depth" / path.name), moved)
        return camera

    return fault


def _nearest(
    values: NDArray[Any], u: NDArray[Any], v: NDArray[Any], shape: tuple[int, ...]
) -> NDArray[Any]:
    """An image in which each value is at the pixels around its place, the nearest in front."""
    image = np.full(shape, np.iinfo(np.uint16).max, np.uint16)
    for du, dv in ((-0.3, -0.3), (-0.3, 0.3), (0.3, -0.3), (0.3, 0.3)):
        column, row = np.rint(u + du).astype(int), np.rint(v + dv).astype(int)
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        np.minimum.at(image, (row[inside], column[inside]), values[inside])
    image[image == np.iinfo(np.uint16).max] = 0
    return image


def _turned(folder: Path, camera: Camera) -> Camera:
    """Images turned by 180 degrees after they were taken: the last row was exposed first.

    The camera's readout time is known, and says the opposite.
    """
    for name in ("rgb", "depth"):
        for path in _unlinked(folder / name):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(folder / name / path.name), cv2.rotate(image, cv2.ROTATE_180))
    k1, k2, p1, p2, k3 = camera.distortion
    cx, cy = camera.width - 1 - camera.cx, camera.height - 1 - camera.cy
    camera = replace(camera, cx=cx, cy=cy, distortion=(k1, k2, -p1, -p2, k3))
    return replace(camera, rolling_shutter_s=KINECT_READOUT_S)


FAULTS: dict[str, Fault] = {
    "none": lambda folder, camera: camera,
    "focal length +3 %": _focal(0.03),
    "focal length -3 %": _focal(-0.03),
    "depth moved by (12, 3) px": _moved(0.0, 1.0, (12, 3)),
    "depth camera 25 mm beside": _moved(0.025, 1.0),
    "and its focal length 11 % larger": _moved(0.025, 1.11),
    "depth stamps +30 ms": _stamps(0.03),
    "depth stamps -30 ms": _stamps(-0.03),
    "depth stamps +60 ms": _stamps(0.06),
    "depth stamps -60 ms": _stamps(-0.06),
    "depth stamps +90 ms": _stamps(0.09),
    "depth stamps -90 ms": _stamps(-0.09),
    "depth scale +2 %": _depth_scale(0.02),
    "images turned by 180 degrees": _turned,
}


def faulty(source: Path, fault: Fault, folder: Path) -> Path:
    """A copy of a sequence, with links to its images, with a fault in it."""
    folder.mkdir(parents=True)
    for path in source.iterdir():
        if path.name != "camera.yaml":
            (folder / path.name).symlink_to(path.resolve())
    write_camera(folder / "camera.yaml", fault(folder, read_camera(source / "camera.yaml")))
    return folder


def outcome(folder: Path, out: Path) -> tuple[str, str]:
    """The warnings of a run in short, what it found of the camera and uses, and its ATE in mm."""
    done = run(RunOptions(folder, out=out, max_frames=MAX_FRAMES, quiet=True))
    rows = {row["name"]: row["value"] for row in done.rows}
    said = [f"warns: {warning.partition(';')[0]}" for warning in done.warnings]
    found = done.calibration.removesuffix(": found and applied")
    said += [f"found: {found}"] * (found != done.calibration)
    return "; ".join(said) or "-", f"{1e3 * rows['ate_rmse']:.1f}"


def live_outcome(folder: Path, out: Path) -> tuple[str, str]:
    """What `live` found of the camera, and its ATE in mm with the number of frames."""
    told = json.loads(call(["-m", "bmask_slam", "live", str(folder), "--out", str(out), "--json"]))
    rows = {row["name"]: row["value"] for row in told["metrics"]}
    frames = len(Run(out).trajectory)
    return told["calibration"] or "-", f"{1e3 * rows['ate_rmse']:.1f} ({frames} frames)"


def rows_of(
    source: Path, faults: Sequence[str], into: Path, is_live: bool
) -> Iterator[tuple[str, ...]]:
    """Fault, sequence, and what came of it."""
    for name in faults:
        place = into / f"fault {list(FAULTS).index(name)}"
        folder = faulty(source, FAULTS[name], place / source.name)
        yield name, source.name, *(live_outcome if is_live else outcome)(folder, place / "run")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path)
    parser.add_argument("--only", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--live", action="store_true")
    arguments = parser.parse_args()
    lines = []
    with TemporaryDirectory() as temporary:
        for name in arguments.only:
            into = (arguments.into or Path(temporary)) / name
            source = SHARED / name
            if name == "office":
                source = into / "source" / name
                if not source.is_dir():
                    render_sequence(RenderConfig(name, MAX_FRAMES), source)
            for line in rows_of(source, arguments.faults, into, arguments.live):
                lines.append(line)
                print(" | ".join(line), file=sys.stderr, flush=True)
    print(table(("fault", "sequence", "what the run warns of and finds", "ATE mm"), lines))


if __name__ == "__main__":
    main()
