"""Accuracy and calibration of the labels of landmarks and objects, on rendered sequences.

    python -m benchmarks.semantics.labels SEQUENCE... [--segmenter truth] [--imperfect] [--out DIR]

Sequences are rendered with `--true-depth`, those of docs/semantics.md by `bmask-slam render office
--frames 300 --true-depth` and, for 930 and 931, `bmask-slam render room --seed 930 --frames 300
--true-depth`. A landmark's true class is that at its position in most keyframes in which it is
visible. Objects visible in at least two keyframes with enough pixels must be found at a 3-D IoU of
0.25 with their label: against the box of the measured surface (true depth where the sensor's depth
is within four sigmas), against that of the visible surface, and against the whole object's box.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment

from benchmarks.semantics.imperfect_masks import Errors, ImperfectSegmenter
from bmask_slam.comparison.jobs.truth_figures import (
    true_classes,
    true_depth,
    truth_from_world,
    truth_image,
    visible,
)
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array, Floats, Ints
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.rendering.annotations import OBJECTS_TRUTH
from bmask_slam.rendering.engine.sensor import depth_sigma_m
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.objects.boxes3d import OrientedBox, box_around, box_iou
from bmask_slam.semantics.objects.object_map import pixel_rays
from bmask_slam.semantics.objects.publication import MapObject
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.keyframe import Keyframe

MIN_PIXELS = 300
MIN_IOU = 0.25
BINS = 10
UP = np.array([0.0, 0.0, 1.0])
KINDS = ("measured", "visible", "whole")


class RecordingStore(LabelStore):
    """Also stores the single view of each id with the best mask."""

    def update(
        self, ids: Ints, distributions: Floats, weights: Floats, viewpoints: Ints | None = None
    ) -> None:
        super().update(ids, distributions, weights, viewpoints)
        best = self.__dict__.setdefault("best", {})
        for i, p, w in zip(ids.tolist(), distributions, weights.tolist(), strict=True):
            if w > best.get(i, (-1.0, None))[0]:
                best[i] = (w, p)

    def move(self, from_ids, to_ids):  # type: ignore[no-untyped-def]
        super().move(from_ids, to_ids)
        best = self.__dict__.setdefault("best", {})
        for old, new in zip(from_ids.tolist(), to_ids.tolist(), strict=True):
            both = [best[k] for k in (old, new) if k in best]
            if both:
                best[new] = max(both, key=lambda view: view[0])


@dataclass
class RunCounters:
    """Counts over all sequences; probabilities with whether they were right."""

    on_objects: int = 0
    right: int = 0
    right_best_view: int = 0
    background: int = 0
    background_right: int = 0
    sure: list[Array] = field(default_factory=list)
    correct: list[Array] = field(default_factory=list)
    sure_best_view: list[Array] = field(default_factory=list)
    correct_best_view: list[Array] = field(default_factory=list)
    objects: int = 0
    reported: int = 0
    found: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    per_sequence: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Truth:
    """A rendered keyframe: instances (H, W), true depth (H, W) m, T_truth_camera (4, 4).

    ``measured`` (H, W): the sensor gave a depth there, of the surface that is there.
    """

    instances: np.ndarray
    depth_m: np.ndarray
    measured: np.ndarray
    T_truth_camera: Array


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--segmenter", default="truth")
    parser.add_argument("--weights")
    parser.add_argument("--imperfect", action="store_true", help="add errors to the masks")
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C")
    parser.add_argument("--seed", type=int, default=0, help="of the imperfect masks")
    parser.add_argument("--out", type=Path, default=Path("runs/labels"))
    parser.add_argument("--verbose", action="store_true", help="list missed objects")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    counters = RunCounters()
    for path in arguments.sequences:
        sequence = open_sequence(path)
        system = run_system(sequence, arguments)
        measure(system, sequence, counters, arguments.verbose)
        print(counters.per_sequence[-1], flush=True)
    draw_reliability(arguments.out / "reliability.png", counters)
    print(report(counters))


def run_system(sequence: Sequence, arguments: argparse.Namespace) -> SlamSystem:
    config = resolve(SystemConfig, None, arguments.set)
    given = {"name": arguments.segmenter, "weights": arguments.weights}
    segmenter = make_segmenter(replace(config.semantics.segmenter, **given), sequence.folder)
    if arguments.imperfect:
        segmenter = ImperfectSegmenter(segmenter, Errors(), arguments.seed)
    system = SlamSystem(sequence.camera, config, segmenter)
    classes = len(segmenter.labels)
    store = RecordingStore(classes, config.semantics.labels)
    system.semantics.labels = system.semantics._label_votes._labels = store
    for frame in sequence.frames():
        system.process(frame)
    system.finish()
    return system


def measure(system: SlamSystem, sequence: Sequence, counters: RunCounters, verbose: bool) -> None:
    """Compare a finished system with the truth of its sequence."""
    keyframes = list(system.mapper.world.keyframes.values())
    truths = {k.id: read_truth(sequence, k) for k in keyframes}
    T_truth_world = truth_from_world(
        np.array([k.T_world_camera for k in keyframes]),
        np.array([truths[k.id].T_truth_camera for k in keyframes]),
    )
    categories = true_classes(sequence.folder, system.semantics.names)
    before = replace(counters)
    measure_landmarks(system, truths, T_truth_world, categories, counters)
    lines = measure_objects(system, sequence, (truths, T_truth_world, categories), counters)
    reported, objects = counters.reported - before.reported, counters.objects - before.objects
    share = (counters.right - before.right) / max(counters.on_objects - before.on_objects, 1)
    counters.per_sequence.append(
        f"{sequence.name}: {len(keyframes)} keyframes, landmarks on objects right {share:.3f}, "
        f"{objects} objects, {reported} reported\n" + ("\n".join(lines) if verbose else "")
    )


def read_truth(sequence: Sequence, keyframe: Keyframe) -> Truth:
    instances = truth_image(sequence, "instances", keyframe.frame_index)
    depth_m = true_depth(sequence, keyframe.frame_index)
    assert sequence.groundtruth is not None
    row = np.abs(sequence.groundtruth.timestamps_s - keyframe.timestamp_s).argmin()
    pose = sequence.groundtruth.poses_world_camera[row]
    return Truth(instances.astype(np.int64), depth_m, measured(sequence, keyframe, depth_m), pose)


def measured(sequence: Sequence, keyframe: Keyframe, depth_m: np.ndarray) -> np.ndarray:
    """Where (H, W) the sensor's depth is within four sigmas of the truth (H, W)."""
    file = sequence.pairs.depth_files[keyframe.frame_index]
    given = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / sequence.camera.depth_scale
    return (given > 0) & (np.abs(given - depth_m) < 4 * depth_sigma_m(depth_m))


def measure_landmarks(
    system: SlamSystem,
    truths: dict[int, Truth],
    T_truth_world: Array,
    categories: Ints,
    counters: RunCounters,
) -> None:
    """Compare labels with the true class in most keyframes in which a landmark is visible."""
    cloud, camera = system.landmarks(), system.camera
    assert cloud.labels is not None
    points = transform(T_truth_world, cloud.points_world)
    counts = np.zeros((len(points), len(system.semantics.names)), int)
    for truth in truths.values():
        points_camera = transform(inverse(truth.T_truth_camera), points)
        rows, pixels = visible(points_camera, truth.depth_m, camera)
        counts[rows, categories[truth.instances[pixels[:, 1], pixels[:, 0]]]] += 1
    in_view = counts.sum(axis=1) > 0
    label = counts.argmax(axis=1)[in_view]
    found = cloud.labels.estimates
    best = [view_label(system, i) for i in cloud.ids[in_view].tolist()]
    best_label, best_p = (np.array(column) for column in zip(*best, strict=True))
    right, best_right = found.labels[in_view] == label, best_label == label
    on = label > 0
    counters.on_objects += int(on.sum())
    counters.right += int(right[on].sum())
    counters.right_best_view += int(best_right[on].sum())
    counters.background += int((~on).sum())
    counters.background_right += int(right[~on].sum())
    spoken = found.views[in_view] > 0
    counters.sure.append(found.probability[in_view][spoken])
    counters.correct.append(right[spoken])
    counters.sure_best_view.append(best_p[spoken])
    counters.correct_best_view.append(best_right[spoken])


def view_label(system: SlamSystem, landmark: int) -> tuple[int, float]:
    """Label and probability of a landmark by the view with the best mask alone."""
    classes = len(system.semantics.names)
    w, p = system.semantics.labels.__dict__.get("best", {}).get(landmark, (0.0, None))
    prior = system.config.semantics.labels.prior(classes)
    belief = prior if p is None else w * p + (1 - w) * prior
    return int(belief.argmax()), float(belief.max())


def measure_objects(
    system: SlamSystem,
    sequence: Sequence,
    truth: tuple[dict[int, Truth], Array, Ints],
    counters: RunCounters,
) -> list[str]:
    truths, T_truth_world, categories = truth
    (visible, minor), (measurable, _) = (visible_boxes(system, truths, m) for m in (False, True))
    whole = whole_boxes(sequence.folder)
    reported = [(o, moved(o, T_truth_world)) for o in system.objects().objects if o.label]
    lines, ids = [], sorted(visible)
    counters.objects += len(ids)
    ignored: set[int] = set()
    for kind, boxes in (("whole", whole), ("visible", visible), ("measured", measurable)):
        ious = pair_ious(reported, [(categories[i], boxes.get(i)) for i in ids])
        rows, columns = linear_sum_assignment(-ious)
        good = ious[rows, columns] >= MIN_IOU
        counters.found[kind] += int(good.sum())
    hit = set(rows[good].tolist())
    extra = pair_ious(reported, [(categories[i], b) for i, b in sorted(minor.items())])
    for k, (o, box) in enumerate(reported):
        if k in hit:
            continue
        if extra.size and extra[k].max() >= 0.1:
            ignored.add(k)  # a true object that is too small or too rarely visible
            continue
        name = system.semantics.names.names[o.label]
        lines.append(f"  wrong  {name} {o.id} size {box.size_m.round(2)} iou {ious[k].max():.2f}")
    for j, i in enumerate(ids):
        if j not in set(columns[good].tolist()):
            name = system.semantics.names.names[categories[i]]
            size = visible[i].size_m.round(2)
            lines.append(f"  missed {name} {i} size {size} best iou {ious[:, j].max():.2f}")
    counters.reported += len(reported) - len(ignored)
    return lines


def moved(o: MapObject, T_truth_world: Array) -> OrientedBox:
    return OrientedBox(T_truth_world @ o.box.T_world_box, o.box.size_m)


def pair_ious(
    reported: list[tuple[MapObject, OrientedBox]], true: list[tuple[int, OrientedBox | None]]
) -> Array:
    """(N, M), 0 where the labels differ."""
    ious = np.zeros((len(reported), len(true)))
    for a, (o, box) in enumerate(reported):
        for b, (label, other) in enumerate(true):
            if other is None or o.label != label:
                continue
            apart = np.linalg.norm(box.T_world_box[:3, 3] - other.T_world_box[:3, 3])
            if apart < np.linalg.norm(box.size_m) + np.linalg.norm(other.size_m):
                ious[a, b] = box_iou(box, other)
    return ious


def visible_boxes(
    system: SlamSystem, truths: dict[int, Truth], measurable: bool
) -> tuple[dict[int, OrientedBox], dict[int, OrientedBox]]:
    """By instance, the box of the surface that keyframes show; of those shown well, and others.

    Or that they measure; shown well they are by what is shown.
    """
    rays = pixel_rays(system.camera, 1)
    points: dict[int, list[Array]] = {}
    views: dict[int, int] = {}
    for truth in truths.values():
        shown = (truth.instances > 0) & np.isfinite(truth.depth_m) & (truth.depth_m < 6.0)
        for i, n in zip(*np.unique(truth.instances[shown], return_counts=True), strict=True):
            views[int(i)] = views.get(int(i), 0) + int(n >= MIN_PIXELS)
        shown &= truth.measured | (not measurable)
        owners = truth.instances[shown]
        world = transform(truth.T_truth_camera, rays[shown] * truth.depth_m[shown][:, None])
        for i in np.unique(owners).tolist():
            mine = world[owners == i]
            points.setdefault(i, []).append(mine[:: max(1, len(mine) // 2000)])
    boxes = {i: box_around(np.concatenate(p), UP) for i, p in points.items()}
    well = {i: b for i, b in boxes.items() if views[i] >= 2}
    return well, {i: b for i, b in boxes.items() if i not in well}


def whole_boxes(folder: Path) -> dict[int, OrientedBox]:
    content = json.loads((folder / OBJECTS_TRUTH).read_text())
    return {
        o["instance_id"]: OrientedBox(np.array(o["T_world_box"]), np.array(o["size_m"]))
        for o in content["objects"]
    }


def calibration_error(sure: Array, correct: Array) -> tuple[float, list[tuple[float, float, int]]]:
    """Expected calibration error, and (mean probability, share right, count) of each bin."""
    places = np.minimum((sure * BINS).astype(int), BINS - 1)
    bins = [
        (float(sure[places == k].mean()), float(correct[places == k].mean()), int(n))
        for k in range(BINS)
        if (n := (places == k).sum())
    ]
    error = sum(n * abs(p - share) for p, share, n in bins) / max(len(sure), 1)
    return float(error), bins


def draw_reliability(path: Path, counters: RunCounters) -> None:
    figure = Figure(figsize=(5.2, 5), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="#9a9a96", lw=1)
    rows = (
        ("fused", counters.sure, counters.correct, "#1f5fa8"),
        ("best single view", counters.sure_best_view, counters.correct_best_view, "#d6302a"),
    )
    for name, sure, correct, colour in rows:
        error, bins = calibration_error(np.concatenate(sure), np.concatenate(correct))
        x, y, n = np.array(bins).T
        label = f"{name}: ECE {error:.3f}"
        axes.plot(x, y, "o-", color=colour, label=label, ms=4)
        axes.scatter(x, y, s=2000 * n / n.sum(), color=colour, alpha=0.15)
    axes.set_xlabel("probability of the label")
    axes.set_ylabel("share that is right")
    axes.legend(frameon=False)
    axes.grid(alpha=0.25, lw=0.5)
    figure.savefig(path)


def report(counters: RunCounters) -> str:
    fused = calibration_error(np.concatenate(counters.sure), np.concatenate(counters.correct))[0]
    best = np.concatenate(counters.sure_best_view), np.concatenate(counters.correct_best_view)
    on, reported, objects = (
        max(counters.on_objects, 1),
        max(counters.reported, 1),
        max(counters.objects, 1),
    )
    behind = max(counters.background, 1)
    rows = [
        f"landmarks on objects           {counters.on_objects}",
        f"  right class                  {counters.right / on:.3f}",
        f"  right by the best view alone {counters.right_best_view / on:.3f}",
        f"landmarks on the background    {counters.background}",
        f"  right ('unknown')            {counters.background_right / behind:.3f}",
        f"calibration error              {fused:.3f}",
        f"  of the best view alone       {calibration_error(*best)[0]:.3f}",
        f"objects to find, reported       {counters.objects}, {counters.reported}",
    ]
    for kind, found in counters.found.items():
        precision, recall = found / reported, found / objects
        rows.append(f"  {kind:8} boxes: precision {precision:.3f}, recall {recall:.3f}")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
