"""Tracks of people that walk at a known speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Floats
from bmask_slam.graph.geometry import so3_exp
from bmask_slam.semantics.tracks.instance_track import Sighting
from bmask_slam.semantics.tracks.instance_tracks import InstanceTracks, TrackConfig

SIZE = np.array([0.25, 0.9, 0.2])
PERSON, CHAIR = np.eye(3, dtype=np.float32)[1:]


def sighting(x: float, y: float = 0.0, z: float = 3.0, what: Floats = PERSON) -> Sighting:
    return Sighting(np.array([x, y, z]), SIZE, what, 2.0)


def test_a_walker_is_predicted_between_keyframes() -> None:
    tracks = InstanceTracks()
    for k in range(8):
        tracks.update(0.4 * k, [sighting(0.8 * 0.4 * k, z=3 - 0.5 * 0.4 * k)])
    (track,) = tracks.tracks
    ahead = tracks.predicted(track, 2.8 + 0.3)
    np.testing.assert_allclose(ahead.mean[3:], [0.8, 0, -0.5], atol=0.05)
    np.testing.assert_allclose(ahead.mean[:3], [0.8 * 3.1, 0, 3 - 0.5 * 3.1], atol=0.05)
    assert (tracks.reach_m(ahead) > SIZE).all()
    assert (tracks.reach_m(tracks.predicted(track, 4.0)) > tracks.reach_m(ahead)).all()


def test_the_filter_equals_the_textbook_kalman_filter() -> None:
    config = TrackConfig(acceleration_m_s2=1.5, speed_m_s=0.9, centroid_sigma_m=0.1)
    tracks, dt, z = InstanceTracks(config), 0.5, np.array([0.3, -0.1, 3.2])
    tracks.update(0.0, [sighting(0.0)])
    tracks.update(dt, [Sighting(z, SIZE, PERSON, 2.0)])
    eye, zero = np.eye(3), np.zeros((3, 3))
    F = np.block([[eye, dt * eye], [zero, eye]])
    G = np.vstack([dt**2 / 2 * eye, dt * eye])
    P = F @ np.diag([0.01] * 3 + [0.81] * 3) @ F.T + 1.5**2 * G @ G.T
    x = F @ np.array([0, 0, 3, 0, 0, 0.0])
    K = P[:, :3] @ np.linalg.inv(P[:3, :3] + 0.01 * eye)
    np.testing.assert_allclose(tracks.tracks[0].mean, x + K @ (z - x[:3]), atol=1e-9)
    np.testing.assert_allclose(tracks.tracks[0].covariance, P - K @ P[:3], atol=1e-9)


def test_crossing_people_keep_their_tracks_in_any_order() -> None:
    tracks = InstanceTracks()
    for k in range(11):
        both = [sighting(-2 + 0.4 * k), sighting(2 - 0.4 * k, z=3.3)]
        ids = tracks.update(0.5 * k, both[:: 1 if k % 2 else -1])
        assert sorted(ids) == [0, 1]
    ends = {round(float(t.mean[0]), 1) for t in tracks.tracks}
    assert ends == {2.0, -2.0}


def test_a_chair_is_not_assigned_to_a_persons_track() -> None:
    tracks = InstanceTracks(TrackConfig(class_cost=20.0))
    first = tracks.update(0.0, [sighting(0.0)])
    assert tracks.update(0.3, [sighting(0.0, what=CHAIR)]) != first
    assert len(tracks.tracks) == 2


def test_a_distant_instance_starts_a_track_and_unobserved_tracks_end() -> None:
    tracks = InstanceTracks(TrackConfig(patience_s=1.0))
    assert tracks.update(0.0, [sighting(0.0)]) == [0]
    assert tracks.update(0.3, [sighting(3.0)]) == [1]
    tracks.update(1.2, [])
    assert [t.id for t in tracks.tracks] == [1]


def test_masks_out_of_order_are_ignored() -> None:
    tracks = InstanceTracks()
    tracks.update(1.0, [sighting(0.0)])
    before = tracks.state()
    assert tracks.update(0.5, [sighting(1.0)]) == []
    tracks.miss(0.5, tracks.tracks)
    assert all(np.array_equal(a, before[name]) for name, a in tracks.state().items())


def moving_after(evidence: list[float], prior: float) -> bool:
    tracks = InstanceTracks()
    for k, step in enumerate(evidence):
        tracks.update(0.3 * k, [replace(sighting(0.0), prior=prior, evidence=step)])
    return tracks.tracks[0].moving


def test_evidence_accumulates_until_it_outweighs_the_class() -> None:
    dog, person, step = np.log(0.89 / 0.11), np.log(0.95 / 0.05), np.log(9)
    assert moving_after([0.0], dog)
    assert not moving_after([-step] * 2, dog)
    assert moving_after([-step] * 9, person)
    assert moving_after([-step] * 9 + [step] * 2, dog)
    assert not moving_after([step] * 9 + [-step] * 4, dog)


def test_a_track_missed_by_keyframes_in_view_ends() -> None:
    tracks = InstanceTracks(TrackConfig(max_missed=2))
    tracks.update(0.0, [sighting(0.0), sighting(3.0)])
    missed = tracks.tracks[0]
    tracks.miss(0.2, [missed])
    tracks.update(0.3, [sighting(0.0)])
    tracks.miss(0.4, [missed])
    assert [t.missed for t in tracks.tracks] == [1, 0]
    tracks.miss(0.4, [missed])
    assert [t.id for t in tracks.tracks] == [1]


def test_an_observed_track_is_not_counted_as_missed() -> None:
    tracks = InstanceTracks(TrackConfig(max_missed=1))
    tracks.update(0.2, [sighting(0.0)])
    tracks.miss(0.2, tracks.tracks)
    assert [t.missed for t in tracks.tracks] == [0]


def test_the_state_is_restored() -> None:
    tracks, other = InstanceTracks(), InstanceTracks()
    tracks.update(0.0, [sighting(0.0), sighting(2.0, what=CHAIR)])
    tracks.update(0.4, [sighting(0.2)])
    other.restore(tracks.state())
    assert all(np.array_equal(a, other.state()[name]) for name, a in tracks.state().items())
    assert other.update(0.6, [sighting(0.3), sighting(5.0)]) == tracks.update(
        0.6, [sighting(0.3), sighting(5.0)]
    )


def test_all_boxes_at_once_are_those_of_each_track() -> None:
    tracks = InstanceTracks()
    for k in range(4):
        tracks.update(0.3 * k, [sighting(0.2 * k), sighting(2.0 + 0.1 * k, z=2.0)])
    tracks.update(1.1, [sighting(0.75), Sighting(np.array([-2.0, 0, 2]), SIZE, CHAIR, -1.0)])
    centres, sizes = tracks.moving_boxes(1.3)
    ahead = [tracks.predicted(t, 1.3) for t in tracks.tracks if t.moving]
    assert len(ahead) == 2 < len(tracks.tracks)
    np.testing.assert_allclose(centres, [t.mean[:3] for t in ahead], atol=1e-12)
    np.testing.assert_allclose(sizes, [tracks.reach_m(t) for t in ahead], atol=1e-12)
    assert InstanceTracks().moving_boxes(0.0)[0].shape == (0, 3)


def part(x: float, y: float, z: float) -> Sighting:
    return Sighting(np.array([x, y, z]), SIZE / 3, PERSON, 2.0)


def test_a_part_beside_its_whole_is_not_a_second_person() -> None:
    tracks = InstanceTracks()
    assert tracks.update(0.0, [part(0.1, -0.6, 3.1), sighting(0.0), sighting(0.0, what=CHAIR)]) == [
        0,
        0,
        1,
    ]
    (person, _) = tracks.tracks
    np.testing.assert_array_equal(person.half_size, SIZE)
    first, second = tracks.update(0.3, [sighting(0.05), part(0.1, -0.6, 3.3)])
    assert first == 0 != second


def test_boxes_have_the_axes_of_their_camera() -> None:
    R_world_camera = so3_exp(np.array([0.0, np.pi / 2, 0.0]))
    offset = R_world_camera @ np.array([0.22, 0.0, 0.0])
    behind = R_world_camera @ np.array([0.0, 0.0, 0.22])
    for away, ids in ((offset, [0, 0]), (behind, [0, 1])):
        both = [sighting(0.0), part(*(np.array([0, 0, 3.0]) + away))]
        assert InstanceTracks().update(0.0, both, R_world_camera) == ids


def test_an_unobserved_track_ends_where_a_similar_one_is_observed() -> None:
    tracks = InstanceTracks()
    four = [sighting(0.0), sighting(0.3), sighting(0.1, what=CHAIR), sighting(1.0)]
    assert tracks.update(0.0, four) == [0, 1, 2, 3]
    (kept,) = tracks.update(0.2, [sighting(0.12)])
    assert [t.id for t in tracks.tracks] == [kept, 2, 3]


def test_the_class_prior_is_ignored_for_a_reinstated_track() -> None:
    tracks = InstanceTracks()
    (mine, other) = tracks.update(0.0, [sighting(0.0), sighting(2.0)])
    tracks.reinstate(mine, -1.4)
    tracks.update(0.3, [sighting(0.0), sighting(2.0)])
    by_id = {track.id: track for track in tracks.tracks}
    assert [by_id[k].stood for k in (mine, other)] == [True, False]
    assert [by_id[k].moving for k in (mine, other)] == [False, True]
    for k in range(2):  # but what views say does
        moves = Sighting(np.array([0.1 * k, 0, 3]), SIZE, PERSON, 2.0, evidence=2.2)
        tracks.update(0.6 + 0.3 * k, [moves, sighting(2.0)])
    assert {track.id: track.moving for track in tracks.tracks}[mine]
