"""A day of a robot, by descriptors and poses alone: what grows with the map, and how fast.

    python -m benchmarks.scale.day [--hours 8] [--storeys 10] [--keypoints 250] [--picture FILE]

A robot walks through the storeys of a simulated building in random order, round by round, one
keyframe every 1.44 s. No image is rendered: landmarks on the walls have descriptors of random bits,
and a keyframe sees those in view with noise and changed bits. What it makes of them is the real
back end's work (`slam.back_end.mapper.Mapper`): landmarks are made, fused and culled, the graph is
updated, places are recognised, loops verified and closed. Tracking is replaced by matches that are
true, and by poses of known noise, in the local map only, as the real one does. Times are CPU times
of the process, all threads, so that other programs count little.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

from benchmarks.graph.building import CAMERA, landmarks, visible, walk
from benchmarks.graph.pose_graphs import position_rmse_m
from benchmarks.machine import resident_mb
from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Bits, Ints
from bmask_slam.graph.files.array_file import FileKind, write_arrays
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.results import Tracked, TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.local_map import local_landmarks

PERIOD_S = 1.44
FPS = 30
PER_ROUND = 400
STOREY_M, ON_STAIRS = 3.2, 12  # height of a storey, keyframes on the stairs to the next one
IN_SIGHT_M = 1.8  # above and below the camera: floors hide the rest
FOUND, CHANGED_BITS = 0.8, 0.04
SIGMAS_PX = np.array([0.7, 0.7, 0.2])  # of u, v and disparity
STEP_SIGMAS = np.array([0.001] * 3 + [0.003] * 3)
GRAY = np.full((CAMERA.height, CAMERA.width), 127, np.uint8)
NO_DEPTH = np.zeros((0, 0), np.float32)
STAGES = ("insert", "graph", "loops")
WRONG_M = 0.5
"""A loop is wrong if it puts one of its keyframes so far from where it was in truth."""


class Building:
    """Storeys above each other, each with landmarks of its own; stairs at one corner."""

    def __init__(self, storeys: int, per_m2: float, rng: np.random.Generator) -> None:
        self._rng, self._storeys = rng, storeys
        points, walls = zip(*(landmarks(per_m2, rng) for _ in range(storeys)), strict=True)
        rise = [np.array([0.0, -STOREY_M * k, 0.0]) for k in range(storeys)]
        self.points = np.concatenate([p + r for p, r in zip(points, rise, strict=True)])
        self.on_wall: Ints = np.concatenate(walls)
        bits = rng.integers(0, 256, (len(self.points), 64), np.uint8)
        self.descriptors: Bits = bits.view(np.uint64)
        self.angles_rad = rng.uniform(0, 2 * np.pi, len(self.points))

    def way(self, keyframes: int) -> Array:
        """Poses (K, 4, 4): each storey in turn, then storeys at random, by the stairs between."""
        poses: list[Array] = []
        count, storey, visits = 0, 0, 0
        while count < keyframes:
            following = visits if visits < self._storeys else int(self._rng.integers(self._storeys))
            round_ = walk(1, PER_ROUND, self._rng)
            if visits:
                steps = max(ON_STAIRS * abs(following - storey), 1)
                stairs = np.repeat(round_[:1], steps, axis=0)
                stairs[:, 1, 3] -= STOREY_M * np.linspace(storey, following, steps, endpoint=False)
                poses.append(stairs)
            round_[:, 1, 3] -= STOREY_M * following
            poses.append(round_)
            storey, visits = following, visits + 1
            count = sum(map(len, poses))
        return np.concatenate(poses)[:keyframes]

    def seen(self, T_world_camera: Array, keypoints: int) -> tuple[Ints, Features]:
        """Some of the landmarks in view (N,), and the features that show them."""
        near = np.flatnonzero(np.abs(self.points[:, 1] - T_world_camera[1, 3]) < IN_SIGHT_M)
        rows, z = visible(T_world_camera, self.points[near], self.on_wall[near])
        found = self._rng.random(len(rows)) < FOUND
        rows, z = near[rows[found]], z[found]
        chosen = np.sort(self._rng.permutation(len(rows))[:keypoints])
        rows, z = rows[chosen], z[chosen]
        noise = self._rng.normal(0, SIGMAS_PX, z.shape)
        pixels = z[:, :2] + noise[:, :2]
        disparity_px = np.maximum(z[:, 0] - z[:, 2] + noise[:, 2], 1.0)
        flipped = np.packbits(self._rng.random((len(rows), 512)) < CHANGED_BITS, axis=1)
        features = Features(
            pixels=pixels,
            image_pixels=pixels,
            descriptors=self.descriptors[rows] ^ flipped.view(np.uint64),
            scales=np.ones(len(rows)),
            angles_rad=self.angles_rad[rows],
            depth_m=CAMERA.stereo_bf_px_m / disparity_px,
            disparity_px=disparity_px,
            sigmas_px=np.tile(SIGMAS_PX, (len(rows), 1)),
            colours=np.zeros((len(rows), 3), np.uint8),
            gray=GRAY,
        )
        return rows, features


@dataclass(frozen=True)
class Hour:
    """Sizes at the end of an hour, and times (CPU, ms a keyframe) within it.

    ``ids``: landmarks ever made. ``ate_mm``: of the keyframes in the map, after alignment.
    """

    hour: float
    path_km: float
    keyframes: int
    landmarks: int
    ids: int
    in_graph: int
    factors: int
    loops: int
    wrong: int
    ate_mm: float
    insert_ms: float
    graph_ms: float
    graph_p95_ms: float
    loops_ms: float
    loops_p95_ms: float
    rss_mb: float
    file_mb: float


class Day:
    """The back end, fed with what a robot sees."""

    def __init__(self, building: Building, poses: Array, keypoints: int, seed: int) -> None:
        config = BackEndConfig()
        self.mapper = Mapper(CAMERA, Tracker(CAMERA, TrackingConfig()), config)
        self._local_map = config.mapping.local_map
        self._building, self.poses, self._keypoints = building, poses, keypoints
        self._rng = np.random.default_rng(seed)
        self._landmark_of = np.full(len(building.points), -1, np.int64)
        """The landmark of the map that each of the building's was last, -1 for none."""
        self._last: Keyframe | None = None
        self.times_ms: list[tuple[float, ...]] = []

    def step(self, k: int) -> None:
        """Keyframe k, and the ordinary frames before it."""
        rows, features = self._building.seen(self.poses[k], self._keypoints)
        tracked, local_ids = self._tracked(k, rows, features)
        mapper, stamp_s = self.mapper, k * PERIOD_S
        frame = Frame(round(stamp_s * FPS), stamp_s, GRAY, NO_DEPTH)
        clock = [time.process_time()]
        keyframe = mapper.insert(frame, tracked, 0, local_ids)
        clock.append(time.process_time())
        mapper.optimise(keyframe)
        clock.append(time.process_time())
        mapper.close_loops(keyframe)
        clock.append(time.process_time())
        self.times_ms.append(tuple(1e3 * np.diff(clock)))
        known = keyframe.landmark_ids >= 0
        self._landmark_of[rows[known]] = keyframe.landmark_ids[known]
        self._last = keyframe
        for i in range(round(PERIOD_S * FPS)):
            pose = keyframe.T_world_camera
            mapper.history.append(stamp_s + i / FPS, keyframe.id, pose, pose, tracked.information)

    def _tracked(self, k: int, rows: Ints, features: Features) -> tuple[Tracked, Ints]:
        """The keyframe as tracking would find it, and the local map that it looked in."""
        world, information = self.mapper.world, np.eye(6)
        none = np.zeros(0, np.int64)
        if self._last is None:
            T = self.poses[k]
            return Tracked(TrackingStatus.OK, T, features, none, none, 0, none, information), none
        step = inverse(self.poses[k - 1]) @ self.poses[k]
        T = self._last.T_world_camera @ step @ se3_exp(self._rng.normal(0, STEP_SIGMAS))
        local_ids = local_landmarks(world, world.observed(self._last)[1], self._local_map)
        ids = self._landmark_of[rows]
        known = np.flatnonzero(ids >= 0)
        ids = world.landmarks.current(ids[known])
        local = np.isin(ids, local_ids) & world.landmarks.in_map[ids]
        _, first = np.unique(ids, return_index=True)
        once = np.zeros(len(ids), bool)
        once[first] = True
        keypoints, ids = known[local & once], ids[local & once]
        points = transform(inverse(T), world.landmarks.points_world[ids])
        front = points[:, 2] > 0.1
        off = np.full(len(ids), np.inf)
        off[front] = np.linalg.norm(
            CAMERA.project(points[front]) - features.pixels[keypoints[front]], axis=1
        )
        keypoints, ids = keypoints[off < 20], ids[off < 20]
        world.landmarks.visible[ids] += 1
        world.landmarks.found[ids] += 1
        return Tracked(
            TrackingStatus.OK, T, features, keypoints, ids, len(ids), ids, information
        ), local_ids

    def loops(self) -> tuple[int, int]:
        """How many loops were closed, and how many of them are wrong."""
        loops = self.mapper.smoother.relative_poses("loop")
        off_m = [
            np.linalg.norm((self.poses[k.keyframe_a] @ k.T_a_b - self.poses[k.keyframe_b])[:3, 3])
            for k in loops
        ]
        return len(loops), int(np.count_nonzero(np.array(off_m) > WRONG_M))

    def ate_mm(self) -> float:
        """RMSE of the positions of the keyframes in the map, after alignment."""
        ids = np.fromiter(self.mapper.world.keyframes, np.int64)
        poses = np.array([k.T_world_camera for k in self.mapper.world.keyframes.values()])
        return 1e3 * position_rmse_m(poses, self.poses[ids])

    def hour(self, since: int, out: Path) -> Hour:
        """What there is now, and what the keyframes made after the first ``since`` took."""
        mapper, count = self.mapper, len(self.times_ms)
        times = np.array(self.times_ms[since:])
        median, p95 = np.median(times, axis=0), np.percentile(times, 95, axis=0)
        steps_m = np.linalg.norm(np.diff(self.poses[:count, :3, 3], axis=0), axis=1)
        loops, wrong = self.loops()
        estimate = mapper.smoother.estimate()
        return Hour(
            hour=count * PERIOD_S / 3600,
            path_km=float(steps_m.sum()) / 1e3,
            keyframes=len(mapper.world.keyframes),
            landmarks=int(mapper.world.landmarks.in_map.sum()),
            ids=len(mapper.world.landmarks),
            in_graph=len(estimate.landmark_ids),
            factors=estimate.factors,
            loops=loops,
            wrong=wrong,
            ate_mm=self.ate_mm(),
            insert_ms=float(median[0]),
            graph_ms=float(median[1]),
            graph_p95_ms=float(p95[1]),
            loops_ms=float(median[2]),
            loops_p95_ms=float(p95[2]),
            rss_mb=resident_mb(),
            file_mb=saved_mb(mapper, out),
        )


def saved_mb(mapper: Mapper, out: Path) -> float:
    """Size of the file of the whole back end's state in MB (1e6 bytes)."""
    with TemporaryDirectory(dir=out) as folder:
        path = Path(folder) / "map"
        write_arrays(path, FileKind("map", 1), {}, mapper.state())
        return path.stat().st_size / 1e6


def table(hours: list[Hour]) -> str:
    """The hours as text."""
    names = list(asdict(hours[0]))
    rows = ["".join(f"{name:>13}" for name in names)]
    for hour in hours:
        values = asdict(hour).values()
        rows.append("".join(f"{v:13d}" if isinstance(v, int) else f"{v:13.1f}" for v in values))
    return "\n".join(rows)


def plot(hours: list[Hour], times_ms: Array, path: Path) -> None:
    """Times of the stages, memory and file, keyframes, over the day."""
    figure = Figure(figsize=(11, 3.4), dpi=120, layout="constrained")
    times, sizes, counts = figure.subplots(1, 3)
    at = np.arange(len(times_ms)) * PERIOD_S / 3600
    width = max(len(times_ms) // 200, 1)
    used = len(times_ms) // width * width
    mean = times_ms[:used].reshape(-1, width, len(STAGES)).mean(axis=1)
    for name, column, colour in zip(STAGES, mean.T, ("#009e73", "#0072b2", "#d55e00"), strict=True):
        times.plot(at[:used:width], column, color=colour, lw=1, label=name)
    times.set(xlabel="hour", ylabel="CPU ms a keyframe, mean", ylim=(0, None))
    hour = [h.hour for h in hours]
    sizes.plot(hour, [h.rss_mb for h in hours], "o-", color="#0072b2", label="resident memory")
    sizes.plot(hour, [h.file_mb for h in hours], "s-", color="#d55e00", label="map file")
    sizes.set(xlabel="hour", ylabel="MB", ylim=(0, None))
    counts.plot(hour, [h.keyframes for h in hours], "o-", color="#0072b2", label="keyframes")
    counts.plot(hour, [h.loops for h in hours], "s-", color="#d55e00", label="loops")
    counts.set(xlabel="hour", ylim=(0, None))
    for axis in (times, sizes, counts):
        axis.grid(alpha=0.25, lw=0.5)
        axis.legend(frameon=False)
    figure.savefig(path)


def main() -> None:
    """Walk, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--storeys", type=int, default=10)
    parser.add_argument("--per-m2", type=float, default=14.0, help="landmarks on the walls")
    parser.add_argument("--keypoints", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--picture", type=Path, help="default: day.png beside the numbers")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    building = Building(args.storeys, args.per_m2, np.random.default_rng(args.seed))
    poses = building.way(round(args.hours * 3600 / PERIOD_S))
    day = Day(building, poses, args.keypoints, args.seed)
    hours: list[Hour] = []
    since = 0
    parts = max(round(args.hours), 4)
    ends = set(np.linspace(0, len(poses), parts + 1).astype(int)[1:].tolist())
    for k in range(len(poses)):
        day.step(k)
        if k + 1 in ends:
            hours.append(day.hour(since, args.out))
            since = k + 1
            print(table(hours[-1:]).split("\n")[-1] if len(hours) > 1 else table(hours), flush=True)
    kinds = Counter(event.kind.name for event in day.mapper.events.take())
    print("events:", ", ".join(f"{name} {count}" for name, count in sorted(kinds.items())))
    begin_s = time.process_time()
    day.mapper.finish()
    passed_s = time.process_time() - begin_s
    print(f"last optimisation, of all landmarks: {passed_s:.0f} s, ATE {day.ate_mm():.1f} mm")
    (args.out / "day.json").write_text(json.dumps([asdict(h) for h in hours], indent=1))
    plot(hours, np.array(day.times_ms), args.picture or args.out / "day.png")


if __name__ == "__main__":
    main()
