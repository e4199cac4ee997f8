"""The objects of a map: what detections in many keyframes have in common."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import KDTree

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.semantics.beliefs.label_store import LabelStore, LabelStoreConfig
from bmask_slam.semantics.beliefs.votes import NOBODY, PixelAssignment
from bmask_slam.semantics.objects.association import (
    AssociationConfig,
    Evidence,
    Overlap,
    assign,
    points_on_objects,
    shares,
)
from bmask_slam.semantics.objects.boxes3d import OrientedBox, box_around, supported, without_noise
from bmask_slam.semantics.objects.detections import DetectionConfig, Detections, detect
from bmask_slam.semantics.objects.points import ObjectPoints
from bmask_slam.semantics.objects.revision import MergeEvidence, RevisionConfig, merges, splits


@dataclass(frozen=True)
class ObjectConfig:
    """How objects are made of detections.

    An object of fewer than ``min_keyframes`` is not told of; one keeps ``max_points`` points. In
    its box are those that have ``neighbours`` others within ``support_m``; each side is moved in
    by a sigma of the depth, but not beyond the share ``trim`` of the points.
    """

    enabled: bool = True
    min_keyframes: int = 2
    max_points: int = 2000
    neighbours: int = 2
    support_m: float = 0.03
    trim: float = 0.02
    detections: DetectionConfig = field(default_factory=DetectionConfig)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    revision: RevisionConfig = field(default_factory=RevisionConfig)


@dataclass(frozen=True, eq=False)
class KeyframeView:
    """A keyframe whose masks have come.

    Attributes:
        keyframe_id, timestamp_s, T_world_camera: its own.
        depth_m: (h, w) every s-th pixel of its depth image both ways.
        rays: (h, w, 3) what these pixels see at a depth of 1 m.
        claims: who owns its pixels.
        poses: T_world_keyframe of the keyframes of its map segment, by id, itself among them.
    """

    keyframe_id: int
    timestamp_s: float
    T_world_camera: Array
    depth_m: Floats
    rays: Array
    assignment: PixelAssignment
    poses: dict[int, Array]


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a keyframe met.

    Attributes:
        ids: (O,) the objects in its image; known: (O, C) their class distributions before.
        overlap: of its detections with them; assigned: (D,) the object's number or -1.
        rows, owners, points_camera: (N,), (N,), (N, 3) all points of its map segment: their rows
            in the table, objects, and place in its frame.
    """

    ids: Ints
    known: Array
    overlap: Overlap
    assigned: Ints
    rows: Ints
    owners: Ints
    points_camera: Array


@dataclass(frozen=True, eq=False)
class MapObject:
    """One object.

    Attributes:
        id: its number, never used twice.
        label: its likeliest class; distribution: (C,) over all.
        centroid_world: (3,) m, mean of its points but lone ones. box: around them.
        keyframe_ids: that saw it. landmark_ids: on it.
        first_seen_s, last_seen_s: stamps.
    """

    id: int
    label: int
    distribution: Array
    centroid_world: Array
    box: OrientedBox
    keyframe_ids: Ints
    landmark_ids: Ints
    first_seen_s: float
    last_seen_s: float


class ObjectMap:
    """Objects by id. Their points lie in the frames of the keyframes that saw them, and so move
    with the graph.
    """

    def __init__(
        self, camera: Camera, classes: int, config: ObjectConfig, labels: LabelStoreConfig
    ) -> None:
        self.camera = camera
        self.config = config
        self.labels = LabelStore(classes, labels)
        self.points = ObjectPoints()
        self._merging = MergeEvidence(config.revision)
        self._splitting = MergeEvidence(config.revision)

    def add(self, view: KeyframeView) -> Ints:
        """Take a keyframe's instances in; returns the object (K,) of each, -1 for none."""
        found = detect(view.assignment, view.depth_m, view.rays, self.config.detections)
        instances = [view.assignment.instances[k] for k in found.instances.tolist()]
        rows = [i.distribution for i in instances]
        detected = np.array(rows, np.float32).reshape(-1, self.labels.classes)
        seen = self._associate(view, found, detected.astype(float))
        fresh = seen.assigned < 0
        objects = np.append(seen.ids, -1)[seen.assigned]
        objects[fresh] = self.points.new_ids(int(fresh.sum()))
        objects = self._revise(seen, found, objects)
        scores = np.array([i.mask_score for i in instances], np.float32)
        self.labels.update(objects, detected, scores)
        key = view.keyframe_id, view.timestamp_s
        self.points.add(key, objects, found.points_camera, objects[found.owners])
        self.points.thin(self.config.max_points)
        return np.append(objects, -1)[found.number[:-1]]

    def place_landmarks(self, landmark_ids: Ints, object_ids: Ints) -> None:
        """Landmarks (N,) lie on objects (N,)."""
        self.points.place_landmarks(landmark_ids, object_ids)

    def objects(self, poses: dict[int, Array], up_world: Array) -> list[MapObject]:
        """The objects as they are now, by id, of those keyframes whose poses are given."""
        owners, points = self.points.in_world(poses)
        noise = self.config.association.depth_sigma_m * self.points.rays_in_world(poses)
        found = []
        for i in np.unique(owners).tolist():
            keyframe_ids, stamps_s = self.points.sightings(i)
            if len(keyframe_ids) < self.config.min_keyframes:
                continue
            distribution = self.labels.probabilities(np.array([i]))[0]
            mine = points[owners == i]
            near = supported(mine, self.config.neighbours, self.config.support_m)
            mine = mine[near]
            inner = without_noise(mine, noise[owners == i][near], up_world, self.config.trim)
            box = box_around(inner, up_world)
            label, landmarks = int(distribution.argmax()), self.points.landmarks_of(i)
            seen_s = float(stamps_s.min()), float(stamps_s.max())
            shape, by_whom = (mine.mean(axis=0), box), (keyframe_ids, landmarks)
            found.append(MapObject(i, label, distribution, *shape, *by_whom, *seen_s))
        return found

    def state(self) -> Arrays:
        """All objects as named arrays."""
        return {
            "merging": self._merging.state().ravel(),
            "splitting": self._splitting.state().ravel(),
            **nested(labels=self.labels.state(), points=self.points.state()),
        }

    def restore(self, state: Arrays) -> None:
        """Become the objects of a state."""
        self._merging.restore(state["merging"].reshape(-1, 3))
        self._splitting.restore(state["splitting"].reshape(-1, 3))
        self.labels.restore(part(state, "labels"))
        self.points.restore(part(state, "points"))

    def _associate(self, view: KeyframeView, found: Detections, detected: Array) -> _Seen:
        """The objects that may be in a view, and which detection is which."""
        config = self.config.association
        all_owners, points_world = self.points.in_world(view.poses)
        all_points = transform(inverse(view.T_world_camera), points_world)
        inside, pixels = self._inside(all_points)
        owners, points = all_owners[inside], all_points[inside]
        ids, columns = np.unique(owners, return_inverse=True)
        hit = points_on_objects(found.points_camera, points, columns, config)
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
        evidence = Evidence(detected, self.labels.probabilities(ids), unseen_s)
        assigned = assign(overlap, evidence, config)
        rows = self.points.rows(view.poses)
        return _Seen(ids, evidence.known, overlap, assigned, rows, all_owners, all_points)

    def _inside(self, points: Array) -> tuple[Ints, Ints]:
        """Which points (N, 3) of the camera frame are in the image, and their pixels (M, 2)."""
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
        step = self.camera.height // view.depth_m.shape[0]
        limits = np.array(view.depth_m.shape) - 1
        rows, columns = np.minimum(pixels[:, ::-1] // step, limits).T
        depth_m = view.depth_m[rows, columns].astype(float)
        reach_m = self.config.association.reach_m(points[:, 2])
        visible = np.abs(points[:, 2] - depth_m) <= reach_m
        owners = view.assignment.owner[pixels[:, 1], pixels[:, 0]].astype(np.int64)
        detections = found.number[np.where(visible, owners, NOBODY)]
        return detections, visible

    def _revise(self, seen: _Seen, found: Detections, objects: Ints) -> Ints:
        """Merge and split what a keyframe tips; returns the objects (D,) of its detections then."""
        ids, revision = seen.ids, self.config.revision
        for o, step in splits(seen.overlap, revision):
            key = int(ids[o]), int(ids[o])
            self._splitting.speak(key, step)
            if self._splitting.decided(key):
                self._split(key[0], o, seen, found, objects)
        gone: set[int] = set()
        for a, b, step in merges(seen.overlap, seen.assigned, seen.known, revision):
            kept, other = int(ids[a]), int(ids[b])
            self._merging.speak((kept, other), step)
            if self._merging.decided((kept, other)) and not gone & {kept, other}:
                self.merge(kept, other)
                gone.add(other)
                objects = np.where(objects == other, kept, objects)
        return objects

    def merge(self, kept: int, gone: int) -> None:
        """Two objects are one."""
        self.points.merge(kept, gone)
        self.labels.move(np.array([gone]), np.array([kept]))
        for balance in (self._merging, self._splitting):
            balance.forget(gone)

    def _split(self, split: int, o: int, seen: _Seen, found: Detections, objects: Ints) -> None:
        """Detections that share an object take the points that are nearest to them along."""
        revision = self.config.revision
        rows = np.flatnonzero(seen.owners == split)
        distance_m, nearest = KDTree(found.points_camera).query(seen.points_camera[rows])
        of_detection = np.where(distance_m <= revision.reach_m, found.owners[nearest], -1)
        for d in np.flatnonzero(seen.overlap.of_object[:, o] >= revision.part).tolist():
            if objects[d] != split:
                self.points.give(seen.rows[rows[of_detection == d]], int(objects[d]))
        self._splitting.forget(split)


def pixel_rays(camera: Camera, step: int) -> Array:
    """(h, w, 3) what every step-th pixel both ways of an image, as recorded, sees at 1 m."""
    columns, rows = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    return camera.backproject(camera.undistort(pixels), np.ones(len(pixels))).reshape(
        *columns.shape, 3
    )
