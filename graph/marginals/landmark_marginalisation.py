"""Marginalisation of old landmarks: relative poses replace their factors in the graph.

A landmark's observations constrain the keyframes relative to each other and, given these, the
landmark. p(poses, points) = p(poses) p(points | poses), and each half is kept once:

- p(poses), made sparse, becomes relative poses of kind MARGINAL (`graph.marginals.sparsification`);
- p(point | poses) becomes the landmark's summary (`graph.marginals.summaries`): one observation in
  one keyframe, with the sigmas that it has when the poses are held.

An update that names a marginalised landmark as new brings it back with its summary, at the place
that this gives. Only observations that the graph never had are added to it; marginalised ones are
refused as DUPLICATE. So nothing is counted twice, and a revisit connects new keyframes to old ones.
Marginalised again, the summary and the new observations become relative poses between them.

The observations themselves are kept. When some are removed later (a landmark, a keyframe, one
observation), their chunk is made sparse again from the rest. `reinsert` puts all of them back in
place of their replacements: the full graph, for a batch optimisation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.graph.arrays import Ints, Mask, distinct
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, ValueTable, ids_array
from bmask_slam.graph.factors.graph_update import (
    MARGINAL,
    GraphUpdate,
    Observations,
    RelativePose,
    concatenate,
)
from bmask_slam.graph.factors.marginalised_landmarks import Chunk, MarginalisedLandmarks
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.marginals.point_elimination import PoseInformation, eliminate_points
from bmask_slam.graph.marginals.sparsification import recover, spanning_tree, with_new_bases
from bmask_slam.graph.marginals.summaries import make_summaries, points_of


@dataclass
class Marginalisation:
    """What ISAM2 must be told.

    Attributes:
        slots: of factors that were removed.
        pose_factors: numbers of relative poses that were added.
    """

    slots: list[int] = field(default_factory=list)
    pose_factors: list[int] = field(default_factory=list)


def marginalise_landmarks(
    ids: Ints, tables: FactorTables, camera: Camera, config: SmootherConfig
) -> Marginalisation:
    """Replace all factors of these landmarks; ids that are not in the graph are ignored."""
    table, marginalised = tables.observations, tables.marginalised
    marginaliser = _Marginaliser(tables, camera, config)
    ids = distinct(ids[tables.landmarks.contains(ids)])
    rows = table.rows_of_landmarks(ids.tolist())
    if not len(rows):
        return marginaliser.done
    observations, points = table.select(rows), ValueTable.of(ids, tables.landmarks.get(ids))
    is_summary = marginalised.are_summaries(observations.keyframe_ids, observations.landmark_ids)
    marginaliser.done.slots = [slot for slot in table.slots(rows).tolist() if slot != NO_SLOT]
    table.remove(rows)
    tables.landmarks.remove(ids)
    for landmark in ids.tolist():
        marginalised.returned.pop(landmark, None)
    for part in _parts(observations, config.marginal_keyframes):
        chunk = Chunk(observations.select(part), is_summary[part])
        marginaliser.add(chunk, marginalised.next_number, points)
    return marginaliser.done


def remove_marginalised(
    update: GraphUpdate, tables: FactorTables, camera: Camera, config: SmootherConfig
) -> Marginalisation:
    """Carry out an update's removals on the marginalised observations and what replaces them."""
    marginalised, marginaliser = tables.marginalised, _Marginaliser(tables, camera, config)
    landmarks, keyframes = update.remove_landmarks, update.remove_keyframes
    pairs = update.remove_observations
    touched = marginalised.chunks_with(
        keyframes.tolist(), [*landmarks.tolist(), *pairs[:, 1].tolist()]
    )
    for number in touched:
        observations = marginalised.chunks[number].observations
        keep = ~np.isin(observations.landmark_ids, landmarks) & ~np.isin(
            observations.keyframe_ids, keyframes
        )
        keep &= tables.keyframes.contains(observations.keyframe_ids)
        for keyframe, landmark in pairs.tolist():
            keep &= (observations.keyframe_ids != keyframe) | (
                observations.landmark_ids != landmark
            )
        if keep.all():
            continue
        culled = np.unique(observations.keyframe_ids[~keep])
        whole = np.array_equal(keep, ~np.isin(observations.keyframe_ids, culled))
        edges = marginaliser.without_leaves(number, culled.tolist()) if whole else None
        marginaliser.renew(number, keep, edges)
    for landmark in landmarks.tolist():
        marginalised.summaries.pop(landmark, None)
        marginalised.returned.pop(landmark, None)
    marginalised.bases.difference_update(keyframes.tolist())
    return marginaliser.done


def reinsert(tables: FactorTables, camera: Camera, config: SmootherConfig) -> None:
    """Put all marginalised observations back in place of their replacements; reset ISAM2 then."""
    marginalised, table = tables.marginalised, tables.observations
    if not marginalised.chunks:
        return
    rows = table.used_rows()
    active = table.select(rows)
    table.remove(rows[marginalised.are_summaries(active.keyframe_ids, active.landmark_ids)])
    tables.remove_pose_factors(
        n for c in marginalised.chunks.values() for n in c.numbers if n in tables.pose_factors
    )
    out = ids_array(marginalised.summaries)
    tables.landmarks.insert(out, points_of(out, tables, camera))
    old = concatenate([c.observations.select(~c.is_summary) for c in marginalised.chunks.values()])
    old = old.select(
        tables.keyframes.contains(old.keyframe_ids) & tables.landmarks.contains(old.landmark_ids)
    )
    table.add(old)
    tables.marginalised = MarginalisedLandmarks()
    observations = table.all()
    values = tables.values_of(observations)
    constrained = constrained_landmarks(observations, *values, config.min_parallax_deg)
    loose = np.setdiff1d(tables.landmarks.ids, constrained)
    table.remove(table.rows_of_landmarks(loose.tolist()))
    tables.landmarks.remove(loose)


@dataclass
class _Marginaliser:
    """Makes chunks sparse; ``done`` collects what ISAM2 must be told."""

    tables: FactorTables
    camera: Camera
    config: SmootherConfig
    done: Marginalisation = field(default_factory=Marginalisation)

    def add(
        self, chunk: Chunk, number: int, points: ValueTable, kept: tuple[int, ...] | None = None
    ) -> None:
        """Make a chunk sparse, keep it, and summarise its landmarks that are out of the graph.

        With ``kept`` relative poses it is sparse already. One that replaces another is made where
        the graph happens to be: after a loop was closed it may be far from its optimum.
        """
        tables, observations = self.tables, chunk.observations
        marginalised = tables.marginalised
        keyframes, ids = np.unique(observations.keyframe_ids), np.unique(observations.landmark_ids)
        poses, left = eliminate_points(
            observations,
            ValueTable.of(keyframes, tables.keyframes.get(keyframes)),
            ValueTable.of(ids, points.get(ids)),
            self.camera,
            self.config,
        )
        if kept is None:
            at_rest = number == marginalised.next_number  # not one that replaces another
            edges = self._tree(poses, observations, at_rest) if len(keyframes) > 1 else []
            kept = tuple(tables.add_pose_factors(edges))
            self.done.pose_factors += kept
        marginalised.add(replace(chunk, numbers=kept), number)
        last = [marginalised.newest_with(j) <= number for j in ids.tolist()]
        out = ~tables.landmarks.contains(ids) & np.array(last, bool)
        summaries = make_summaries(observations, left, tables, self.camera)
        marginalised.summaries.update({int(ids[i]): summaries[i] for i in np.flatnonzero(out)})

    def _tree(
        self, poses: PoseInformation, observations: Observations, at_rest: bool
    ) -> list[RelativePose]:
        """The relative poses that replace these observations; adds keyframes to the bases."""
        marginalised = self.tables.marginalised
        keyframes, row = np.unique(observations.keyframe_ids, return_inverse=True)
        landmarks, column = np.unique(observations.landmark_ids, return_inverse=True)
        sees = np.zeros((len(keyframes), len(landmarks)), np.int64)
        sees[row, column] = 1
        is_base = np.isin(keyframes, sorted(marginalised.bases))
        is_base = with_new_bases(sees @ sees.T, is_base, self.config.base_share)
        marginalised.bases.update(keyframes[is_base].tolist())
        return recover(poses, spanning_tree(poses, is_base), MARGINAL, at_rest)

    def without_leaves(self, number: int, culled: list[int]) -> tuple[int, ...] | None:
        """A chunk's relative poses without those of keyframes that end a branch of its tree.

        They say all that the tree says of the others: a leaf is marginalised by leaving it out.
        None if one of these keyframes connects others.
        """
        factors = self.tables.pose_factors
        numbers = self.tables.marginalised.chunks[number].numbers
        links = {n: factors[n].link for n in numbers if n in factors}
        ends = Counter(k for link in links.values() for k in link)
        if any(ends[k] > 1 for k in culled):
            return None
        return tuple(n for n, link in links.items() if not set(link) & set(culled))

    def renew(self, number: int, keep: Mask, kept: tuple[int, ...] | None = None) -> None:
        """Make a chunk sparse again from those of its observations that stay.

        With ``kept``, of its relative poses those stay.
        """
        tables, done = self.tables, self.done
        marginalised, chunk = tables.marginalised, tables.marginalised.remove(number)
        before = np.unique(chunk.observations.landmark_ids)
        out = np.array([j in marginalised.summaries for j in before.tolist()], bool)
        known = out | tables.landmarks.contains(before)
        ids = before[known & np.isin(before, chunk.observations.landmark_ids[keep])]
        points = ValueTable.of(ids, points_of(ids, tables, self.camera))
        for landmark in np.setdiff1d(before, ids).tolist():
            if marginalised.newest_with(landmark) < number:
                marginalised.summaries.pop(landmark, None)
        keep = keep & np.isin(chunk.observations.landmark_ids, ids)
        stay = set(kept or ()) if keep.any() else set()
        present = [n for n in chunk.numbers if n in tables.pose_factors and n not in stay]
        done.slots += [s for n in present if (s := tables.pose_factors[n].slot) != NO_SLOT]
        done.pose_factors = [n for n in done.pose_factors if n not in present]
        tables.remove_pose_factors(present)
        if keep.any():
            rest = Chunk(chunk.observations.select(keep), chunk.is_summary[keep])
            self.add(rest, number, points, kept)


def _parts(observations: Observations, limit: int) -> Iterator[Ints]:
    """Rows in groups of whole landmarks that at most ``limit`` keyframes observe.

    Groups are halved by their landmarks' newest keyframes; one landmark alone may have more.
    """
    ids, which = np.unique(observations.landmark_ids, return_inverse=True)
    newest = np.full(len(ids), -1, np.int64)
    np.maximum.at(newest, which, observations.keyframe_ids)
    waiting = [np.argsort(newest, kind="stable")]
    while waiting:
        group = waiting.pop()
        rows = np.flatnonzero(np.isin(which, group))
        if len(group) == 1 or len(np.unique(observations.keyframe_ids[rows])) <= limit:
            yield rows
        else:
            waiting += [group[len(group) // 2 :], group[: len(group) // 2]]
