"""The owner of map and graph: keyframes go in, the graph is optimised, segments are joined."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.factor_selection import FactorSelector, read_back
from bmask_slam.back_end.landmark_management import (
    create_landmarks,
    cull_landmarks,
    fuse_into_neighbours,
    fuse_loops,
    redundant_keyframe,
    remove_redundant,
    restore_observations,
)
from bmask_slam.back_end.map_backend import add_keyframe
from bmask_slam.back_end.marker_loops import close_marker_loops, unite_markers
from bmask_slam.back_end.pruning import MapPruner
from bmask_slam.back_end.segment_joining import anchors, join_segment
from bmask_slam.back_end.triangulation import triangulate_landmarks
from bmask_slam.events import Ends, EventLog
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Arrays, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import LOOP
from bmask_slam.graph.factors.own_factors import Numbered, checked_own_factors
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.loops.closing import LoopCloser
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.sensing.marker_sightings import only_witnesses
from bmask_slam.sensing.sensor_fusion import SensorFusion
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.results import Tracked
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.appearance import Patches
from bmask_slam.world.covisibility import MIN_SHARED
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_state import world_of, world_state
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)


class Mapper:
    """Holds map, graph and frame history in this process, and keeps the three consistent.

    Attributes:
        world: keyframes and landmarks. history: of all tracked frames. smoother: the graph.
        loops: finds loops, and holds closed ones. events: of this system.
        sensors: makes factors of other sensors. update_ms: wall time of every graph update.
    """

    def __init__(self, camera: Camera, tracker: Tracker, config: BackEndConfig):
        self.camera = camera
        self.world = WorldMap()
        self.history = FrameHistory()
        self.smoother = Smoother(camera, config.graph)
        self.events = EventLog()
        self.loops = LoopCloser(camera, config.loops, self.events)
        self.sensors = SensorFusion(config.sensors, self.events)
        self.update_ms: list[float] = []
        self._tracker, self._mapping, self._graph_config = tracker, config.mapping, config.graph
        selection = config.factor_selection, camera.graph_depth_factor, config.graph
        self._factor_selector = FactorSelector(*selection)

    @property
    def places(self) -> DescriptorIndex:
        """The index that finds keyframes similar to a frame."""
        return self.loops.index

    idle = accepts_keyframes = True
    """Whether it waits for work, and will work on a keyframe: updates end before the next frame."""
    landmarks_ahead = np.zeros(0, np.int64)

    def state(self) -> Arrays:
        """Map, history and graph as named arrays."""
        return {
            "update_ms": np.array(self.update_ms, float),
            **nested(
                world=world_state(self.world),
                history=self.history.state(),
                graph=self.smoother.state(),
                feed=self._factor_selector.state(),
                loops=self.loops.state(),
                events=self.events.state(),
                sensors=self.sensors.state(),
            ),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        """Restore a state that was read from a file. Raises InputError."""
        self.update_ms = state["update_ms"].tolist()
        self.world = world_of(part(state, "world"))
        self.history.restore(part(state, "history"))
        self.smoother.restore(part(state, "graph"), path)
        self._factor_selector.restore(part(state, "feed"))
        self.loops.restore(part(state, "loops"), self.world)
        self.events.restore(part(state, "events"))
        self.sensors.restore(part(state, "sensors"))

    def restart(self) -> None:
        """Rebuild what a state cannot hold (ISAM2, index), as a restored mapper does."""
        self.smoother.restart()
        self.loops.index.rebuild()

    def begin_session(self) -> None:
        """Clear the frame history, the events and the times; map and graph stay."""
        self.history, self.update_ms = FrameHistory(), []
        self.events.begin_session()
        self.sensors.begin_session(self.world.next_keyframe_id)

    def insert(self, frame: Frame, tracked: Tracked, segment: int, local_ids: Ints) -> Keyframe:
        """Make a tracked frame a keyframe: landmarks are made, fused and culled."""
        world = self.world
        keyframe = add_keyframe(world, frame, tracked, segment)
        world.attach(keyframe, tracked.keypoints, tracked.landmark_ids)
        new_ids = create_landmarks(world, keyframe, self.camera, tracked.new_ids)
        fused = fuse_into_neighbours(world, keyframe, new_ids, self._tracker, self._mapping)
        triangulate_landmarks(world, keyframe, self.camera, self._mapping.triangulation)
        world.renew_patches(keyframe, self._tracker.config.subpixel)
        world.store_features(keyframe)
        self._factor_selector.remove_landmarks(fused)
        self._factor_selector.remove_landmarks(cull_landmarks(world, local_ids, self._mapping))
        self.loops.add(keyframe)
        world.release_memory()
        return keyframe

    def optimise(self, keyframe: Keyframe) -> None:
        """Put a keyframe into the graph, read all poses and points back, cull a redundant one."""
        update = self._factor_selector.keyframe_update(self.world, keyframe)
        self._apply(self.smoother.update(self.sensors.changes(self).added_to(update)))
        self._cull_keyframe(keyframe)

    def close_loops(self, keyframe: Keyframe) -> list[LoopConstraint]:
        """Close a keyframe's loops that are confirmed; those that do not fit wait for more."""
        close_marker_loops(self)
        confirmed = self.loops.loops_of(keyframe, self.world)
        return self.close(confirmed) if confirmed else []

    def close(self, confirmed: list[LoopConstraint]) -> list[LoopConstraint]:
        """Close loops that confirm each other; returns those that fit the graph."""
        added = self.loops.relative_poses(confirmed, self.world)
        self.change_graph(relative_poses=added)
        self.loops.closed |= {pose.keyframe_ids: pose.robust is None for pose in added}
        refuted = self._remove_wrong_loops({loop.ends for loop in confirmed})
        kept = [loop for loop in confirmed if loop.ends not in refuted]
        self.loops.waiting += [loop for loop in confirmed if loop.ends in refuted]
        for loop in kept:
            self.events.loop_closed(loop.ends, loop.inliers)
        if kept:
            self.fuse(kept)
        return kept

    def fuse(self, loops: list[LoopConstraint]) -> None:
        """Fuse the landmarks of both sides of loops, and optimise."""
        count = self.loops.config.fuse_keyframes
        fused = fuse_loops(self.world, loops, self._tracker, self._mapping, count)
        self._factor_selector.remove_landmarks(fused)
        self.change_graph()

    def join(self, segment: int, tracked: Tracked, recognised: Tracked) -> Tracked:
        """Move a segment to where its frame was recognised; returns that as tracked there."""
        inliers = len(recognised.landmark_ids)
        self.events.joined(segment, self.world.segment_of(recognised.landmark_ids), inliers)
        joined = join_segment(self.world, segment, tracked, recognised)
        self.rebuild()
        unite_markers(self)
        return joined

    def rebuild(self) -> None:
        """Build the graph anew from the map, after segments were moved."""
        loops = self.smoother.relative_poses(LOOP) + anchors(self.world, self._graph_config)
        old = self.smoother.tables
        self.smoother = Smoother(self.camera, self._graph_config)
        self.smoother.tables.next_own, own = old.next_own, tuple(old.own_factors.items())
        update = self._factor_selector.whole_update(self.world)
        update = replace(update, relative_poses=loops, own_factors=own)
        update = self.sensors.carry_over(old, self.smoother.tables, self.world).added_to(update)
        self._apply(self.smoother.update(update))
        self.add_waiting_measurements()

    def pruner(self) -> MapPruner:
        """The pruner of this map and graph."""
        return MapPruner(self.world, self.smoother, self.camera)

    def prune_mask(self, keyframe_id: int, mask: Mask, widen_px: int) -> None:
        """Remove what a keyframe observes under a mask (H, W), widened by ``widen_px``."""
        report = replace(self.pruner(), border_px=-widen_px).prune_mask(keyframe_id, mask)
        self.events.count(report.counts("mask"))
        logger.info("mask of keyframe %d: %s", keyframe_id, report)

    def prune_landmarks(self, landmark_ids: Ints) -> None:
        """Remove landmarks (N,) from the map, and from the graph with its next update."""
        report = self.pruner().prune_landmarks(landmark_ids)
        self._factor_selector.remove_landmarks(report.landmark_ids)
        self.events.count(report.counts("moving"))
        logger.info("landmarks that move: %s", report)

    def restore_observations(self, keyframe_id: int, keypoints: Ints, patches: Patches) -> None:
        """Keypoints (N,) of a keyframe that were masked observe landmarks again.

        They observe landmarks that the map has by now, or new ones. Either get the image patches
        (N) of what the keypoints observed before, unless they have patches already.
        """
        keyframe = self.world.keyframes.get(keyframe_id)
        if keyframe is not None and len(keypoints):
            given = keypoints, patches, self._tracker, self._mapping
            fused = restore_observations(self.world, keyframe, *given)
            self._factor_selector.remove_landmarks(fused)

    def finish(self) -> None:
        """Full bundle adjustment, again without outliers; the map is then final."""
        if self.world.keyframes:
            self.add_waiting_measurements(last=True)
            close_marker_loops(self)
            self._apply(self.smoother.optimise_batch(drop_outliers=True), timed=False)
            self.sensors.report(self.smoother)

    def add_measurements(self, new: Measurements) -> None:
        """Keep the measurements of a sensor; they become factors with the next update."""
        self.sensors.add(new, self.world)

    def change_own_factors(self, added: Sequence[Numbered], removed: tuple[int, ...]) -> None:
        """Add factors that a user has made and remove others by number. Raises InputError."""
        update = self._factor_selector.map_update(self.world)
        own = checked_own_factors(added, self.smoother.tables)
        update = replace(update, own_factors=own, remove_own_factors=removed)
        self._apply(self.smoother.update(update), timed=False)

    def add_waiting_measurements(self, last: bool = False) -> None:
        """Carry out what waited for the next keyframe; ``last``: there will be none."""
        changes = self.sensors.changes(self, last)
        if changes or (last and self._factor_selector.has_removals):
            update = changes.added_to(self._factor_selector.map_update(self.world))
            self._apply(self.smoother.update(update), timed=False)

    def _apply(self, estimate: GraphEstimate, timed: bool = True) -> None:
        if timed:
            self.update_ms.append(estimate.update_ms)
        self.events.graph(estimate)
        read_back(self.world, estimate)
        self.sensors.follow(self)

    def change_graph(self, **changes: Any) -> None:
        """An update that moves much of the graph: ISAM2 is iterated until it converges."""
        changes["max_iterations"] = self.loops.config.max_iterations
        update = self._factor_selector.map_update(self.world)
        removed = [*update.remove_keyframes.tolist(), *changes.pop("remove_keyframes", ())]
        changes["remove_keyframes"] = np.array(removed, np.int64)
        self._apply(self.smoother.update(replace(update, **changes)))

    def _remove_wrong_loops(self, fresh: set[Ends]) -> set[Ends]:
        """Remove loops until all fit the graph, older ones with what they fused; their ends."""
        removed: set[Ends] = set()
        while True:
            errors = self.smoother.relative_pose_errors(LOOP, self.loops.noise.bent)
            if not (refuted := self.loops.refuted(errors, self.world)):
                return removed
            removed |= refuted
            new = tuple((a, b, LOOP) for a, b in sorted(refuted & fresh))
            for a, b, _ in new:
                self.events.loop_refused((a, b), "it does not fit the graph; waits for more")
            self.events.count({"loops pruned: refuted": len(new)})
            self.change_graph(remove_relative_poses=new)
            for ends in sorted(refuted - fresh):
                self.events.loop_removed(ends)
                self.events.count(self.pruner().prune_loop(*ends).counts("refuted"))
            for ends in refuted:
                self.loops.closed.pop(ends, None)

    def _cull_keyframe(self, newest: Keyframe) -> None:
        """Remove the youngest redundant keyframe around the newest one.

        Landmarks that too few others see are removed with it. Older keyframes are kept, since the
        map would drift if newer views replaced them, and so are those that hold factors.
        """
        _, landmark_ids = self.world.observed(newest)
        tables = self.smoother.tables
        kept = self.loops.ends | {0} | tables.own_keyframes | only_witnesses(tables)
        kept |= tables.marginalised.bases
        near = {k.id: k for _, k in self.world.covisible(landmark_ids, MIN_SHARED)}
        old = [near[i] for i in sorted(near.keys() - kept, reverse=True) if i < newest.id - 2]
        if (redundant := redundant_keyframe(self.world, old, self._mapping)) is None:
            return
        ids = remove_redundant(self.world, self.history, redundant)
        self._factor_selector.remove_keyframe(redundant.id)
        self._factor_selector.remove_landmarks(cull_landmarks(self.world, ids, self._mapping))
        self.loops.remove(redundant.id)
