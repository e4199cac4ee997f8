"""Positions of movable instances between keyframes: one Kalman filter each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, Mask
from bmask_slam.semantics.tracks.instance_track import Sighting, Track

_H = np.eye(3, 6)
_NEVER = 1e9


@dataclass(frozen=True)
class TrackConfig:
    """The motion model, the association, and when a track ends.

    ``acceleration_m_s2``, ``speed_m_s`` and ``centroid_sigma_m`` are the standard deviations of the
    white acceleration, of an unknown speed, and of a measured centroid, which may be partly hidden.
    A sighting joins a track only below a cost of ``gate_chi2`` (3 degrees of freedom); a completely
    different class adds ``class_cost``. Of two sightings with a class affinity of ``same_class``,
    one with its centroid in the other's box is a part of it. A track ends ``patience_s`` after its
    last sighting, longer than the usual time between keyframes. Boxes are widened by ``box_sigmas``
    of the predicted position, at most ``box_slack_m``, plus ``box_margin_m``. Classes with a prior
    below ``min_prior`` have no tracks. All evidence changes a track's log odds by at most
    ``max_evidence``; it ends after ``max_missed`` consecutive keyframes that show its position
    without a sighting of it.
    """

    acceleration_m_s2: float = 1.0
    speed_m_s: float = 0.7
    centroid_sigma_m: float = 0.08
    gate_chi2: float = 16.0
    class_cost: float = 8.0
    same_class: float = 0.5
    patience_s: float = 3.0
    box_sigmas: float = 1.0
    box_slack_m: float = 0.25
    box_margin_m: float = 0.08
    min_prior: float = 0.2
    max_evidence: float = 2.7
    max_missed: int = 2

    def __post_init__(self) -> None:
        if min(self.acceleration_m_s2, self.speed_m_s, self.centroid_sigma_m) <= 0:
            raise ValueError("acceleration, speed and centroid sigma must be positive")
        if self.patience_s <= 0 or self.gate_chi2 <= 0:
            raise ValueError("patience_s and gate_chi2 must be positive")
        if self.max_evidence <= 0 or self.max_missed < 1:
            raise ValueError("max_evidence must be positive, max_missed at least 1")


class InstanceTracks:
    """All tracks, updated by one gated linear assignment a keyframe."""

    def __init__(self, config: TrackConfig | None = None) -> None:
        self.config = config or TrackConfig()
        self.tracks: list[Track] = []
        self._next_id = 0

    def update(
        self, time_s: float, sightings: Sequence[Sighting], R_world_camera: Array | None = None
    ) -> list[int]:
        """Add the movable instances of a keyframe; returns the id of the track of each.

        A part joins the track of its whole if both have a sighting. Sightings older than the newest
        of any track are ignored: the result is empty. ``R_world_camera`` (3, 3) rotates the boxes'
        axes into the world's; by default they are the same.
        """
        self.expire(time_s)
        if any(track.time_s > time_s for track in self.tracks):
            return []
        R = np.eye(3) if R_world_camera is None else R_world_camera
        whole = self._wholes(sightings, R)
        distinct = np.flatnonzero(whole == np.arange(len(sightings))).tolist()
        ahead = [self.predicted(track, time_s) for track in self.tracks]
        chosen = self._assign(ahead, [sightings[k] for k in distinct])
        ids = np.zeros(len(sightings), np.int64)
        for k, row in zip(distinct, chosen, strict=True):
            if row < 0:
                self.tracks.append(self._new_track(sightings[k], time_s))
            else:
                self.tracks[row] = self._updated(ahead[row], sightings[k], time_s)
            ids[k] = self.tracks[row].id
        self._end_doubles(time_s, R)
        return [int(i) for i in ids[whole]]

    def miss(self, time_s: float, shown: Sequence[Track]) -> None:
        """Count a miss for those of the tracks in a keyframe's view without a sighting in it.

        Ignored, as in ``update``, if any track has a newer sighting.
        """
        if any(track.time_s > time_s for track in self.tracks):
            return
        missed = {track.id for track in shown if track.time_s < time_s}
        tracks = [replace(t, missed=t.missed + (t.id in missed)) for t in self.tracks]
        self.tracks = [t for t in tracks if t.missed < self.config.max_missed]

    def reinstate(self, track_id: int, prior: float) -> None:
        """Mark a track as standing: its class no longer counts, its log odds start at ``prior``."""
        self.tracks = [
            replace(t, prior=min(t.prior, prior), evidence=min(t.evidence, 0.0), stood=True)
            if t.id == track_id
            else t
            for t in self.tracks
        ]

    def expire(self, time_s: float) -> None:
        """End the tracks without a sighting for ``patience_s``."""
        limit = time_s - self.config.patience_s
        self.tracks = [track for track in self.tracks if track.time_s >= limit]

    def predicted(self, track: Track, time_s: float) -> Track:
        """A track at another time, by constant velocity; ``time_s`` stays that of its sighting."""
        from filterpy.common import Q_discrete_white_noise  # noqa: PLC0415 - loads slowly
        from filterpy.kalman import predict  # noqa: PLC0415

        dt, variance = time_s - track.time_s, self.config.acceleration_m_s2**2
        F = np.eye(6) + dt * np.eye(6, k=3)
        Q = Q_discrete_white_noise(2, abs(dt), variance, block_size=3, order_by_dim=False)
        mean, covariance = predict(track.mean, track.covariance, F=F, Q=Q)
        return replace(track, mean=mean, covariance=covariance)

    def reach_m(self, track: Track) -> Array:
        """Half size (3,) m of a predicted track's box, widened by its uncertainty."""
        sigma_m = np.sqrt(max(np.trace(track.covariance[:3, :3]) / 3, 0.0))
        return track.half_size + self._slack_m(sigma_m)

    def moving_boxes(self, time_s: float) -> tuple[Array, Array]:
        """Centres in the world and half sizes (T, 3) m of the moving tracks' boxes at a time.

        The results of ``predicted`` and ``reach_m`` for all at once: the covariance of the
        predicted position has the trace of P_pp + 2 dt P_pv + dt^2 P_vv + dt^4 / 4 a^2.
        """
        moving = [track for track in self.tracks if track.moving]
        if not moving:
            return np.zeros((0, 3)), np.zeros((0, 3))
        dt = time_s - np.array([track.time_s for track in moving])
        means = np.array([track.mean for track in moving])
        P = np.array([track.covariance for track in moving]).reshape(-1, 2, 3, 2, 3)
        traces = np.einsum("tajbj->abt", P)
        variance = (traces[0, 0] + 2 * dt * traces[0, 1] + dt**2 * traces[1, 1]) / 3
        variance += 0.25 * dt**4 * self.config.acceleration_m_s2**2
        slack_m = self._slack_m(np.sqrt(np.maximum(variance, 0)))
        sizes = np.array([track.half_size for track in moving])
        return means[:, :3] + dt[:, None] * means[:, 3:], sizes + slack_m[:, None]

    def clear(self) -> None:
        """End all tracks, for another recording."""
        self.tracks = []

    def state(self) -> Arrays:
        """The tracks as named arrays."""
        tracks = self.tracks
        return {
            "next_id": np.array(self._next_id),
            "ids": np.array([t.id for t in tracks], np.int64),
            "times_s": np.array([t.time_s for t in tracks], float),
            "means": np.array([t.mean for t in tracks], float).ravel(),
            "covariances": np.array([t.covariance for t in tracks], float).ravel(),
            "half_sizes": np.array([t.half_size for t in tracks], float).ravel(),
            "distributions": np.array([t.distribution for t in tracks], np.float32).ravel(),
            "priors": np.array([t.prior for t in tracks], float),
            "evidence": np.array([t.evidence for t in tracks], float),
            "sightings": np.array([t.sightings for t in tracks], np.int64),
            "missed": np.array([t.missed for t in tracks], np.int64),
            "stood": np.array([t.stood for t in tracks], bool),
        }

    def restore(self, state: Arrays) -> None:
        """Replace the tracks by those of a state."""
        n = len(state["ids"])
        self._next_id = int(state["next_id"])
        distributions = state["distributions"].reshape(n, -1) if n else np.zeros((0, 1))
        self.tracks = [
            Track(*row)
            for row in zip(
                state["ids"].tolist(),
                state["times_s"].tolist(),
                state["means"].reshape(n, 6).copy(),
                state["covariances"].reshape(n, 6, 6).copy(),
                state["half_sizes"].reshape(n, 3).copy(),
                distributions.astype(np.float32),
                state["priors"].tolist(),
                state["evidence"].tolist(),
                state["sightings"].tolist(),
                state["missed"].tolist(),
                state["stood"].tolist(),
                strict=True,
            )
        ]

    def _wholes(self, sightings: Sequence[Sighting], R_world_box: Array) -> Ints:
        """Index (N,) of the largest sighting that each is a part of, or of itself."""
        if not sightings:
            return np.zeros(0, np.int64)
        centres = np.array([s.centroid_world for s in sightings])
        sizes = np.array([s.half_size for s in sightings])
        within = _within(centres, centres, sizes, R_world_box)
        within &= _affinities(sightings, sightings) >= self.config.same_class
        np.fill_diagonal(within, True)
        volume = sizes.prod(axis=1)
        whole = np.where(within, volume, -1.0).argmax(axis=1)
        while not np.array_equal(whole, whole[whole]):
            whole = whole[whole]
        return whole

    def _end_doubles(self, time_s: float, R_world_box: Array) -> None:
        """End tracks without a sighting at the position of a sighting of the same class."""
        now = [track for track in self.tracks if track.time_s == time_s]
        others = [track for track in self.tracks if track.time_s != time_s]
        if not now or not others:
            return
        centres = np.array([self.predicted(track, time_s).mean[:3] for track in others])
        means, sizes = np.array([t.mean[:3] for t in now]), np.array([t.half_size for t in now])
        double = _within(centres, means, sizes, R_world_box)
        double &= _affinities(others, now) >= self.config.same_class
        ended = {others[k].id for k in np.flatnonzero(double.any(axis=1)).tolist()}
        self.tracks = [track for track in self.tracks if track.id not in ended]

    def _slack_m(self, sigma_m: Array) -> Array:
        """Margin of boxes whose centres have this standard deviation."""
        known = self.config.box_sigmas * sigma_m
        return np.minimum(known, self.config.box_slack_m) + self.config.box_margin_m

    def _assign(self, ahead: list[Track], sightings: Sequence[Sighting]) -> list[int]:
        """The row of the track of each sighting, -1 for none: the cheapest pairs in the gate."""
        chosen = [-1] * len(sightings)
        if not ahead or not sightings:
            return chosen
        cost = np.full((len(sightings), len(ahead)), _NEVER)
        noise = self.config.centroid_sigma_m**2 * np.eye(3)
        for k, track in enumerate(ahead):
            away = np.array([s.centroid_world for s in sightings]) - track.mean[:3]
            S = track.covariance[:3, :3] + noise
            chi2 = np.einsum("ij,ij->i", away, np.linalg.solve(S, away.T).T)
            affinity = np.array([_affinity(s.distribution, track.distribution) for s in sightings])
            total = chi2 + self.config.class_cost * (1 - affinity)
            cost[:, k] = np.where(total < self.config.gate_chi2, total, _NEVER)
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - loads slowly

        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[row, column] < _NEVER:
                chosen[row] = int(column)
        return chosen

    def _new_track(self, sighting: Sighting, time_s: float) -> Track:
        self._next_id += 1
        variances = [self.config.centroid_sigma_m**2] * 3 + [self.config.speed_m_s**2] * 3
        return Track(
            id=self._next_id - 1,
            time_s=time_s,
            mean=np.concatenate([sighting.centroid_world, np.zeros(3)]),
            covariance=np.diag(variances),
            half_size=sighting.half_size,
            distribution=sighting.distribution,
            prior=sighting.prior,
            evidence=sighting.evidence,
            sightings=1,
        )

    def _updated(self, ahead: Track, sighting: Sighting, time_s: float) -> Track:
        from filterpy.kalman import update  # noqa: PLC0415 - loads slowly

        limit = self.config.max_evidence
        noise = self.config.centroid_sigma_m**2 * np.eye(3)
        mean, covariance = update(
            ahead.mean, ahead.covariance, sighting.centroid_world, noise, H=_H
        )
        return replace(
            ahead,
            time_s=time_s,
            mean=mean,
            covariance=covariance,
            half_size=np.maximum(sighting.half_size, 0.8 * ahead.half_size),
            distribution=np.float32(0.5) * (ahead.distribution + sighting.distribution),
            prior=ahead.prior if ahead.stood else (ahead.prior + sighting.prior) / 2,
            evidence=float(np.clip(ahead.evidence + sighting.evidence, -limit, limit)),
            sightings=ahead.sightings + 1,
            missed=0,
        )


def _within(points: Array, centres: Array, sizes: Array, R_world_box: Array) -> Mask:
    """Whether points (N, 3) lie in boxes at centres (M, 3) of half sizes (M, 3): (N, M)."""
    away = np.abs((points[:, None] - centres) @ R_world_box)
    return np.asarray((away <= sizes).all(axis=2))


def _affinities(a: Sequence[Sighting | Track], b: Sequence[Sighting | Track]) -> Array:
    """The affinity (N, M) of each pair of N and M sightings or tracks."""
    return np.array([[_affinity(x.distribution, y.distribution) for y in b] for x in a])


def _affinity(a: Floats, b: Floats) -> float:
    """Bhattacharyya coefficient of two distributions (C,), 0 to 1."""
    return float(np.sqrt(a * b).sum()) if a.shape == b.shape else 0.0
