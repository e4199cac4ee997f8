"""Old landmarks leave the graph, and relative poses take over what they said of the keyframes.

A landmark's observations say two things: something of the keyframes relative to each other,
and, given these, where the landmark is. p(poses, points) = p(poses) p(points | poses), and
each half is kept once:

- p(poses), made sparse, becomes relative poses of kind "marginal"
(`graph.marginals.sparsification`);
- p(point | poses) becomes the landmark's summary: one observation in the keyframe that saw it
  last, with the sigmas that it has when the poses are held.

The rule for coming back follows: an update that names a retired landmark as new brings it back
with its summary, at the place where that keyframe carries it. Only observations that the graph
never had are added to it; archived ones are refused as DUPLICATE. So nothing is counted
twice, and a revisit ties the new keyframes to the old ones. Retired again, the summary and the
new observations together become relative poses between new keyframes and old ones.

The observations themselves stay in the archive. When some are removed later (a landmark, a
keyframe, one view), their chunk is made sparse again from the rest. `reinstate` puts all of them
back in place of what stands for them: the full graph, for a batch optimisation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, ids_array
from bmask_slam.graph.factors.graph_update import (
    GraphUpdate,
    Observations,
    RelativePose,
    concatenate,
)
from bmask_slam.graph.factors.marginalised_landmarks import (
    MARGINAL,
    Chunk,
    MarginalisedLandmarks,
    Summary,
)
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.marginals.point_elimination import (
    PointInformation,
    PoseInformation,
    eliminate_points,
    projection_jacobian,
)
from bmask_slam.graph.marginals.sparsification import recover, spanning_tree, with_new_bases


@dataclass
class Marginalisation:
    """Slots in ISAM2 of factors that left the shadow, and numbers of relative poses that came."""

    slots: list[int] = field(default_factory=list)
    pose_factors: list[int] = field(default_factory=list)


def marginalise_landmarks(
    ids: Ints, tables: FactorTables, camera: Camera, config: SmootherConfig
) -> Marginalisation:
    """Replace all factors of these landmarks; ids that the graph does not hold are passed over."""
    table, marginalised, done = tables.observations, tables.marginalised, Marginalisation()
    ids = np.intersect1d(ids, tables.landmarks.ids)
    rows = table.rows_of_landmarks(ids.tolist())
    if not len(rows):
        return done
    seen, points = table.select(rows), tables.landmarks.get(ids)
    is_summary = marginalised.are_summaries(seen.keyframe_ids, seen.landmark_ids)
    done.slots = [slot for slot in table.slots(rows).tolist() if slot != NO_SLOT]
    table.remove(rows)
    tables.landmarks.remove(ids)
    for landmark in ids.tolist():
        marginalised.returned.pop(landmark, None)
    for part in _parts(seen, config.marginal_keyframes):
        chunk = Chunk(seen.select(part), is_summary[part])
        _put(chunk, marginalised.next_number, (ids, points), (tables, camera, config), done)
    return done


def forget(
    update: GraphUpdate, tables: FactorTables, camera: Camera, config: SmootherConfig
) -> Marginalisation:
    """Carry out an update's removals on the archive; chunks that lose something are renewed."""
    marginalised, done = tables.marginalised, Marginalisation()
    landmarks, keyframes = update.remove_landmarks, update.remove_keyframes
    pairs = update.remove_observations
    touched = marginalised.chunks_with(
        keyframes.tolist(), [*landmarks.tolist(), *pairs[:, 1].tolist()]
    )
    for number in touched:
        seen = marginalised.chunks[number].observations
        keep = ~np.isin(seen.landmark_ids, landmarks) & ~np.isin(seen.keyframe_ids, keyframes)
        keep &= tables.keyframes.contains(seen.keyframe_ids)
        for keyframe, landmark in pairs.tolist():
            keep &= (seen.keyframe_ids != keyframe) | (seen.landmark_ids != landmark)
        if not keep.all():
            _renew(number, keep, (tables, camera, config), done)
    for landmark in landmarks.tolist():
        marginalised.summaries.pop(landmark, None)
        marginalised.returned.pop(landmark, None)
    marginalised.bases.difference_update(keyframes.tolist())
    return done


def returning(update: GraphUpdate, tables: FactorTables, camera: Camera) -> GraphUpdate:
    """The update with the summaries and the places of the retired landmarks that it names."""
    marginalised = tables.marginalised
    known = np.array([j in marginalised.summaries for j in update.landmark_ids.tolist()], bool)
    if not known.any():
        return update
    ids = update.landmark_ids[known]
    points = update.points_world.copy()
    points[known] = _points_of(ids, tables, camera)
    summaries = [marginalised.summaries[j] for j in ids.tolist()]
    again = Observations(
        np.array([s.keyframe_id for s in summaries], np.int64),
        ids,
        np.array([s.measurement for s in summaries]),
        np.array([s.sigmas_px for s in summaries]),
    )
    return replace(
        update, points_world=points, observations=concatenate([again, update.observations])
    )


def note_returned(landmark_ids: Ints, marginalised: MarginalisedLandmarks) -> None:
    """These landmarks entered the graph; those that were retired are so no more."""
    for landmark in landmark_ids.tolist():
        marginalised.returned.pop(landmark, None)
        if landmark in marginalised.summaries:
            marginalised.returned[landmark] = marginalised.summaries.pop(landmark)


def note_retracted(landmark_ids: Ints, marginalised: MarginalisedLandmarks) -> None:
    """These landmarks were taken out again: those that had come back are retired as before."""
    for landmark in landmark_ids.tolist():
        if landmark in marginalised.returned:
            marginalised.summaries[landmark] = marginalised.returned.pop(landmark)


def reinstate(tables: FactorTables, camera: Camera, config: SmootherConfig) -> None:
    """Put all archived observations back in place of what stands for them; ISAM2 must be remade."""
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
    tables.landmarks.insert(out, _points_of(out, tables, camera))
    old = concatenate([c.observations.select(~c.is_summary) for c in marginalised.chunks.values()])
    old = old.select(
        tables.keyframes.contains(old.keyframe_ids) & tables.landmarks.contains(old.landmark_ids)
    )
    table.add(old)
    tables.marginalised = MarginalisedLandmarks()
    seen = table.select(table.all_rows())
    held = constrained_landmarks(
        seen,
        tables.keyframes.get(seen.keyframe_ids),
        tables.landmarks.get(seen.landmark_ids),
        config.min_parallax_deg,
    )
    loose = np.setdiff1d(tables.landmarks.ids, held)
    table.remove(table.rows_of_landmarks(loose.tolist()))
    tables.landmarks.remove(loose)


def _put(
    chunk: Chunk,
    number: int,
    landmarks: tuple[Ints, Array],
    model: tuple[FactorTables, Camera, SmootherConfig],
    done: Marginalisation,
) -> None:
    """Make a chunk sparse, archive it, and summarise its landmarks that are out of the graph."""
    tables, camera, config = model
    seen, marginalised = chunk.observations, tables.marginalised
    keyframes, ids = np.unique(seen.keyframe_ids), np.unique(seen.landmark_ids)
    points = landmarks[1][np.searchsorted(landmarks[0], ids)]
    poses, left = eliminate_points(
        seen, (keyframes, tables.keyframes.get(keyframes)), (ids, points), camera, config
    )
    edges = _tree(poses, seen, marginalised, config) if len(keyframes) > 1 else []
    numbers = tables.add_pose_factors(edges)
    done.pose_factors += numbers
    marginalised.put(replace(chunk, numbers=tuple(numbers)), number)
    last = [marginalised.newest_with(j) <= number for j in ids.tolist()]
    out = ~tables.landmarks.contains(ids) & np.array(last, bool)
    summaries = _summaries(seen, left, tables, camera)
    marginalised.summaries.update({int(ids[i]): summaries[i] for i in np.flatnonzero(out)})


def _tree(
    poses: PoseInformation,
    seen: Observations,
    marginalised: MarginalisedLandmarks,
    config: SmootherConfig,
) -> list[RelativePose]:
    """The relative poses that stand for these observations; notes what became a base."""
    keyframes, row = np.unique(seen.keyframe_ids, return_inverse=True)
    landmarks, column = np.unique(seen.landmark_ids, return_inverse=True)
    sees = np.zeros((len(keyframes), len(landmarks)), np.int64)
    sees[row, column] = 1
    is_base = np.isin(keyframes, sorted(marginalised.bases))
    is_base = with_new_bases(sees @ sees.T, is_base, config.base_share)
    marginalised.bases.update(keyframes[is_base].tolist())
    return recover(poses, spanning_tree(poses, is_base), MARGINAL)


def _renew(
    number: int,
    keep: Mask,
    model: tuple[FactorTables, Camera, SmootherConfig],
    done: Marginalisation,
) -> None:
    """Make a chunk sparse again from those of its observations that stay."""
    tables, camera, _ = model
    marginalised, chunk = tables.marginalised, tables.marginalised.take(number)
    present = [n for n in chunk.numbers if n in tables.pose_factors]
    done.slots += [s for n in present if (s := tables.pose_factors[n].slot) != NO_SLOT]
    done.pose_factors = [n for n in done.pose_factors if n not in present]
    tables.remove_pose_factors(present)
    before = np.unique(chunk.observations.landmark_ids)
    out = np.array([j in marginalised.summaries for j in before.tolist()], bool)
    known = out | tables.landmarks.contains(before)
    ids = before[known & np.isin(before, chunk.observations.landmark_ids[keep])]
    points = _points_of(ids, tables, camera)
    for landmark in np.setdiff1d(before, ids).tolist():
        if marginalised.newest_with(landmark) < number:
            marginalised.summaries.pop(landmark, None)
    keep = keep & np.isin(chunk.observations.landmark_ids, ids)
    if keep.any():
        rest = Chunk(chunk.observations.select(keep), chunk.is_summary[keep])
        _put(rest, number, (ids, points), model, done)


def _parts(seen: Observations, limit: int) -> Iterator[Ints]:
    """Rows in groups of whole landmarks that few keyframes see, halved by when they were last seen.

    A single landmark may have more than ``limit`` keyframes.
    """
    ids, which = np.unique(seen.landmark_ids, return_inverse=True)
    newest = np.full(len(ids), -1, np.int64)
    np.maximum.at(newest, which, seen.keyframe_ids)
    waiting = [np.argsort(newest, kind="stable")]
    while waiting:
        group = waiting.pop()
        rows = np.flatnonzero(np.isin(which, group))
        if len(group) == 1 or len(np.unique(seen.keyframe_ids[rows])) <= limit:
            yield rows
        else:
            waiting += [group[len(group) // 2 :], group[: len(group) // 2]]


def _points_of(ids: Ints, tables: FactorTables, camera: Camera) -> Array:
    """Where landmarks (N,) are: in the graph, or carried by the keyframes of their summaries."""
    points = np.zeros((len(ids), 3))
    inside = tables.landmarks.contains(ids)
    points[inside] = tables.landmarks.get(ids[inside])
    summaries = [tables.marginalised.summaries[j] for j in ids[~inside].tolist()]
    if summaries:
        z = np.array([s.measurement for s in summaries])
        hosts = np.array([s.keyframe_id for s in summaries], np.int64)
        p = camera.backproject(z[:, :2], camera.stereo_bf_px_m / (z[:, 0] - z[:, 2]))
        T = tables.keyframes.get(hosts)
        points[~inside] = (T[:, :3, :3] @ p[:, :, None])[:, :, 0] + T[:, :3, 3]
    return points


def _summaries(
    seen: Observations, points: PointInformation, tables: FactorTables, camera: Camera
) -> list[Summary]:
    """One observation a landmark, in the base that saw most of them, or keyframe where none did.

    Its covariance in u, v and disparity is not diagonal; the diagonal is scaled by the largest
    eigenvalue of the correlations, so that the sigmas never claim more than is known.
    """
    in_base = np.isin(seen.keyframe_ids, sorted(tables.marginalised.bases))
    _, which, count = np.unique(seen.keyframe_ids, return_inverse=True, return_counts=True)
    order = np.lexsort((count[which], in_base, seen.landmark_ids))
    last = np.append(np.flatnonzero(np.diff(seen.landmark_ids[order])), len(order) - 1)
    hosts = seen.keyframe_ids[order[last]]
    T_host_world = inverse(tables.keyframes.get(hosts))
    p = (T_host_world[:, :3, :3] @ points.points_world[:, :, None])[:, :, 0]
    p += T_host_world[:, :3, 3]
    J = projection_jacobian(p, camera) @ T_host_world[:, :3, :3]
    covariances = J @ points.covariances @ np.swapaxes(J, 1, 2)
    sigmas = np.sqrt(np.einsum("lii->li", covariances))
    correlations = covariances / (sigmas[:, :, None] * sigmas[:, None, :])
    sigmas *= np.sqrt(np.linalg.eigvalsh(correlations)[:, -1:])
    measured = camera.project_stereo(p)
    return [Summary(int(k), z, s) for k, z, s in zip(hosts, measured, sigmas, strict=True)]
