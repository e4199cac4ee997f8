"""Memory of dense mapping over a long session.

    python -m benchmarks.mapping.dense_session SEQUENCE --keyframes 600

Keyframes are every second frame of a rendered sequence, which is walked to and fro, each time 8 m
farther on, through fusion into the folder of a dense map; then they make a surface.
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.machine import resident_mb
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import undistort_images
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe, DenseMapper, FusedKeyframe
from bmask_slam.mapping.products.surface_labels import InstanceEvidence
from bmask_slam.mapping.surface.depth_frame import depth_frame
from bmask_slam.mapping.surface.extraction import extract
from bmask_slam.mapping.surface.volume import SurfaceVolume
from bmask_slam.runtime.memory import peak_rss_mb
from bmask_slam.sequences.sequence import Sequence, open_sequence

VOXEL_M = 0.01
STRIDE, SHARED = 2, 13
"""Frames from keyframe to keyframe; landmarks that one shares with the next but one are fewer."""
LAP_M = 8.0
NOTHING = InstanceEvidence(
    np.zeros((1, 1), np.float32), np.zeros(0, np.int64), np.zeros(0, np.uint16)
)


def keyframe(sequence: Sequence, index: int, number: int, T_world_camera: Array) -> DenseKeyframe:
    """A frame as a keyframe that shares landmarks with those made just before and after it."""
    rgb, depth_m = undistort_images(sequence.load(index), sequence.camera)
    ids = np.arange(number, number + SHARED)
    return DenseKeyframe(number, T_world_camera, rgb, depth_m, ids, np.full(SHARED, 2.0))


def true_poses(sequence: Sequence) -> Array:
    """(N, 4, 4) in the first keyframe's frame."""
    assert sequence.groundtruth is not None
    T = sequence.groundtruth.poses_world_camera[: len(sequence) : STRIDE]
    return np.asarray(inverse(T[0]) @ T)


def session(sequence: Sequence, count: int) -> Iterator[str]:
    """The lines."""
    true = true_poses(sequence)
    poses: list[Array] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = DenseFolder(Path(temporary), {})
        mapper = DenseMapper(sequence.camera)
        before = f"(memory before: {resident_mb():.0f} MB)"
        yield f"keyframes  memory MB  in use MB  ms a keyframe  {before}"
        fused_s = 0.0
        for number in range(count):
            lap, step = divmod(number, len(true))
            index = step if lap % 2 == 0 else len(true) - 1 - step
            T = true[index].copy()
            T[0, 3] += LAP_M * lap
            poses.append(T)
            given = keyframe(sequence, index * STRIDE, number, T)
            started_s = time.perf_counter()
            finished = mapper.add(given)
            _save(finished, folder)
            fused_s += time.perf_counter() - started_s
            if (number + 1) % (count // 6) == 0:
                keyframe_ms = 1e3 * fused_s / (count // 6)
                sizes = f"{resident_mb():10.0f} {in_use_mb():10.0f}"
                yield f"{number + 1:9} {sizes} {keyframe_ms:14.0f}"
                fused_s = 0.0
        _save(mapper.flush(), folder)
        started_s = time.perf_counter()
        points = _write_cloud(folder, poses, sequence.camera)
        wall_s = time.perf_counter() - started_s
        size_mb = sum(f.stat().st_size for f in folder.path.rglob("*") if f.is_file()) / 1e6
        yield f"surface of {points} vertices: {wall_s:.0f} s, {resident_mb():.0f} MB"
        yield f"most memory at any time: {peak_rss_mb():.0f} MB; on disk {size_mb:.0f} MB"


def _save(finished: list[FusedKeyframe], folder: DenseFolder) -> None:
    for result in finished:
        folder.write(result, NOTHING)


def _write_cloud(folder: DenseFolder, poses: list[Array], camera: Camera) -> int:
    """Vertices of the surface of all keyframes."""
    volume = SurfaceVolume(VOXEL_M, camera)
    for k, T in enumerate(poses):
        volume.integrate(depth_frame(folder.fused(k), folder.colours(k), T, camera, VOXEL_M))
    return len(extract(volume, 1).vertices)


class _HeapState(ctypes.Structure):
    """glibc's struct mallinfo2."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd",
            "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    )  # fmt: skip


def in_use_mb() -> float:
    """What was allocated and not freed: the C library keeps some of the rest for later."""
    mallinfo2 = ctypes.CDLL("libc.so.6").mallinfo2
    mallinfo2.restype = _HeapState
    state = mallinfo2()
    return float(state.uordblks + state.hblkhd) / 1e6


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--keyframes", type=int, default=600, help="of a session")
    args = parser.parse_args()
    sequence = open_sequence(args.sequence)
    for line in session(sequence, args.keyframes):
        print(line, flush=True)


if __name__ == "__main__":
    main()
