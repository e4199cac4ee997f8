"""What the masks of a network are worth: measured precision, confusion and recall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.semantics.beliefs.class_sizes import SUPPORT, ClassSizes, read_sizes
from bmask_slam.semantics.labels import LabelSet

MEASURED = {"light": ("weights", "light_observation.yaml")}
"""The table of each segmenter that has one."""
GROUPS = 4
"""Classes are put into so many groups of like size, for what is missed."""
_GROUP_LIMITS_M = np.array([0.15, 0.4, 0.9])
_MIDDLE_PX, _LARGEST_PX, _SIDE_PX = 64.0, 256.0, 640.0
_FILLED = 0.6
"""The root of the area of a thing in the image, as a share of its longest side."""
_SCORES = (0.05, 0.98)
_CURVES = ("precision", "objects", "recall", "corners")
_EVIDENCE = (0.15, 5.0)
"""Limits of the evidence that counts for objects; measured up to 2.3."""
_EVIDENCE_OF_CORNERS = (0.15, 2.3)
"""The same for corners: no more counts than was measured, as photographs have few viewpoints."""
_MOST_RIGHT = 0.98
DISTANCE_STEP = 1.4
"""Distances of a ratio below it are from one viewpoint, if their directions are."""
_AZIMUTHS, _ELEVATIONS = 24, 12


@dataclass(frozen=True, eq=False)
class ObservationModel:
    """Measured properties of a network's masks, by class (C,); class 0 is "unknown".

    precision = sigmoid(a + b l + c ln(e) + d e + offset), with l the mean logit of the class score
    and e the evidence, which is the sum of mask scores over independent views: the probability that
    a corner under masks of the class is on such a thing, or, of objects (without d), that the thing
    under them is one. Errors of a network repeat themselves from view to view, so that this grows
    slower than by Bayes' rule for independent views; but what is found in every view of a
    photograph is right more often than the logarithm alone lets expect.
    on_thing = sigmoid(a + d e + offset): the share of corners under a mask that are on the thing,
    where the mask's thing is of the class: of all, which the precision is of, and of those well
    inside. Near a mask's edge depth decides in a run, so that landmarks are as those inside. It
    grows with the evidence, since what all views have a mask on is not beside the thing.
    recall = sigmoid(a + b log2(size / 64 px) + offset), size the root of a thing's area in an image
    of 640 pixels.

    Attributes:
        precision: a, b, c, d. objects: a, b, c. recall: a, b. corners: a, d of all, a, d
            inside.
        precision_offsets, object_offsets, recall_offsets, corner_offsets: (C,).
        confused: (C, C) share of the corners under masks of a class (row) on other classes.
        sizes: of the classes.
    """

    precision: Array
    objects: Array
    recall: Array
    corners: Array
    precision_offsets: Array
    object_offsets: Array
    recall_offsets: Array
    corner_offsets: Array
    confused: Array
    sizes: ClassSizes

    @property
    def groups(self) -> Ints:
        """The group (C,) of each class by its size."""
        return np.searchsorted(_GROUP_LIMITS_M, self.sizes.typical_m)

    @property
    def best_recall(self) -> Array:
        """Recall (C,) of things that are large in the image."""
        return _sigmoid(self._recall_logit(np.array(_LARGEST_PX)) + self.recall_offsets)

    def group_recall(self, z_m: Array, focal_px: float, width_px: int) -> Array:
        """Recall (N, GROUPS) of things at depths (N,), relative to large ones.

        Of a usual thing of each group, with the camera's focal length and image width.
        """
        edges_m = np.array([0.08, *_GROUP_LIMITS_M, 2.0])
        typical_m = np.sqrt(edges_m[:-1] * edges_m[1:])
        side_px = typical_m * focal_px / np.maximum(z_m, 0.05)[:, None] * (_SIDE_PX / width_px)
        best = _sigmoid(self._recall_logit(np.array(_LARGEST_PX)))
        return _sigmoid(self._recall_logit(_FILLED * side_px)) / best

    def object_precision(self, seen: Array) -> Array:
        """P(the thing under masks of a class is one) (N, C); ``seen`` as in ``truth``."""
        return self._curve((*self.objects, 0.0), seen, self.object_offsets, _EVIDENCE)

    def thing_precision(self, seen: Array) -> Array:
        """P(the thing that a landmark is on is of a class) (N, C), by what corners are worth.

        That of a corner divided by the share of corners that are on the thing.
        """
        of_corner = self._on_thing(self.corners[:2], seen)
        return np.minimum(self.corner_precision(seen) / of_corner, _MOST_RIGHT)

    def on_thing(self, seen: Array) -> Array:
        """P(a landmark is on the thing under its masks) (N, C), where that is of the class.

        On what things lie on (tables) they are in the middle of the mask, too.
        """
        supports = self.sizes.is_in(SUPPORT)
        every, inside = (self._on_thing(curve, seen) for curve in self.corners.reshape(2, 2))
        return np.where(supports, every, inside)

    def _on_thing(self, curve: Array, seen: Array) -> Array:
        a, d = curve
        evidence = np.clip(seen[:, 1:], *_EVIDENCE_OF_CORNERS)
        growing = np.where(self.sizes.is_in(SUPPORT), 0.0, d * evidence)
        return _sigmoid(a + growing + self.corner_offsets)

    def truth(self, appearance: Array, seen: Array, right: Array | None = None) -> Array:
        """P(true class) (N, C), given P(class by its appearance) (N, C).

        ``seen`` (N, 2) are the mean logit of the class scores, and the evidence; ``right`` (N, C)
        is the precision, of corners if it is not given. A thing that
        looks like class k is of class k with the measured precision, of another one with the
        measured confusion, else of none.
        """
        right = self.corner_precision(seen) if right is None else right.copy()
        right[:, 0] = 1.0
        confused = self.confused.sum(axis=1)
        scale = np.minimum(1.0, (1 - right) / np.maximum(confused, 1e-9))
        found = appearance * right + (appearance * scale) @ self.confused
        found[:, 0] += np.maximum(1 - found.sum(axis=1), 0.0)
        return np.asarray(found / found.sum(axis=1, keepdims=True))

    def corner_precision(self, seen: Array) -> Array:
        """P(a corner under masks of a class is on such a thing) (N, C).

        Evidence does not count for what things lie on: these are there in every view.
        """
        supports = self.sizes.is_in(SUPPORT)
        offsets = self.precision_offsets
        growing = self._curve(self.precision, seen, offsets, _EVIDENCE_OF_CORNERS)
        a, b = self.precision[:2]
        return np.where(supports, _sigmoid(a + b * seen[:, :1] + offsets), growing)

    @staticmethod
    def _curve(
        curve: Sequence[float] | Array, seen: Array, offsets: Array, limits: tuple[float, float]
    ) -> Array:
        a, b, c, d = curve
        evidence = np.clip(seen[:, 1:], *limits)
        return _sigmoid(a + b * seen[:, :1] + c * np.log(evidence) + d * evidence + offsets)

    def _recall_logit(self, size_px: Array) -> Array:
        c, d = self.recall
        size = np.clip(size_px, 1.0, _LARGEST_PX)
        return np.asarray(c + d * np.log2(size / _MIDDLE_PX))


def observation_model(segmenter: str, labels: LabelSet) -> ObservationModel | None:
    """The measured model of a segmenter by its name; None for one that has none.

    Raises:
        InputError: the table is not what ``benchmarks.semantics.observation_model`` writes.
    """
    if segmenter not in MEASURED:
        return None
    path = data_path(*MEASURED[segmenter])
    content = read_yaml(path)
    try:
        curves = {key: np.array(content[key], float) for key in _CURVES}
        offsets, confused = np.zeros((4, len(labels))), np.zeros((len(labels), len(labels)))
        for name, (*row, others) in content["classes"].items():
            offsets[:, labels.number(name)] = row
            for other, share in others.items():
                confused[labels.number(name), labels.number(other)] = share
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not a table of an observation model ({error})") from error
    offsets[:, 0] = confused[0] = confused[:, 0] = 0.0
    names = ("precision_offsets", "object_offsets", "recall_offsets", "corner_offsets")
    by_class = dict(zip(names, offsets, strict=True))
    return ObservationModel(**curves, **by_class, confused=confused, sizes=read_sizes(labels))


def score_logits(distributions: Floats) -> Floats:
    """Log odds (N,) of the class scores of views with distributions (N, C)."""
    if distributions.shape[1] < 2:
        return np.zeros(len(distributions), np.float32)
    score = np.clip(distributions[:, 1:].max(axis=1), *_SCORES)
    return np.asarray(np.log(score / (1 - score)), np.float32)


def viewpoint_cells(points_world: Array, position_world: Array) -> Ints:
    """The viewpoint (N,) from which a camera sees points (N, 3), as a number below 64.

    Views of a point from directions within 15 degrees, and from like distances, mostly share one;
    two that are apart have the same by chance in one of 64 cases.
    """
    ray = position_world - points_world
    distance_m = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)
    azimuth = np.floor((np.arctan2(ray[:, 2], ray[:, 0]) / (2 * np.pi) + 0.5) * _AZIMUTHS)
    elevation = np.floor((np.arcsin(ray[:, 1] / distance_m) / np.pi + 0.5) * _ELEVATIONS)
    ring = np.floor(np.log(distance_m) / np.log(DISTANCE_STEP)) + 40
    code = (azimuth * 31 + elevation) * 37 + ring * 11
    return np.asarray(code.astype(np.int64) * 2654435761 % 2**32 // 2**26)


def _sigmoid(x: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-x)))
