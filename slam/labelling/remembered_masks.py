"""The masks of the last keyframes, kept for landmarks that are made later."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, step_of
from bmask_slam.semantics.beliefs.pixel_assignment import PixelAssignment
from bmask_slam.semantics.beliefs.votes import PixelStack
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import CodedSurfaces, SurfaceClasses, coded
from bmask_slam.semantics.labels import LabelSet

REMEMBERED = 100
"""Number of keyframes whose masks are kept."""
THINNED = 4
"""Of their masks and depth images every so many pixels are kept each way."""
_IMAGES = {"owner": np.int16, "under": np.int16, "inner": bool, "depth_m": np.float32}
_NO_MASK = np.zeros((0, 0), bool)


@dataclass(frozen=True, eq=False)
class _Told:
    """What else is kept of a keyframe: its instances without masks, and classes of its pixels."""

    instances: Sequence[Instance]
    depth_range_m: Array
    surfaces: CodedSurfaces | None


class RememberedMasks:
    """The masks of the last REMEMBERED keyframes, of all in one table an image kind.

    Attributes:
        rows: row of each keyframe in the tables, in the order in which they came.
    """

    rows: dict[int, int]

    def __init__(self, classes: int) -> None:
        """``classes`` of the instances."""
        self.rows = {}
        self._classes = classes
        self._images: dict[str, NDArray[Any]] = {}
        self._told: list[_Told] = []

    def add(
        self, keyframe_id: int, assignment: PixelAssignment, seen: SurfaceClasses | None
    ) -> None:
        """Keep a keyframe's masks in place of the oldest keyframe's, if there are too many."""
        surfaces = None if seen is None else coded(seen)
        self._keep(keyframe_id, _thinned(assignment), surfaces)

    def _keep(
        self, keyframe_id: int, assignment: PixelAssignment, surfaces: CodedSurfaces | None
    ) -> None:
        row = len(self.rows)
        if row == REMEMBERED:
            oldest = next(iter(self.rows), None)
            if oldest is None:
                return
            row = self.rows.pop(oldest)
        if not self._images:
            for name, kind in _IMAGES.items():
                shape = getattr(assignment, name).shape
                self._images[name] = np.zeros((REMEMBERED, *shape), kind)
        for name, table in self._images.items():
            table[row] = getattr(assignment, name)
        told = _Told(assignment.instances, assignment.depth_range_m, surfaces)
        self._told[row : row + 1] = [told]
        self.rows[keyframe_id] = row

    def stack(self) -> PixelStack:
        """All of them, by row."""
        counts = np.array([len(t.instances) for t in self._told], np.int64)
        instances = [i for t in self._told for i in t.instances]
        images = {name: table[: len(self._told)] for name, table in self._images.items()}
        return PixelStack(
            images["owner"],
            images["under"],
            images["inner"],
            images["depth_m"],
            np.cumsum(counts) - counts,
            np.array([i.label for i in instances], np.int64),
            np.array([i.distribution for i in instances], np.float32).reshape(-1, self._classes),
            np.array([i.mask_score for i in instances], np.float32),
            np.concatenate([np.zeros((0, 2)), *(t.depth_range_m for t in self._told)]),
        )

    def surfaces_at(self, rows: Ints, pixels: Array) -> Iterator[tuple[LabelSet, Ints, Floats]]:
        """What keyframes in ``rows`` (N,) say about pixels (N, 2) of theirs.

        Yields each label set with the numbers (M,) of its pixels and distributions (M, C).
        """
        codes = np.zeros(len(rows), np.uint16)
        of: dict[LabelSet, list[Ints]] = {}
        for row in np.unique(rows).tolist():
            if (seen := self._told[row].surfaces) is not None:
                here = np.flatnonzero(rows == row)
                codes[here] = seen.codes_at(pixels[here])
                of.setdefault(seen.labels, []).append(here)
        for labels, parts in of.items():
            numbers = np.sort(np.concatenate(parts))
            yield labels, numbers, CodedSurfaces.decoded(codes[numbers], labels)

    def state(self, names: LabelSet) -> Arrays:
        """As named arrays, with the classes of pixels that ``names`` has."""
        rows = list(self.rows.values())
        told = [self._told[row] for row in rows]
        images = {n: t[rows].ravel() for n, t in self._images.items()}
        images = images or {n: np.zeros(0, kind) for n, kind in _IMAGES.items()}
        shapes = {n: np.tile(t.shape[1:], len(rows)) for n, t in self._images.items()}
        instances = [i for t in told for i in t.instances]
        return {
            "keyframes": np.array(list(self.rows), np.int64),
            "shape": shapes.get("owner", np.zeros(0, np.int64)),
            "depth_shape": shapes.get("depth_m", np.zeros(0, np.int64)),
            **images,
            "ranges_m": np.concatenate([np.zeros(0), *(t.depth_range_m.ravel() for t in told)]),
            "counts": np.array([len(t.instances) for t in told], np.int64),
            "boxes": np.array([i.box for i in instances], np.float32).ravel(),
            "labels": np.array([i.label for i in instances], np.int64),
            "distributions": np.array([i.distribution for i in instances], np.float32).ravel(),
            "scores": np.array([(i.class_score, i.mask_score) for i in instances], float).ravel(),
            **_surface_arrays(names, [t.surfaces for t in told]),
        }

    def restore(self, state: Arrays, names: LabelSet, height: int) -> None:
        """Take over what a state holds, of images of this height; there is nothing yet."""
        count = len(state["keyframes"])
        shape, depth_shape = (state[n][:2].tolist() for n in ("shape", "depth_shape"))
        images = {n: state[n].reshape(count, *shape) for n in ("owner", "under", "inner")}
        depths_m = state["depth_m"].reshape(count, *depth_shape)
        ranges_m = state["ranges_m"].reshape(-1, 2)
        instances, ends = _instances(state), np.cumsum(state["counts"])
        surfaces = _restored_surfaces(names, state, count)
        for k, keyframe_id in enumerate(state["keyframes"].tolist()):
            rows = slice(ends[k] - state["counts"][k], ends[k])
            owner, under, inner = (images[n][k] for n in ("owner", "under", "inner"))
            kept = tuple(instances[rows]), owner, under, inner, depths_m[k], ranges_m[rows]
            assignment = PixelAssignment(*kept)
            if len(owner) == height:  # older versions kept them whole
                assignment = _thinned(assignment)
            self._keep(keyframe_id, assignment, surfaces[k])


def _surface_arrays(names: LabelSet, surfaces: Sequence[CodedSurfaces | None]) -> Arrays:
    """Their codes as named arrays; keyframes without them have none."""
    own = [(k, s) for k, s in enumerate(surfaces) if s is not None and s.labels == names]
    return {
        "coded": np.array([k for k, _ in own], np.int64),
        "cell_px": np.array([c.cell_px for _, c in own], float),
        "codes_shape": np.array([c.codes.shape for _, c in own], np.int64).ravel(),
        "codes": np.concatenate([np.zeros(0, np.uint16), *(c.codes.ravel() for _, c in own)]),
    }


def _restored_surfaces(names: LabelSet, state: Arrays, count: int) -> list[CodedSurfaces | None]:
    """The inverse, of ``count`` keyframes; states of older versions have none."""
    found: list[CodedSurfaces | None] = [None] * count
    if "coded" not in state:
        return found
    shapes, start = state["codes_shape"].reshape(-1, 2).tolist(), 0
    rows = zip(state["coded"].tolist(), shapes, state["cell_px"].tolist(), strict=True)
    for k, (height, width), cell_px in rows:
        codes = state["codes"][start : start + height * width].reshape(height, width)
        found[k] = CodedSurfaces(names, codes, cell_px)
        start += height * width
    return found


def _thinned(assignment: PixelAssignment) -> PixelAssignment:
    """Every THINNED-th pixel each way of a keyframe's masks and depth, without those masks."""
    step = max(THINNED // step_of(assignment.owner.shape[0], assignment.depth_m.shape[0]), 1)
    every = np.s_[::THINNED, ::THINNED]
    owner, under, inner = assignment.owner[every], assignment.under[every], assignment.inner[every]
    depth_m = assignment.depth_m[::step, ::step]
    without = tuple(replace(i, mask=_NO_MASK) for i in assignment.instances)
    return PixelAssignment(without, owner, under, inner, depth_m, assignment.depth_range_m)


def _instances(state: Arrays) -> Sequence[Instance]:
    boxes, count = state["boxes"].reshape(-1, 4), max(len(state["labels"]), 1)
    distributions = state["distributions"].reshape(-1, max(len(state["distributions"]) // count, 1))
    scores = state["scores"].reshape(-1, 2).tolist()
    return [
        Instance(_NO_MASK, box, label, distribution, *score)
        for box, label, distribution, score in zip(
            boxes, state["labels"].tolist(), distributions, scores, strict=True
        )
    ]
