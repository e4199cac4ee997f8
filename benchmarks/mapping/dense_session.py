"""Dense maps over time: submaps that follow a loop closure, and memory over a long session.

    python -m benchmarks.mapping.dense_session loop SEQUENCE
    python -m benchmarks.mapping.dense_session session SEQUENCE --keyframes 600

Keyframes are every second frame of a rendered sequence. ``loop``: they stand where odometry with
a drift that grows to 30 cm would have put them; their submaps then move to the true poses, and
are compared with submaps fused anew there. ``session``: the sequence is walked to and fro, each
time 8 m farther on, through fusion into the folder of a dense map, and the cloud is then written.
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import undistort_images
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe, DenseMapper, FusedKeyframe
from bmask_slam.mapping.products.cloud import PlacedSubmap, merge_blocks, sort_into_blocks
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.submaps import Submap, make_submap
from bmask_slam.mapping.products.surface_labels import InstanceEvidence, LabelTable
from bmask_slam.runtime.memory import peak_rss_mb
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.sequences import Sequence, open_sequence

VOXEL_M = 0.01
STRIDE, SHARED = 2, 13
"""Frames from keyframe to keyframe; landmarks that one shares with the next but one are fewer."""
DRIFT_M, DRIFT_RAD = 0.30, 0.05
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


# --- loop ------------------------------------------------------------------------------------


def drifted(true: Array) -> Array:
    """Poses (N, 4, 4) whose steps are a little wrong, so that the last is DRIFT_M off."""
    off = np.array([DRIFT_RAD, -DRIFT_RAD / 2, DRIFT_RAD / 3, 0.6, -0.3, 0.7])
    for _ in range(5):
        poses = [true[0]]
        for a, b in pairwise(true):
            poses.append(poses[-1] @ se3_exp(off / len(true)) @ inverse(a) @ b)
        off[3:] *= DRIFT_M / np.linalg.norm(poses[-1][:3, 3] - true[-1][:3, 3])
    return np.stack(poses)


def fuse_all(sequence: Sequence, poses: Array) -> Iterator[FusedKeyframe]:
    """Every keyframe, fused where these poses put it."""
    mapper = DenseMapper(sequence.camera)
    for k, T in enumerate(poses):
        yield from mapper.add(keyframe(sequence, k * STRIDE, k, T))
    yield from mapper.flush()


def loop(sequence: Sequence) -> Iterator[str]:
    """The lines of the first part."""
    true = true_poses(sequence)
    before = drifted(true)
    apart = np.linalg.norm(before[:, :3, 3] - true[:, :3, 3], axis=1)
    turned_rad = np.linalg.norm(se3_log(inverse(before[-1]) @ true[-1])[:3])
    yield f"{len(true)} keyframes; the loop moves the last by {100 * apart[-1]:.1f} cm"
    yield f"and {np.degrees(turned_rad):.2f} deg, the median one by {100 * np.median(apart):.1f} cm"
    submaps, errors, left = [], [], []
    pairs = zip(fuse_all(sequence, before), fuse_all(sequence, true), strict=True)
    for old, new in pairs:
        submaps.append(make_submap(old, sequence.camera, VOXEL_M))
        errors.append(_apart(old, new, sequence.camera))
        left.append(_apart(old, new, sequence.camera, before[old.keyframe.id]))
    times_s = []
    for _ in range(5):
        started_s = time.process_time()
        for submap, T in zip(submaps, true, strict=True):
            submap.placed(T)
        times_s.append(time.process_time() - started_s)
    points = sum(map(len, submaps))
    least_ms = 1e3 * min(times_s)
    yield f"{points} points of {len(submaps)} submaps follow in {least_ms:.0f} ms of processor time"
    e = np.concatenate(errors)
    yield (
        f"against a map fused anew: median {1e3 * np.median(e):.2f} mm, mean {1e3 * e.mean():.2f} "
        f"mm, 95 % below {1e3 * np.quantile(e, 0.95):.2f} mm"
    )
    unmoved_mm = 1e3 * np.concatenate(left).mean()
    yield f"left where they were, the points would be {unmoved_mm:.0f} mm off"


def _apart(
    old: FusedKeyframe, new: FusedKeyframe, camera: Camera, T_old: Array | None = None
) -> Array:
    """How far apart (N,) in m the points of the same pixels are, every fourth each way.

    Both stand at the new keyframe's pose, or the old ones at ``T_old``.
    """
    v, u = np.mgrid[: camera.height : 4, : camera.width : 4].astype(float)
    T = new.keyframe.T_world_camera
    places = [
        transform(pose, camera.backproject(np.stack([u, v], -1), z[::4, ::4].astype(float)))
        for pose, z in ((T if T_old is None else T_old, old.map.depth_m()), (T, new.map.depth_m()))
    ]
    distance = np.linalg.norm(places[0] - places[1], axis=-1)
    return distance[np.isfinite(distance)]


# --- session ---------------------------------------------------------------------------------


def session(sequence: Sequence, count: int) -> Iterator[str]:
    """The lines of the second part."""
    true = true_poses(sequence)
    poses: list[Array] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = DenseFolder(Path(temporary), {})
        mapper = DenseMapper(sequence.camera)
        yield f"keyframes  memory MB  in use MB  ms a keyframe  (memory before: {rss_mb():.0f} MB)"
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
            _save(finished, folder, sequence.camera)
            fused_s += time.perf_counter() - started_s
            if (number + 1) % (count // 6) == 0:
                keyframe_ms = 1e3 * fused_s / (count // 6)
                yield f"{number + 1:9} {rss_mb():10.0f} {in_use_mb():10.0f} {keyframe_ms:14.0f}"
                fused_s = 0.0
        _save(mapper.flush(), folder, sequence.camera)
        started_s = time.perf_counter()
        points = _write_cloud(folder, poses, Path(temporary))
        wall_s = time.perf_counter() - started_s
        size_mb = sum(f.stat().st_size for f in folder.path.rglob("*") if f.is_file()) / 1e6
        yield f"cloud of {points} points: {wall_s:.0f} s, {rss_mb():.0f} MB"
        yield f"most memory at any time: {peak_rss_mb():.0f} MB; on disk {size_mb:.0f} MB"


def _save(finished: list[FusedKeyframe], folder: DenseFolder, camera: Camera) -> None:
    for result in finished:
        folder.write(make_submap(result, camera, VOXEL_M), result.map, NOTHING)


def _write_cloud(folder: DenseFolder, poses: list[Array], temporary: Path) -> int:
    """Points in the cloud of all submaps, which is written as by bmask-slam map."""
    read: Callable[[int], Submap] = folder.submap
    table = LabelTable.of([NOTHING.log_likelihoods] * len(poses), LabelStoreConfig())
    submaps = (PlacedSubmap(read(k), T, k) for k, T in enumerate(poses))
    with CloudWriter(folder.path / "cloud") as writer:
        files = sort_into_blocks(submaps, VOXEL_M, temporary)
        for block in merge_blocks(files, VOXEL_M, table):
            writer.write(block)
    return writer.count


def rss_mb() -> float:
    """Memory that the process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


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
    parser.add_argument("part", choices=("loop", "session"))
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--keyframes", type=int, default=600, help="of a session")
    args = parser.parse_args()
    sequence = open_sequence(args.sequence)
    lines = loop(sequence) if args.part == "loop" else session(sequence, args.keyframes)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
