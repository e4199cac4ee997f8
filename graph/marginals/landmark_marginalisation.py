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
from numpy.typing import NDArray

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import NO_SLOT, Shadow, ids_array
from bmask_slam.graph.factors.graph_update import (
    GraphUpdate,
    IntArray,
    Observations,
    RelativePose,
    concatenate,
)
from bmask_slam.graph.factors.marginalised_landmarks import MARGINAL, Archive, Chunk, Summary
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import Array, inverse
from bmask_slam.graph.marginals.point_elimination import (
    PointInformation,
    PoseInformation,
    marginalise,
    projection_jacobian,
)
from bmask_slam.graph.marginals.sparsification import recover, spanning_tree, with_new_bases

Mask = NDArray[np.bool_]


@dataclass
class Retirement:
    """Slots in ISAM2 of factors that left the shadow, and numbers of relative poses that came."""

    slots: list[int] = field(default_factory=list)
    pose_factors: list[int] = field(default_factory=list)


def retire(ids: IntArray, shadow: Shadow, camera: Camera, config: SmootherConfig) -> Retirement:
    """Replace all factors of these landmarks; ids that the graph does not hold are passed over."""
    table, archive, done = shadow.observations, shadow.archive, Retirement()
    ids = np.intersect1d(ids, shadow.landmarks.ids)
    rows = table.rows_of_landmarks(ids.tolist())
    if not len(rows):
        return done
    seen, points = table.select(rows), shadow.landmarks.get(ids)
    is_summary = archive.are_summaries(seen.keyframe_ids, seen.landmark_ids)
    done.slots = [slot for slot in table.slots(rows).tolist() if slot != NO_SLOT]
    table.remove(rows)
    shadow.landmarks.remove(ids)
    for landmark in ids.tolist():
        archive.returned.pop(landmark, None)
    for part in _parts(seen, config.marginal_keyframes):
        chunk = Chunk(seen.select(part), is_summary[part])
        _put(chunk, archive.next_number, (ids, points), (shadow, camera, config), done)
    return done


def forget(
    update: GraphUpdate, shadow: Shadow, camera: Camera, config: SmootherConfig
) -> Retirement:
    """Carry out an update's removals on the archive; chunks that lose something are renewed."""
    archive, done = shadow.archive, Retirement()
    landmarks, keyframes = update.remove_landmarks, update.remove_keyframes
    pairs = update.remove_observations
    touched = archive.chunks_with(keyframes.tolist(), [*landmarks.tolist(), *pairs[:, 1].tolist()])
    for number in touched:
        seen = archive.chunks[number].observations
        keep = ~np.isin(seen.landmark_ids, landmarks) & ~np.isin(seen.keyframe_ids, keyframes)
        keep &= shadow.keyframes.contains(seen.keyframe_ids)
        for keyframe, landmark in pairs.tolist():
            keep &= (seen.keyframe_ids != keyframe) | (seen.landmark_ids != landmark)
        if not keep.all():
            _renew(number, keep, (shadow, camera, config), done)
    for landmark in landmarks.tolist():
        archive.summaries.pop(landmark, None)
        archive.returned.pop(landmark, None)
    archive.bases.difference_update(keyframes.tolist())
    return done


def returning(update: GraphUpdate, shadow: Shadow, camera: Camera) -> GraphUpdate:
    """The update with the summaries and the places of the retired landmarks that it names."""
    archive = shadow.archive
    known = np.array([j in archive.summaries for j in update.landmark_ids.tolist()], bool)
    if not known.any():
        return update
    ids = update.landmark_ids[known]
    points = update.points_world.copy()
    points[known] = _points_of(ids, shadow, camera)
    summaries = [archive.summaries[j] for j in ids.tolist()]
    again = Observations(
        np.array([s.keyframe_id for s in summaries], np.int64),
        ids,
        np.array([s.measurement for s in summaries]),
        np.array([s.sigmas_px for s in summaries]),
    )
    return replace(
        update, points_world=points, observations=concatenate([again, update.observations])
    )


def note_returned(landmark_ids: IntArray, archive: Archive) -> None:
    """These landmarks entered the graph; those that were retired are so no more."""
    for landmark in landmark_ids.tolist():
        archive.returned.pop(landmark, None)
        if landmark in archive.summaries:
            archive.returned[landmark] = archive.summaries.pop(landmark)


def note_retracted(landmark_ids: IntArray, archive: Archive) -> None:
    """These landmarks were taken out again: those that had come back are retired as before."""
    for landmark in landmark_ids.tolist():
        if landmark in archive.returned:
            archive.summaries[landmark] = archive.returned.pop(landmark)


def reinstate(shadow: Shadow, camera: Camera, config: SmootherConfig) -> None:
    """Put all archived observations back in place of what stands for them; ISAM2 must be remade."""
    archive, table = shadow.archive, shadow.observations
    if not archive.chunks:
        return
    rows = table.used_rows()
    active = table.select(rows)
    table.remove(rows[archive.are_summaries(active.keyframe_ids, active.landmark_ids)])
    shadow.remove_pose_factors(
        n for c in archive.chunks.values() for n in c.numbers if n in shadow.pose_factors
    )
    out = ids_array(archive.summaries)
    shadow.landmarks.insert(out, _points_of(out, shadow, camera))
    old = concatenate([c.observations.select(~c.is_summary) for c in archive.chunks.values()])
    old = old.select(
        shadow.keyframes.contains(old.keyframe_ids) & shadow.landmarks.contains(old.landmark_ids)
    )
    table.add(old)
    shadow.archive = Archive()
    seen = table.select(table.all_rows())
    held = constrained_landmarks(
        seen,
        shadow.keyframes.get(seen.keyframe_ids),
        shadow.landmarks.get(seen.landmark_ids),
        config.min_parallax_deg,
    )
    loose = np.setdiff1d(shadow.landmarks.ids, held)
    table.remove(table.rows_of_landmarks(loose.tolist()))
    shadow.landmarks.remove(loose)


def _put(
    chunk: Chunk,
    number: int,
    landmarks: tuple[IntArray, Array],
    model: tuple[Shadow, Camera, SmootherConfig],
    done: Retirement,
) -> None:
    """Make a chunk sparse, archive it, and summarise its landmarks that are out of the graph."""
    shadow, camera, config = model
    seen, archive = chunk.observations, shadow.archive
    keyframes, ids = np.unique(seen.keyframe_ids), np.unique(seen.landmark_ids)
    points = landmarks[1][np.searchsorted(landmarks[0], ids)]
    poses, left = marginalise(
        seen, (keyframes, shadow.keyframes.get(keyframes)), (ids, points), camera, config
    )
    edges = _tree(poses, seen, archive, config) if len(keyframes) > 1 else []
    numbers = shadow.add_pose_factors(edges)
    done.pose_factors += numbers
    archive.put(replace(chunk, numbers=tuple(numbers)), number)
    last = [archive.newest_with(j) <= number for j in ids.tolist()]
    out = ~shadow.landmarks.contains(ids) & np.array(last, bool)
    summaries = _summaries(seen, left, shadow, camera)
    archive.summaries.update({int(ids[i]): summaries[i] for i in np.flatnonzero(out)})


def _tree(
    poses: PoseInformation, seen: Observations, archive: Archive, config: SmootherConfig
) -> list[RelativePose]:
    """The relative poses that stand for these observations; notes what became a base."""
    keyframes, row = np.unique(seen.keyframe_ids, return_inverse=True)
    landmarks, column = np.unique(seen.landmark_ids, return_inverse=True)
    sees = np.zeros((len(keyframes), len(landmarks)), np.int64)
    sees[row, column] = 1
    is_base = np.isin(keyframes, sorted(archive.bases))
    is_base = with_new_bases(sees @ sees.T, is_base, config.base_share)
    archive.bases.update(keyframes[is_base].tolist())
    return recover(poses, spanning_tree(poses, is_base), MARGINAL)


def _renew(
    number: int, keep: Mask, model: tuple[Shadow, Camera, SmootherConfig], done: Retirement
) -> None:
    """Make a chunk sparse again from those of its observations that stay."""
    shadow, camera, _ = model
    archive, chunk = shadow.archive, shadow.archive.take(number)
    present = [n for n in chunk.numbers if n in shadow.pose_factors]
    done.slots += [s for n in present if (s := shadow.pose_factors[n].slot) != NO_SLOT]
    done.pose_factors = [n for n in done.pose_factors if n not in present]
    shadow.remove_pose_factors(present)
    before = np.unique(chunk.observations.landmark_ids)
    out = np.array([j in archive.summaries for j in before.tolist()], bool)
    known = out | shadow.landmarks.contains(before)
    ids = before[known & np.isin(before, chunk.observations.landmark_ids[keep])]
    points = _points_of(ids, shadow, camera)
    for landmark in np.setdiff1d(before, ids).tolist():
        if archive.newest_with(landmark) < number:
            archive.summaries.pop(landmark, None)
    keep = keep & np.isin(chunk.observations.landmark_ids, ids)
    if keep.any():
        rest = Chunk(chunk.observations.select(keep), chunk.is_summary[keep])
        _put(rest, number, (ids, points), model, done)


def _parts(seen: Observations, limit: int) -> Iterator[IntArray]:
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


def _points_of(ids: IntArray, shadow: Shadow, camera: Camera) -> Array:
    """Where landmarks (N,) are: in the graph, or carried by the keyframes of their summaries."""
    points = np.zeros((len(ids), 3))
    inside = shadow.landmarks.contains(ids)
    points[inside] = shadow.landmarks.get(ids[inside])
    summaries = [shadow.archive.summaries[j] for j in ids[~inside].tolist()]
    if summaries:
        z = np.array([s.measurement for s in summaries])
        hosts = np.array([s.keyframe_id for s in summaries], np.int64)
        p = camera.backproject(z[:, :2], camera.stereo_bf_px_m / (z[:, 0] - z[:, 2]))
        T = shadow.keyframes.get(hosts)
        points[~inside] = (T[:, :3, :3] @ p[:, :, None])[:, :, 0] + T[:, :3, 3]
    return points


def _summaries(
    seen: Observations, points: PointInformation, shadow: Shadow, camera: Camera
) -> list[Summary]:
    """One observation a landmark, in the base that saw most of them, or keyframe where none did.

    Its covariance in u, v and disparity is not diagonal; the diagonal is scaled by the largest
    eigenvalue of the correlations, so that the sigmas never claim more than is known.
    """
    in_base = np.isin(seen.keyframe_ids, sorted(shadow.archive.bases))
    _, which, count = np.unique(seen.keyframe_ids, return_inverse=True, return_counts=True)
    order = np.lexsort((count[which], in_base, seen.landmark_ids))
    last = np.append(np.flatnonzero(np.diff(seen.landmark_ids[order])), len(order) - 1)
    hosts = seen.keyframe_ids[order[last]]
    T_host_world = inverse(shadow.keyframes.get(hosts))
    p = (T_host_world[:, :3, :3] @ points.points_world[:, :, None])[:, :, 0]
    p += T_host_world[:, :3, 3]
    J = projection_jacobian(p, camera) @ T_host_world[:, :3, :3]
    covariances = J @ points.covariances @ np.swapaxes(J, 1, 2)
    sigmas = np.sqrt(np.einsum("lii->li", covariances))
    correlations = covariances / (sigmas[:, :, None] * sigmas[:, None, :])
    sigmas *= np.sqrt(np.linalg.eigvalsh(correlations)[:, -1:])
    measured = camera.project_stereo(p)
    return [Summary(int(k), z, s) for k, z, s in zip(hosts, measured, sigmas, strict=True)]
