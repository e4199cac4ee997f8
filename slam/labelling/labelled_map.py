"""What the map knows of classes: labels of landmarks, and objects, from masks at any time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, distinct
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.labelling.awaited_masks import DEPTH_STEP, AwaitingKeyframe, AwaitingKeyframes
from bmask_slam.labelling.config import SemanticsConfig, above
from bmask_slam.labelling.label_views import FIRST_LABEL_VIEW, LabelView, LabelViews, described
from bmask_slam.labelling.landmark_visibility import Observed, observed_by
from bmask_slam.labelling.landmark_votes import LabelVotes
from bmask_slam.labelling.results import (
    Attachment,
    LandmarkLabels,
    MapObjects,
    PlacedInstances,
)
from bmask_slam.moving.keyframe_masks import KeyframeMasks
from bmask_slam.semantics.beliefs.class_sizes import read_sizes
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import observation_model
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels
from bmask_slam.semantics.beliefs.surface_geometry import Ground
from bmask_slam.semantics.beliefs.surface_store import SurfaceStore
from bmask_slam.semantics.beliefs.votes import vote
from bmask_slam.semantics.instances.instances import Instance, check_instances
from bmask_slam.semantics.instances.surfaces import surfaces_of, up_of
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.gravity import GravityEstimator
from bmask_slam.semantics.objects.object_map import KeyframeView, ObjectMap, pixel_rays
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_editor import MapReader

logger = logging.getLogger(__name__)


class LabelledMap:
    """Labels and objects of the map, from masks of keyframes and label views, also late ones.

    It reads the map and does not change it; what masks say about motion is passed to ``on_masks``.
    """

    _done: set[int]
    _waiting: AwaitingKeyframes

    def __init__(
        self,
        camera: Camera,
        config: SemanticsConfig,
        map_reader: MapReader,
        names: tuple[LabelSet, str],
        on_masks: Callable[[KeyframeMasks], None] | None = None,
    ) -> None:
        """No labels yet: ``names`` are the classes of masks, and the name of what is known of the
        masks' errors.
        """
        self._map, self._on_masks = map_reader, on_masks
        self.camera, self.config = camera, config
        self._size = camera.height, camera.width
        self._rays = pixel_rays(camera, DEPTH_STEP)
        self._begin(*names)

    @property
    def enabled(self) -> bool:
        """Whether there is more than the label "unknown"."""
        return len(self.names) > 1

    def await_masks(self, keyframe: Keyframe, depth_m: Floats) -> None:
        """Keep the ``kept_depth`` of a keyframe until its masks arrive."""
        self._waiting.add(keyframe.id, AwaitingKeyframe(keyframe.timestamp_s, depth_m))
        self._gravity.add(keyframe.id, depth_m, self._rays)

    def await_view(self, view: LabelView) -> None:
        """Keep a label view, and its depth until its masks arrive."""
        self._map.world.label_views = view.number - FIRST_LABEL_VIEW + 1
        self._label_views.add(view)
        self._waiting.add(view.number, AwaitingKeyframe(view.timestamp_s, view.depth_m))
        self._done = {n for n in self._done if n < FIRST_LABEL_VIEW or n in self._label_views}

    def attach(self, keyframe_id: int, instances: Sequence[Instance]) -> Attachment:
        """Use the masks of a keyframe or label view, at any time after it was made, once.

        What they tell about all pixels (``Segmented``) is used as well. Landmarks that were fused
        since are replaced by their successors; a culled keyframe's masks still label its landmarks.

        Raises:
            InputError: masks of another size or with labels that are not in the label set.
        """
        check_instances(instances, self._size, self.names, described(keyframe_id))
        observed = observed_by(keyframe_id, self._map, self._label_views)
        done = keyframe_id in self._done
        if observed is None or done:
            refused = "it has its masks already" if done else "it is not in the map"
            logger.info("masks of %s are not used: %s", described(keyframe_id), refused)
            return Attachment(keyframe_id, len(instances), refused=refused)
        self._done.add(keyframe_id)
        self._gravity.use_side(up_of(instances))
        waiting = self._waiting.take(keyframe_id, self._rays.shape[:2])
        least, least_of_objects = self.config.least_scores(self.labels.model is not None)
        voting, config = above(instances, least), self.config.votes
        everything = assign_pixels(voting, waiting.depth_m, self._size, config, in_boxes=True)
        voted = self._label_votes.vote(keyframe_id, everything, observed, surfaces_of(instances))
        if self.config.objects.enabled and np.isfinite(waiting.timestamp_s):
            found = self._placed(above(instances, least_of_objects), waiting.depth_m, observed)
            self._add_objects(keyframe_id, waiting, found, observed)
        if self._on_masks is not None:
            sure = above(instances, self.config.sure_score)
            placed = self._placed(sure, waiting.depth_m, observed)
            self._on_masks(self._evidence_of_motion(keyframe_id, waiting, placed, observed))
        return Attachment(keyframe_id, len(instances), voted)

    def follow_map(self) -> None:
        """Keep up with what became of landmarks and keyframes.

        The labels of fused landmarks go to their successors, those of culled ones are dropped;
        points of objects relative to a culled keyframe are moved to its parent.
        """
        landmarks, keyframes = self._map.world.landmarks, self._map.world.keyframes
        points = self.objects.points.landmarks()
        known = distinct(np.concatenate([self.labels.known(), points, self.surfaces.known()]))
        removed = known[~landmarks.in_map[known]]
        if len(removed):
            parents = landmarks.current(removed)
            kept = landmarks.in_map[parents]
            for store in (self.labels, self.surfaces):
                store.move(removed[kept], parents[kept])
                store.drop(removed[~kept])
            self.objects.points.rename_landmarks(removed, np.where(kept, parents, -1))
        for keyframe_id in self.objects.points.anchors():
            if keyframe_id not in keyframes:
                self.objects.points.reanchor(keyframe_id, *self._map.history.parent(keyframe_id))
        self._gravity.keep(keyframes.keys() | self._waiting.keys())

    def landmark_labels(self, ids: Ints, keyframes: Sequence[Keyframe]) -> LandmarkLabels | None:
        """The labels of landmarks (N,) of the segment of these keyframes; None without a segmenter.

        The size and place of its object count for a landmark too.
        """
        if not self.enabled:
            return None
        poses, ground = self._posed(keyframes)
        self.labels.judge(*self.objects.landmark_evidence(poses, ground))
        surfaces = self._label_votes.surfaces(ids, poses, ground.up_world, self.names)
        return LandmarkLabels(self.names, self.labels.estimates(ids), surfaces)

    def map_objects(self, keyframes: Sequence[Keyframe]) -> MapObjects:
        """The objects that these keyframes, all of one map segment, saw."""
        poses, ground = self._posed(keyframes)
        points = self._map.world.landmarks.points_world
        found = [o.with_landmarks_at(points) for o in self.objects.objects(poses, ground)]
        return MapObjects(self.names, found, ground.up_world, ground.floor_m)

    def _posed(self, keyframes: Sequence[Keyframe]) -> tuple[dict[int, Array], Ground]:
        """The poses of keyframes by their ids, and the ground that they saw."""
        poses = {k.id: k.T_world_camera for k in keyframes}
        up_world = self._gravity.up_world(poses)
        return poses, Ground(up_world, self._gravity.floor_m(poses, up_world))

    def state(self) -> Arrays:
        """All labels and objects, as named arrays."""
        return {
            "names": np.array(self.names.names),
            "measured": np.array([self._measured]),
            "done": np.array(sorted(self._done), np.int64),
            **self._waiting.state(),
            **nested(
                labels=self.labels.state(),
                votes=self._label_votes.state(),
                views=self._label_views.state(),
                objects=self.objects.state(),
                upright=self._gravity.state(),
                surfaces=self.surfaces.state(),
            ),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        """Go on from a state.

        Raises:
            InputError: it was learned with another label set.
        """
        names = LabelSet(tuple(state["names"].tolist()))
        if len(names) > 1 and self.enabled and names != self.names:
            raise InputError(
                f"{path}: its landmarks have {len(names) - 1} labels that are not the segmenter's "
                f"{len(self.names) - 1}; take the segmenter that it was made with, or none"
            )
        if len(names) == 1:
            return  # nothing was learned
        self._begin(names, str(state.get("measured", np.array([""]))[0]))
        self.labels.restore(part(state, "labels"))
        self.objects.restore(part(state, "objects"))
        self._gravity.restore(part(state, "upright"))
        self.surfaces.restore(part(state, "surfaces"))
        if votes := part(state, "votes"):
            self._label_votes.restore(votes)
        if views := part(state, "views"):
            self._label_views.restore(views)
        self._done = set(state["done"].tolist())
        self._waiting.restore(state)

    def begin_session(self) -> None:
        """Another recording begins: masks of earlier keyframes are not awaited."""
        self._waiting = AwaitingKeyframes()

    def _begin(self, names: LabelSet, measured: str) -> None:
        """Begin with empty stores; ``measured`` names what is known of the masks' errors."""
        self.names, self._measured = names, measured
        model = observation_model(measured, names)
        self.labels = LabelStore(len(names), self.config.labels, model)
        self.surfaces = SurfaceStore()
        self._label_views = LabelViews()
        stores = self.labels, self.surfaces, self._label_views
        self._label_votes = LabelVotes(self.camera, self.config.votes, self._map, *stores)
        of_objects = LabelStore(len(names), self.config.labels, model, of_objects=True)
        sizes = read_sizes(names)
        self.objects = ObjectMap(self.camera, of_objects, self.config.objects, sizes)
        self._gravity = GravityEstimator(self.camera.up)
        self._done, self._waiting = set(), AwaitingKeyframes()

    def _placed(
        self, instances: Sequence[Instance], depth_m: Floats, observed: Observed
    ) -> PlacedInstances:
        config = self.config.votes
        assignment = assign_pixels(instances, depth_m, self._size, config)
        visible = observed.located(self._map.world)
        votes = vote(assignment, visible.pixels, visible.z_m, len(self.names), config)
        rows, on = votes.rows[votes.sure], votes.instances[votes.sure]
        return PlacedInstances(assignment, observed.landmark_ids[rows], on)

    def _evidence_of_motion(
        self,
        keyframe_id: int,
        waiting: AwaitingKeyframe,
        placed: PlacedInstances,
        observed: Observed,
    ) -> KeyframeMasks:
        return KeyframeMasks(
            keyframe_id=keyframe_id,
            timestamp_s=waiting.timestamp_s,
            anchor_id=observed.anchor.id,
            T_anchor_camera=observed.T_anchor_camera,
            names=self.names,
            assignment=placed.assignment,
            depth_m=waiting.depth_m,
            T_world_camera=observed.T_world_camera,
            landmark_ids=placed.landmark_ids,
            instances=placed.instances,
            label_distributions=self.labels.appearance(placed.landmark_ids),
        )

    def _add_objects(
        self,
        keyframe_id: int,
        waiting: AwaitingKeyframe,
        placed: PlacedInstances,
        observed: Observed,
    ) -> None:
        """Fuse a keyframe's instances into objects, and place its landmarks on them."""
        here = self._map.world.in_segment(observed.anchor.segment)
        T_world_camera = observed.T_world_camera
        view = KeyframeView(
            keyframe_id=keyframe_id,
            timestamp_s=waiting.timestamp_s,
            T_world_camera=T_world_camera,
            depth_m=waiting.depth_m,
            rays=self._rays,
            assignment=placed.assignment,
            poses={k.id: k.T_world_camera for k in here} | {keyframe_id: T_world_camera},
        )
        objects = self.objects.add(view)
        if keyframe_id != observed.anchor.id:
            self.objects.points.reanchor(keyframe_id, observed.anchor.id, observed.T_anchor_camera)
        on = np.append(objects, -1)[placed.instances]
        self.objects.place_landmarks(placed.landmark_ids[on >= 0], on[on >= 0])
