"""Accuracy of place recognition against the true poses of a sequence, and time of a query.

    bmask-slam render corridor --out corridor
    python -m benchmarks.loops.place_recognition corridor [--every 10] [--json]

Every tenth frame is a keyframe. Two keyframes show the same place if enough of the keypoints of
one are visible in the other, by true poses and depth, within 60 degrees of rotation. The map is
enlarged by copies of the sequence with 120 bits of each descriptor changed at random, which exceeds
every threshold. Nothing of the sequence is tracked, and no loop is closed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features
from bmask_slam.features.descriptor_index import BITS, DescriptorIndex, IndexConfig
from bmask_slam.graph.arrays import Array, Bits, Floats, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.loops.place_recognition import PlaceConfig, PlaceRecogniser
from bmask_slam.sequences.sequence import open_sequence

SAME_PLACE = 0.3  # of the keypoints seen
SOME_PLACE = 0.1  # less than this is a wrong place
COVISIBLE_REACH = 20  # keyframes: beyond it, a system that closed no loop shares no landmarks
DEPTH_STEP_PX = 4
MAP_SIZES = (100, 300, 1000)


@dataclass(frozen=True)
class View:
    """A keyframe with its true pose, and every fourth pixel of its depth."""

    features: Features
    depth_m: Floats
    T_world_camera: Array


@dataclass(frozen=True)
class PlaceScore:
    """Numbers of queries at a known place, with a candidate, and with a right one.

    ``wrong``: queries whose first candidate shows (nearly) nothing of the same place.
    """

    consistent_queries: int
    queries: int
    at_known_place: int
    recognised: int
    with_candidate: int
    right: int
    wrong: int


@dataclass(frozen=True)
class QueryTime:
    """Median and worst time of one query in a map, and the share of neighbours it found."""

    keyframes: int
    descriptors: int
    query_ms: float
    query_max_ms: float
    vote_recall: float


def views(folder: Path, every: int) -> tuple[list[View], Camera]:
    """The keyframes of a sequence with true poses."""
    sequence = open_sequence(folder)
    truth = sequence.groundtruth
    if truth is None:
        raise SystemExit(f"error: {folder}: no groundtruth.txt; render a sequence")
    extractor = BriskExtractor(sequence.camera, FeatureConfig())
    made = []
    for index in range(0, len(sequence), every):
        frame = sequence.load(index)
        _, (row,) = associate_stamps(np.array([frame.timestamp_s]), truth.timestamps_s)
        depth_m = frame.depth_m[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]
        made.append(View(extractor.extract(frame), depth_m, truth.poses_world_camera[row]))
    return made, sequence.camera


def overlaps(made: list[View], camera: Camera) -> Array:
    """(K, K) share of the keypoints with depth of row's view that column's view sees."""
    share = np.zeros((len(made), len(made)))
    for i, view in enumerate(made):
        has_depth = np.isfinite(view.features.depth_m)
        points = camera.backproject(
            view.features.pixels[has_depth], view.features.depth_m[has_depth]
        )
        for j, other in enumerate(made):
            T_other_view = inverse(other.T_world_camera) @ view.T_world_camera
            if np.trace(T_other_view[:3, :3]) > 1 + 2 * np.cos(np.deg2rad(60)):
                share[i, j] = _visible(
                    transform(T_other_view, points), other.depth_m, camera
                ).mean()
    return share


def _visible(points: Array, depth_m: Floats, camera: Camera) -> Mask:
    """Whether points (N, 3) of a camera are in its image, where the depth is theirs within 5 %."""
    z = np.maximum(points[:, 2], 0.1)
    pixels = camera.project(np.column_stack([points[:, :2], z])) / DEPTH_STEP_PX
    column, row = np.rint(np.clip(pixels, -1e6, 1e6)).astype(int).T
    rows, columns = depth_m.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & (points[:, 2] > 0.1)
    there = depth_m[np.where(inside, row, 0), np.where(inside, column, 0)]
    return inside & (np.abs(there - z) < 0.05 * z)


def score(made: list[View], share: Array, rules: PlaceConfig) -> PlaceScore:
    """Query with every keyframe in turn, then add it to the index."""
    recogniser = PlaceRecogniser(DescriptorIndex(), rules)
    ids = np.arange(len(made))

    def covisible(k: int) -> list[int]:
        near = (np.abs(ids - k) <= COVISIBLE_REACH) & (ids != k) & (ids <= newest)
        return ids[near & (share[k] >= SOME_PLACE)].tolist()

    known = recognised = with_candidate = right = wrong = 0
    for newest, view in enumerate(made):
        candidates = recogniser.query(newest, view.features.descriptors, covisible)
        old = ids[: max(newest - COVISIBLE_REACH, 0)]
        is_known = bool((share[newest, old] >= SAME_PLACE).any())
        known += is_known
        if candidates:
            best = share[newest, candidates[0].keyframe_id]
            with_candidate += 1
            recognised += is_known and best >= SAME_PLACE
            right += bool(best >= SAME_PLACE)
            wrong += bool(best < SOME_PLACE)
        recogniser.index.add(newest, view.features.descriptors)
    needed = rules.consistent_queries
    return PlaceScore(needed, len(made), known, recognised, with_candidate, right, wrong)


def query_time(made: list[View], keyframes: int) -> QueryTime:
    """Query with views of the sequence in a map of this many keyframes."""
    config = IndexConfig()
    index, exact = DescriptorIndex(config), DescriptorIndex(IndexConfig(lists=1 << 30))
    for k in range(keyframes):
        descriptors = changed_descriptors(made[k % len(made)].features.descriptors, k // len(made))
        index.add(k, descriptors)
        exact.add(k, descriptors)
    times_ms, found, expected = [], 0.0, 0.0
    for k in range(0, min(keyframes, len(made)), 7):
        query = made[k].features.descriptors
        start = time.perf_counter()
        votes = index.votes(query, (k,))
        times_ms.append(1e3 * (time.perf_counter() - start))
        found += float(votes.scores.sum())
        expected += float(exact.votes(query, (k,)).scores.sum())
    total = sum(len(made[k % len(made)].features) for k in range(keyframes))
    middle, worst = float(np.median(times_ms)), max(times_ms)
    return QueryTime(keyframes, total, middle, worst, found / max(expected, 1))


def changed_descriptors(descriptors: Bits, seed: int) -> Bits:
    """The descriptors with 120 of 512 bits changed at random; seed 0: as they are."""
    if seed == 0:
        return descriptors
    change = np.random.default_rng(seed).random((len(descriptors), BITS)) < 120 / BITS
    return descriptors ^ np.packbits(change, axis=1).view(np.uint64)


def main() -> None:
    """Print both tables, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--every", type=int, default=10, help="frames from keyframe to keyframe")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    made, camera = views(arguments.folder, arguments.every)
    share = overlaps(made, camera)
    scores = [score(made, share, PlaceConfig(consistent_queries=n)) for n in (1, 2, 3)]
    times = [query_time(made, size) for size in MAP_SIZES]
    if arguments.json:
        rows = {"places": [asdict(s) for s in scores], "times": [asdict(t) for t in times]}
        print(json.dumps(rows, indent=1))
        return
    for values in (*map(asdict, scores), *map(asdict, times)):
        print("  ".join(f"{k} {v:.3g}" for k, v in values.items()))


if __name__ == "__main__":
    main()
