"""What the light network's masks are worth at keypoints: makes data/weights/light_observation.yaml.

    python -m benchmarks.semantics.observation_model [--out FILE] [--cache FILE]

Measured on photographs that no training saw: those of COCO's val2017 in the excerpt, and every
third of NYUv2, whose classes chair, sofa, bed, table, desk, toilet, sink, television, refrigerator,
books and person are COCO's too. Landmarks are corners, so only corners count (FAST, spread over the
image): a table's mask is a table's in its area, but its corners are those of what lies on it. Each
photograph is looked at VIEWS times: as it is, and as parts of it, enlarged and half of them
mirrored, in place of the views of a camera that moves. As in a run, another view from one viewpoint
counts by `LabelStoreConfig.again`: parts that are enlarged by less than `DISTANCE_STEP` are from
where the photograph was taken, the others from nearer.

Precision: of the corners under masks of a class, the share that is on it; a logistic function of
the mean logit of the class score, of the evidence, which is the sum of mask scores over views, and
of its logarithm, with an offset for each class. Evidence does not count for what things lie on
(tables, beds): these are there in every view. Corners within 5 px of the mask's edge do not
count: of those depth and other views decide. Corners: of those under masks that are right, the
share that is on the class, of all and of those 20 px or more inside, by the evidence: a corner that
is under the mask in every view is well inside it in all of them. Objects: the precision of whole
masks, which are right if half of their pixels are on their class. Recall: of a thing's corners, the
share that a mask of its class covers in the photograph itself; a logistic function of
log2(size / 64 px), size the root of the area in an image of 640 px, with an offset for each class.
All by iterated weighted least squares; offsets have a normal prior of standard deviation 0.7, so
that a class of which little was seen stays near the mean. Of what is "otherprop or unlabelled" in
NYUv2 nothing is known, nor of masks most of which is on that (a screen that is no television); but
under masks of tables and beds it is mostly what lies on them, and counts half as that.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks.machine import describe_commit, now
from benchmarks.pages import WRITTEN
from benchmarks.paths import ROOT
from benchmarks.semantics.nyuv2 import NYUV2
from benchmarks.semantics.photographs import IMAGES, held_out
from bmask_slam.graph.arrays import Array, Image, Ints
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.semantics.beliefs.class_sizes import SUPPORT, read_sizes
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.observation import DISTANCE_STEP
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

EVERY = 3
SAME = {
    3: "bed", 4: "chair", 5: "couch", 6: "dining table", 13: "dining table", 22: "book",
    23: "refrigerator", 24: "tv", 30: "person", 32: "toilet", 33: "sink",
}  # fmt: skip
"""COCO's names of NYUv2's codes."""
UNSURE = (39, 9, 25, 36)
"""Codes that may hide things of COCO: unlabelled, bookshelf, paper, bag."""
NOTHING, DOUBTFUL, CROWD = 0, -1, -2
MIN_SCORE, BORDER_PX, CELL_PX, A_CELL, MOST = 0.15, 20, 40, 6, 850
THRESHOLDS = (50, 35, 25, 18, 13)
SIDE_PX, MIDDLE_PX, LARGEST_PX, INSIDE_PX = 640, 64.0, 256.0, 5.0
WELL_INSIDE_PX = 20.0
VIEWS, PART, SEED = 6, (0.55, 0.95), 5
RINGS, AGAIN = 2, LabelStoreConfig().again
OFFSET_SIGMA, ENOUGH, MIN_CORNERS, MIN_CONFUSED, ITERATIONS = 0.7, 20, 8, 0.03, 20
HALF = 0.5
OUT = ROOT / "data" / "weights" / "light_observation.yaml"


class Photograph(NamedTuple):
    """An image (H, W, 3), the class of each pixel (H, W), and the number of its thing or -1."""

    kind: int
    image: Image
    true: Ints
    things: Ints


class Corner(NamedTuple):
    """Columns of the table of corners: what is there, and what masks say.

    ``mask`` and ``label0`` are of the photograph as it is, with ``covered``, the share of the
    mask's pixels that is on its class; the rest is of the class with the most evidence in all
    views.
    """

    kind: Array
    image: Array
    true: Array
    thing: Array
    size_px: Array
    mask: Array
    label0: Array
    covered: Array
    label: Array
    logit: Array
    evidence: Array
    inside_px: Array


def corners(image: Image) -> Ints:
    """Pixels (N, 2) of corners, spread over an image (H, W, 3) as the front end does it."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    for threshold in THRESHOLDS:
        found = cv2.FastFeatureDetector_create(threshold).detect(gray)
        if len(found) >= MOST:
            break
    height, width = gray.shape
    counts: dict[tuple[int, int], int] = {}
    chosen = []
    for point in sorted(found, key=lambda p: -p.response):
        u, v = (int(x) for x in point.pt)
        cell = u // CELL_PX, v // CELL_PX
        counts[cell] = counts.get(cell, 0) + 1
        inside = BORDER_PX <= u < width - BORDER_PX and BORDER_PX <= v < height - BORDER_PX
        if inside and counts[cell] <= A_CELL:
            chosen.append((u, v))
    return np.array(chosen[:MOST], np.int64).reshape(-1, 2)


def masks_at(image: Image, pixels: Ints, segmenter: Segmenter) -> tuple[Array, list[Any]]:
    """Rows (N, 5) at pixels (N, 2): mask, its label, class score, mask score, and depth in it.

    The last is the distance to its edge in pixels of an image of SIDE_PX. Also the masks.
    """
    found = segmenter.segment(image, "")
    size = image.shape[:2]
    blank = np.full((size[0] // 2, size[1] // 2), np.nan, np.float32)
    assignment = assign_pixels(found, blank, size, VoteConfig(), in_boxes=True)
    u, v = pixels.T
    mask = assignment.owner[v, u].astype(int)
    table = [(i.label, i.class_score, i.mask_score) for i in assignment.instances]
    values = np.array([*table, (0, 0.0, 0.0)], float)[mask]
    inside_px = np.zeros(len(u))
    for k, instance in enumerate(assignment.instances):
        own = mask == k
        distance_px = cv2.distanceTransform(instance.mask.astype(np.uint8), cv2.DIST_L2, 3)
        inside_px[own] = distance_px[v[own], u[own]] * SIDE_PX / max(size)
    return np.column_stack([mask, values, inside_px]), list(assignment.instances)


def observed(photograph: Photograph, number: int, segmenter: Segmenter) -> Array:
    """Rows (N, 12) of a photograph's corners, see Corner."""
    image, true, things = photograph.image, photograph.true, photograph.things
    pixels = corners(image)
    first, instances = masks_at(image, pixels, segmenter)
    shares = [*(_covered(true[i.mask], i.label) for i in instances), 0.0]
    classes = len(segmenter.labels)
    evidence, logits, inside_px = np.zeros((3, len(pixels), classes))
    looked = np.zeros((len(pixels), RINGS), bool)
    rng = np.random.default_rng([SEED, photograph.kind, number])
    for view in range(VIEWS):
        seen, rows, ring = np.arange(len(pixels)), first, 0
        if view:
            part, x, y, mirrored = _part(image, rng)
            local = pixels - np.array([x, y])
            size = part.shape[1], part.shape[0]
            seen = np.flatnonzero(((local >= 0) & (local < size)).all(axis=1))
            local = local[seen]
            if mirrored:
                local[:, 0] = size[0] - 1 - local[:, 0]
            rows, _ = masks_at(np.ascontiguousarray(part), local, segmenter)
            ring = ring_of(part.shape[1] / image.shape[1])
        new = np.where(looked[seen, ring], AGAIN, 1.0)
        looked[seen, ring] = True
        on = rows[:, 1] > 0
        at, worth = (seen[on], rows[on, 1].astype(int)), new[on] * rows[on, 3]
        evidence[at] += worth
        logits[at] += worth * logit(np.clip(rows[on, 2], 0.05, 0.98))
        inside_px[at] = np.maximum(inside_px[at], rows[on, 4])
    label = evidence.argmax(axis=1)
    best = np.arange(len(pixels)), label
    u, v = pixels.T
    areas = np.append(np.bincount(things[things >= 0].ravel(), minlength=1), 0)
    size_px = np.sqrt(areas[things[v, u]]) * SIDE_PX / max(image.shape[:2])
    count = np.ones(len(pixels))
    return np.column_stack([
        photograph.kind * count, number * count, true[v, u], things[v, u], size_px,
        first[:, 0], first[:, 1], np.array(shares)[first[:, 0].astype(int)],
        np.where(evidence[best] > 0, label, 0), logits[best] / np.maximum(evidence[best], 1e-9),
        evidence[best], inside_px[best],
    ])  # fmt: skip


def ring_of(share: float) -> int:
    """The ring of the viewpoint that a part with a share of the image's width stands for."""
    return int(np.log(1 / share) / np.log(DISTANCE_STEP))


def _part(image: Image, rng: np.random.Generator) -> tuple[Image, int, int, bool]:
    """A part of an image, maybe mirrored, and its left upper corner."""
    share = rng.uniform(*PART)
    height, width = (int(share * n) for n in image.shape[:2])
    x = int(rng.integers(image.shape[1] - width + 1))
    y = int(rng.integers(image.shape[0] - height + 1))
    part, mirrored = image[y : y + height, x : x + width], bool(rng.random() < HALF)
    return (part[:, ::-1] if mirrored else part), x, y, mirrored


def _covered(true: Ints, label: int) -> float:
    """Share of pixels with these classes (N,) that is on a class; NaN if most are doubtful."""
    known = (true != CROWD) & (true != DOUBTFUL)
    enough = known.sum() > HALF * len(true)
    return float((true[known] == label).mean()) if enough else float("nan")


def photographs(segmenter: Segmenter) -> Iterator[Photograph]:
    """COCO's (kind 0) and NYUv2's (kind 1)."""
    content = held_out()
    for image in content.images:
        true = np.full((image.height, image.width), NOTHING)
        things = np.full(true.shape, -1)
        for j, o in sorted(enumerate(image.objects), key=lambda pair: -pair[1].mask().sum()):
            name = content.labels.names[o.label]
            true[o.mask()] = CROWD if o.crowd else segmenter.labels.number(name)
            things[o.mask()] = j
        yield Photograph(0, read_colour(IMAGES / image.file_name), true, things)
    table = np.full(256, NOTHING)
    table[list(UNSURE)] = DOUBTFUL
    table[list(SAME)] = [segmenter.labels.number(name) for name in SAME.values()]
    lines = (NYUV2 / "split.txt").read_text(encoding="utf-8").split("\n")
    for line in [line for line in lines if line.strip()][::EVERY]:
        name = line.split()[0]
        codes = cv2.imread(str(NYUV2 / "labels" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert codes is not None
        true = table[codes]
        yield Photograph(1, read_colour(NYUV2 / "images" / f"{name}.jpg"), true, _regions(true))


def _regions(true: Ints) -> Ints:
    """Numbers (H, W) of connected regions of one class, -1 on nothing."""
    things, count = np.full(true.shape, -1), 0
    for label in np.unique(true[true > 0]).tolist():
        number, of_pixel = cv2.connectedComponents((true == label).astype(np.uint8))
        inside = of_pixel > 0
        things[inside] = of_pixel[inside] + count
        count += number
    return things


def fit(classes: Ints, features: Array, share: Array, weights: Array) -> tuple[Array, dict]:
    """Coefficients (F + 1,), and offsets by class, of sigmoid(x0 + features x + offset) = share.

    Features (N, F), shares and weights (N,).
    """
    names, where = np.unique(classes.astype(int), return_inverse=True)
    common = np.column_stack([np.ones(len(share)), features])
    f, count = common.shape[1], len(names)
    prior = np.append(np.full(f, 1e-6), np.full(count, OFFSET_SIGMA**-2))
    x = np.zeros(f + count)
    for _ in range(ITERATIONS):
        p = 1 / (1 + np.exp(-(common @ x[:f] + x[f:][where])))
        worth, error = weights * p * (1 - p), weights * (share - p)
        information = np.diag(np.append(np.zeros(f), np.bincount(where, worth, count)) + prior)
        information[:f, :f] += (common * worth[:, None]).T @ common
        for k in range(f):
            information[k, f:] = np.bincount(where, worth * common[:, k], count)
            information[f:, k] = information[k, f:]
        gradient = np.append(common.T @ error, np.bincount(where, error, count)) - prior * x
        x = x + np.linalg.solve(information, gradient)
    return x[:f], dict(zip(names.tolist(), x[f:].tolist(), strict=True))


def logit(p: Array) -> Array:
    """Log odds of probabilities."""
    return np.asarray(np.log(p / (1 - p)))


def grouped(*columns: Array) -> tuple[Ints, Ints]:
    """The group (N,) of each row by the values of columns (N,), and the sizes of the groups."""
    _, group = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    return group, np.bincount(group)


def known_rows(c: Corner, names: tuple[str, ...]) -> Ints:
    """Corners under a mask of which the truth is known."""
    named = [names.index(name) for name in SAME.values()]
    known = (c.label > 0) & (c.true != CROWD) & ((c.kind == 0) | np.isin(c.label, named))
    unsure = (c.label0 == c.label) & ~np.isfinite(c.covered)
    return np.flatnonzero(known & ~unsure & (c.inside_px >= INSIDE_PX))


def precision(c: Corner, names: tuple[str, ...]) -> tuple[Array, dict, dict[int, dict[int, float]]]:
    """Coefficients and offsets of corners' precision, and the confusions of classes."""
    on = known_rows(c, names)
    of_supports = read_sizes(LabelSet(names)).is_in(SUPPORT)
    on = on[(c.true[on] != DOUBTFUL) | of_supports[c.label[on].astype(int)]]
    group, sizes = grouped(c.kind[on], c.image[on], c.label[on])
    weights = np.minimum(1.0, ENOUGH / sizes)[group] / ENOUGH
    weights = weights * np.where(c.true[on] == DOUBTFUL, HALF, 1.0)
    supports = of_supports[c.label[on].astype(int)]
    evidence = np.where(supports, 1.0, c.evidence[on])
    features = np.column_stack([c.logit[on], np.log(evidence), np.where(supports, 0.0, evidence)])
    right = c.true[on] == c.label[on]
    x, offsets = fit(c.label[on], features, right.astype(float), weights)
    wrong: dict[int, dict[int, float]] = {}
    for k in np.unique(c.label[on]).astype(int).tolist():
        own = c.label[on] == k
        total = weights[own].sum() + 3.0  # as if three more groups had no confusion
        for j in np.unique(c.true[on][own]).astype(int).tolist():
            part = weights[own & (c.true[on] == j)].sum() / total
            if j > 0 and j != k and part >= MIN_CONFUSED:
                wrong.setdefault(k, {})[j] = float(part)
    return x, offsets, wrong


def on_thing(c: Corner, names: tuple[str, ...]) -> tuple[Array, dict]:
    """Log odds that corners under a right mask are on its thing, and offsets of classes.

    At evidence 0 and how they grow with it, of all and of those inside. What things lie on is in
    every view, so evidence does not count for it.
    """
    on = known_rows(c, names)
    on = on[(c.label0[on] == c.label[on]) & (c.covered[on] >= HALF)]
    of_supports = read_sizes(LabelSet(names)).is_in(SUPPORT)
    on = on[(c.true[on] != DOUBTFUL) | of_supports[c.label[on].astype(int)]]
    group, sizes = grouped(c.kind[on], c.image[on], c.label[on])
    weights = np.minimum(1.0, ENOUGH / sizes)[group] / ENOUGH
    weights = weights * np.where(c.true[on] == DOUBTFUL, HALF, 1.0)
    inside = (c.inside_px[on] >= WELL_INSIDE_PX).astype(float)
    evidence = np.where(of_supports[c.label[on].astype(int)], 0.0, c.evidence[on])
    right = (c.true[on] == c.label[on]).astype(float)
    features = np.column_stack([inside, evidence, inside * evidence])
    (a, b, e, f), offsets = fit(c.label[on], features, right, weights)
    (all_a, all_e), _ = fit(c.label[on], evidence[:, None], right, weights)
    return np.array([all_a, all_e, a + b, e + f]), offsets


def objects(c: Corner, names: tuple[str, ...]) -> tuple[Array, dict]:
    """Coefficients and offsets of the precision of whole masks."""
    on = known_rows(c, names)
    on = on[c.label0[on] == c.label[on]]
    group, sizes = grouped(c.kind[on], c.image[on], c.mask[on])
    rows = np.zeros((len(sizes), 4))
    of_mask = c.label[on], c.logit[on], np.log(c.evidence[on]), c.covered[on]
    for column, values in enumerate(of_mask):
        np.add.at(rows[:, column], group, values)
    rows /= sizes[:, None]
    right = (rows[:, 3] >= HALF).astype(float)
    return fit(np.rint(rows[:, 0]), rows[:, 1:3], right, np.ones(len(rows)))


def recall(c: Corner) -> tuple[Array, dict]:
    """Coefficients and offsets of recall."""
    on = np.flatnonzero((c.true > 0) & (c.thing >= 0))
    group, sizes = grouped(c.kind[on], c.image[on], c.thing[on])
    rows = np.zeros((len(sizes), 3))
    hit = c.label0[on] == c.true[on]
    for column, values in enumerate((c.true[on], c.size_px[on], hit)):
        np.add.at(rows[:, column], group, values)
    rows = (rows / sizes[:, None])[sizes >= MIN_CORNERS]
    size = np.log2(np.minimum(rows[:, 1], LARGEST_PX) / MIDDLE_PX)
    return fit(np.rint(rows[:, 0]), size[:, None], rows[:, 2], np.ones(len(rows)))


def table(rows: Array, names: tuple[str, ...]) -> list[str]:
    """The lines of the table."""
    c = Corner(*rows.T)
    (x, p, wrong), (y, o), (z, r) = precision(c, names), objects(c, names), recall(c)
    inside, q = on_thing(c, names)
    lines = [
        "# What masks of light.safetensors are worth at corners of the image, measured on COCO",
        "# val2017 and NYUv2 by python -m benchmarks.semantics.observation_model, which says how;",
        f"# commit {describe_commit(WRITTEN).split()[0]}, {now()}.",
        "# precision = sigmoid(a + b logit(score) + c log(evidence) + d evidence + offset), of",
        "# corners under masks; objects: the same of whole masks, without d",
        "# recall = sigmoid(a + b log2(size / 64 px) + offset), size at most 256 px of 640",
        "# corners = sigmoid(a + d evidence + offset), on the thing under a right mask: all, and",
        "# those well inside",
        "# Of a class: offsets of precision, objects, recall, corners; corners on other classes.",
    ]
    curves = (("precision", x), ("objects", y), ("recall", z), ("corners", inside))
    for name, coefficients in curves:
        lines.append(f"{name}: [{', '.join(f'{value:.3f}' for value in coefficients)}]")
    lines.append("classes:")
    for k, name in enumerate(names):
        if k in p or k in r:
            offsets = ", ".join(f"{t.get(k, 0.0):.2f}" for t in (p, o, r, q))
            others = ", ".join(f"{names[j]}: {n:.2f}" for j, n in wrong.get(k, {}).items())
            lines.append(f"  {name}: [{offsets}, {{{others}}}]")
    return lines


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--cache", type=Path, help="rows of corners, made where missing (.npy)")
    arguments = parser.parse_args()
    segmenter = make_segmenter(SegmenterOptions(min_score=MIN_SCORE), data_path("labels"))
    if arguments.cache is None or not arguments.cache.exists():
        every = enumerate(photographs(segmenter))
        rows = np.concatenate([observed(photo, k, segmenter) for k, photo in every])
        if arguments.cache is not None:
            np.save(arguments.cache, rows.astype(np.float32))
    else:
        rows = np.load(arguments.cache).astype(float)
    lines = table(rows, segmenter.labels.names)
    arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
