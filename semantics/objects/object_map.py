"""The objects of a map, fused from detections in many keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, Mask, numbered, step_of
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.semantics.beliefs.class_sizes import ClassSizes
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import viewpoint_cells
from bmask_slam.semantics.beliefs.pixel_assignment import NO_INSTANCE, PixelAssignment
from bmask_slam.semantics.beliefs.surface_geometry import Ground
from bmask_slam.semantics.objects.association import (
    Evidence,
    Overlap,
    assign,
    points_on_objects,
    shares,
)
from bmask_slam.semantics.objects.config import ObjectConfig
from bmask_slam.semantics.objects.detections import Detections, detect
from bmask_slam.semantics.objects.points import ObjectPoints, Sightings
from bmask_slam.semantics.objects.publication import MapObject, ObjectPublisher
from bmask_slam.semantics.objects.revision import MergeEvidence, merges, splits


@dataclass(frozen=True, eq=False)
class KeyframeView:
    """A keyframe with its masks.

    Attributes:
        keyframe_id, timestamp_s, T_world_camera: of the keyframe.
        depth_m: (h, w) every s-th pixel of its depth image in both directions.
        rays: (h, w, 3) camera-frame points of these pixels at a depth of 1 m.
        assignment: the instance of each pixel.
        poses: T_world_keyframe of all keyframes of its map segment, by id.
    """

    keyframe_id: int
    timestamp_s: float
    T_world_camera: Array
    depth_m: Floats
    rays: Array
    assignment: PixelAssignment
    poses: dict[int, Array]


@dataclass(frozen=True, eq=False)
class _Association:
    """The objects in view of a keyframe and its detections' assignment to them.

    Attributes:
        ids: (O,) the objects in the image; known: (O, C) their class distributions before.
        overlap: of the detections with them; assigned: (D,) index of the object, or -1.
        rows, owners, points_camera: (N,), (N,), (N, 3) all points of its map segment: their rows
            in the table, their objects, and their positions in the camera frame.
        shown, covering: (V,), (V,) rows of the visible ones, and the detection on each, or -1.
    """

    ids: Ints
    known: Array
    overlap: Overlap
    assigned: Ints
    rows: Ints
    owners: Ints
    points_camera: Array
    shown: Ints
    covering: Ints


class ObjectMap:
    """Objects by id; their points are in keyframes' frames, so that they move with the graph."""

    def __init__(
        self,
        camera: Camera,
        labels: LabelStore,
        config: ObjectConfig | None = None,
        sizes: ClassSizes | None = None,
    ) -> None:
        """``labels`` is an empty store, of objects; ``sizes`` are those of its classes."""
        self.camera = camera
        self.labels = labels
        self.config = config = config or ObjectConfig()
        self.points = ObjectPoints()
        self._publisher = ObjectPublisher(self.points, labels, config, sizes)
        self._merging = MergeEvidence(config.revision)
        self._splitting = MergeEvidence(config.revision)

    def add(self, view: KeyframeView) -> Ints:
        """Fuse a keyframe's instances; returns the object (K,) of each, -1 for none."""
        found = detect(view.assignment, view.depth_m, view.rays, self.config.detections)
        instances = [view.assignment.instances[k] for k in found.instances.tolist()]
        rows = [i.distribution for i in instances]
        detected = np.array(rows, np.float32).reshape(-1, self.labels.classes)
        matched = self._associate(view, found, detected.astype(float))
        fresh = matched.assigned < 0
        objects = np.append(matched.ids, -1)[matched.assigned]
        objects[fresh] = self.points.new_ids(int(fresh.sum()))
        objects = self._revise(matched, found, objects)
        scores = np.array([i.mask_score for i in instances], np.float32)
        centres = transform(view.T_world_camera, _means(found.points_camera, found.owners))
        cells = viewpoint_cells(centres, view.T_world_camera[:3, 3])
        self.labels.update(objects, detected, scores, cells)
        self._miss(matched, view, objects)
        self.points.cover(matched.shown, np.append(objects, -1)[matched.covering], objects)
        sightings = Sightings(view.keyframe_id, view.timestamp_s, objects)
        self.points.add(sightings, found.points_camera, objects[found.owners])
        self.points.thin(self.config.max_points)
        return np.append(objects, -1)[found.number[:-1]]

    def place_landmarks(self, landmark_ids: Ints, object_ids: Ints) -> None:
        """Record that landmarks (N,) lie on objects (N,)."""
        self.points.place_landmarks(landmark_ids, object_ids)

    def objects(self, poses: dict[int, Array], ground: Ground) -> list[MapObject]:
        """The current objects by id, from the keyframes whose poses are given."""
        return self._publisher.objects(poses, ground)

    def landmark_evidence(
        self, poses: dict[int, Array], ground: Ground
    ) -> tuple[Ints, Ints, Array]:
        """Landmarks (N,) on objects, each one's class (N,), and log P(size and place | class)."""
        return self._publisher.landmark_evidence(poses, ground)

    def state(self) -> Arrays:
        """The object map as named arrays."""
        return {
            "merging": self._merging.state().ravel(),
            "splitting": self._splitting.state().ravel(),
            **nested(labels=self.labels.state(), points=self.points.state()),
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        self._merging.restore(state["merging"].reshape(-1, 3))
        self._splitting.restore(state["splitting"].reshape(-1, 3))
        self.labels.restore(part(state, "labels"))
        self.points.restore(part(state, "points"))

    def _associate(self, view: KeyframeView, found: Detections, detected: Array) -> _Association:
        """Assign the detections of a view to the objects in its image."""
        config = self.config.association
        all_owners, points_world = self.points.in_world(view.poses)
        all_points = transform(inverse(view.T_world_camera), points_world)
        inside, pixels = self._inside(all_points)
        owners, points = all_owners[inside], all_points[inside]
        ids, columns = numbered(owners)
        reach_m = config.reach_m(found.points_camera[:, 2])
        hit = points_on_objects(found.points_camera, points, columns, reach_m)
        sizes = np.bincount(found.owners, minlength=len(found))
        on = hit >= 0
        of_detection = shares(found.owners[on], hit[on], sizes, (len(found), len(ids)))
        detections, visible = self._covering(view, found, points, pixels)
        in_view = np.bincount(columns[visible], minlength=len(ids))
        covered = detections >= 0
        pairs = columns[covered], detections[covered]
        of_object = shares(*pairs, in_view, (len(ids), len(found))).T
        overlap = Overlap(of_detection, of_object, in_view)
        unseen_s = np.maximum(view.timestamp_s - self.points.last_seen_s(ids), 0.0)
        evidence = Evidence(detected, self._known(ids), unseen_s)
        assigned = assign(overlap, evidence, config)
        rows = self.points.rows(view.poses)
        everything = rows, all_owners, all_points
        shown = rows[inside[visible]], detections[visible]
        return _Association(ids, evidence.known, overlap, assigned, *everything, *shown)

    def _known(self, ids: Ints) -> Array:
        """The classes (O, C) that objects look like, to be told apart by.

        With a measured model, given that they are of some class: that two things are both uncertain
        does not make them alike.
        """
        p = self.labels.appearance(ids)
        if self.labels.model is not None:
            p[:, 0] = 0.0
            p = p / p.sum(axis=1, keepdims=True)
        return p

    def _inside(self, points: Array) -> tuple[Ints, Ints]:
        """Indices (M,) of camera-frame points (N, 3) in the image, and their pixels (M, 2)."""
        rows = np.flatnonzero(points[:, 2] > 0.05)
        if not len(rows):
            return rows, np.zeros((0, 2), np.int64)
        whole = np.rint(self.camera.project_distorted(points[rows])).astype(np.int64)
        size = np.array([self.camera.width, self.camera.height])
        good = ((whole >= 0) & (whole < size)).all(axis=1)
        return rows[good], whole[good]

    def _covering(
        self, view: KeyframeView, found: Detections, points: Array, pixels: Ints
    ) -> tuple[Ints, Mask]:
        """The detection (N,) that covers each object point, -1 for none; which are visible (N,)."""
        step = step_of(self.camera.height, view.depth_m.shape[0])
        limits = np.array(view.depth_m.shape) - 1
        rows, columns = np.minimum(pixels[:, ::-1] // step, limits).T
        depth_m = view.depth_m[rows, columns].astype(float)
        reach_m = self.config.association.reach_m(points[:, 2])
        visible = np.abs(points[:, 2] - depth_m) <= reach_m
        owners = view.assignment.owner[pixels[:, 1], pixels[:, 0]].astype(np.int64)
        detections = found.number[np.where(visible, owners, NO_INSTANCE)]
        return detections, visible

    def _miss(self, matched: _Association, view: KeyframeView, detected: Ints) -> None:
        """Count what the keyframe shows and no detection is on, by the recall to expect there."""
        if self.labels.model is None or not len(matched.ids):
            return
        overlap, config = matched.overlap, self.config
        counts = np.array([np.count_nonzero(matched.owners == i) for i in matched.ids.tolist()])
        missed = overlap.in_view >= config.shown * counts
        missed &= overlap.of_object.max(axis=0, initial=0.0) < config.on
        missed &= ~np.isin(matched.ids, detected)
        ids = matched.ids[missed]
        own = np.isin(matched.owners, ids)
        centres = _means(matched.points_camera[own], np.searchsorted(ids, matched.owners[own]))
        expected = self.labels.model.group_recall(centres[:, 2], self.camera.fx, self.camera.width)
        T = view.T_world_camera
        cells = viewpoint_cells(transform(T, centres), T[:3, 3])
        self.labels.miss(ids, expected.astype(np.float32), cells)

    def _revise(self, matched: _Association, found: Detections, objects: Ints) -> Ints:
        """Merge and split objects with enough evidence; the objects (D,) of the detections then."""
        ids, revision = matched.ids, self.config.revision
        for o, step in splits(matched.overlap, revision):
            key = int(ids[o]), int(ids[o])
            self._splitting.add(key, step)
            if self._splitting.decided(key):
                self._split(key[0], o, matched, found, objects)
        merged: set[int] = set()
        for a, b, step in merges(matched.overlap, matched.assigned, matched.known, revision):
            kept, other = int(ids[a]), int(ids[b])
            self._merging.add((kept, other), step)
            if self._merging.decided((kept, other)) and not merged & {kept, other}:
                self.merge(kept, other)
                merged.add(other)
                objects = np.where(objects == other, kept, objects)
        return objects

    def merge(self, kept: int, removed: int) -> None:
        """Merge an object into another."""
        self.points.merge(kept, removed)
        self.labels.move(np.array([removed]), np.array([kept]))
        for evidence in (self._merging, self._splitting):
            evidence.drop(removed)

    def join(self, poses: dict[int, Array], first: int, end: int) -> int:
        """Merge objects of ids from ``first`` to ``end`` into older ones that are where they are.

        As detections are assigned to objects, those of another map are to those of this one.
        ``poses`` are of all keyframes, by id. Returns how many were merged.
        """
        owners, points = self.points.in_world(poses)
        old, new = owners < first, (owners >= first) & (owners < end)
        (ids, columns), (others, rows) = (
            np.unique(owners[k], return_inverse=True) for k in (old, new)
        )
        config = self.config.association
        overlap = Overlap.of_points((points[new], rows), (points[old], columns), config)
        evidence = Evidence(self._known(others), self._known(ids), np.zeros(len(ids)))
        same = assign(overlap, evidence, config)
        for other, kept in zip(others[same >= 0], ids[same[same >= 0]], strict=True):
            self.merge(int(kept), int(other))
        return int((same >= 0).sum())

    def _split(
        self, split: int, o: int, matched: _Association, found: Detections, objects: Ints
    ) -> None:
        """Reassign the points of an object to the nearest of the detections that share it."""
        revision = self.config.revision
        rows = np.flatnonzero(matched.owners == split)
        distance_m, nearest = KDTree(found.points_camera).query(matched.points_camera[rows])
        of_detection = np.where(distance_m <= revision.reach_m, found.owners[nearest], -1)
        for d in np.flatnonzero(matched.overlap.of_object[:, o] >= revision.part).tolist():
            if objects[d] != split:
                self.points.reassign(matched.rows[rows[of_detection == d]], int(objects[d]))
        self._splitting.drop(split)


def _means(points: Array, groups: Ints) -> Array:
    """The mean (G, 3) of the points (N, 3) of each group 0, 1, ... (N,)."""
    sums = np.zeros((int(groups.max(initial=-1)) + 1, 3))
    np.add.at(sums, groups, points)
    return np.asarray(sums / np.bincount(groups, minlength=len(sums))[:, None])


def pixel_rays(camera: Camera, step: int) -> Array:
    """Camera-frame points (h, w, 3) at a depth of 1 m of every step-th recorded pixel."""
    columns, rows = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    return camera.backproject(camera.undistort(pixels), np.ones(len(pixels))).reshape(
        *columns.shape, 3
    )
