"""What happened in a run: which events are made, what is counted, and that a state keeps both."""

from __future__ import annotations

import logging
import pickle

import numpy as np
import pytest

from bmask_slam.events import TOTALS, Event, EventKind, EventLog, totals
from bmask_slam.graph.factors.graph_estimate import (
    NO_LANDMARK,
    GraphEstimate,
    RefusalReason,
    Refusals,
    RefusedFactor,
)


def kinds(events: EventLog) -> list[tuple[int, EventKind]]:
    return [(event.frame, event.kind) for event in events.take()]


def at(events: EventLog, frame: int) -> EventLog:
    events.begin_frame(frame, frame / 10)
    return events


def estimate(**changes: object) -> GraphEstimate:
    nothing = np.zeros(0, np.int64)
    return GraphEstimate(nothing, np.zeros((0, 4, 4)), nothing, np.zeros((0, 3)), **changes)


def test_a_loss_is_told_once_and_so_is_its_end() -> None:
    events = EventLog()
    at(events, 0).new_segment(0)
    at(events, 1).tracked(80)
    for frame in (2, 3, 4):
        at(events, frame).lost(matches=7)
    at(events, 5).tracked(60)
    at(events, 6).tracked(61)
    begun, lost, found = events.take()
    assert begun == Event(0, 0.0, EventKind.SEGMENT, "segment 0 begins")
    assert (lost.frame, lost.timestamp_s, lost.kind) == (2, 0.2, EventKind.LOST)
    assert lost.text.startswith("7 matches")
    assert (found.frame, found.kind) == (5, EventKind.FOUND)
    assert found.text == "60 inliers, after 3 frames without a pose"
    assert events.take() == ()


def test_a_new_segment_ends_a_loss() -> None:
    events = EventLog()
    at(events, 3).lost(0)
    at(events, 4).new_segment(1)
    at(events, 5).tracked(50)
    _, begun = events.take()
    assert begun.kind is EventKind.SEGMENT
    assert begun.text == "segment 1 begins, after 1 frame without a pose"


def test_events_are_logged_with_stamp_and_frame(caplog: pytest.LogCaptureFixture) -> None:
    events = EventLog()
    with caplog.at_level(logging.INFO):
        at(events, 12).loop_refused((3, 9), "too few descriptors match (7, limit 15)")
        events.graph(estimate(rebuilt=True, failed_variable="landmark 17"))
    refused, rebuilt = caplog.records
    assert refused.getMessage() == (
        "frame 12, 1.200000 s: loop refused: keyframes 3 and 9: "
        "too few descriptors match (7, limit 15)"
    )
    assert (refused.levelname, rebuilt.levelname) == ("INFO", "WARNING")
    assert rebuilt.getMessage().endswith("graph: rebuilt after a failure near landmark 17")


def test_what_the_graph_did_is_told_and_counted_by_reason() -> None:
    behind, finite = RefusalReason.BEHIND_CAMERA, RefusalReason.NOT_FINITE
    refused = Refusals(
        np.array([4, 4, 5, 5]),
        np.array([7, 8, 9, NO_LANDMARK]),
        np.array([behind, behind, finite, RefusalReason.KEYFRAME_UNDERCONSTRAINED]),
    )
    loop = RefusedFactor("loop", (1, 2), RefusalReason.BAD_COVARIANCE)
    done = estimate(refused=refused, refused_factors=(loop,), dropped_landmarks=np.array([3, 4, 5]))
    events = at(EventLog(), 8)
    for _ in range(2):
        events.graph(done)
    told = [event.text for event in events.take()]
    assert told[: len(told) // 2] == [
        "1 factors refused: loop, bad covariance",
        "1 keyframes refused: keyframe underconstrained",
        "1 observations refused: not finite",
        "2 observations refused: behind camera",
        "3 landmarks dropped",
    ]
    events.count({"observations pruned: mask": 5, "observations pruned: moving": 1, "rebuilds": 0})
    whole = totals(events.counts)
    assert list(whole)[: len(TOTALS)] == list(TOTALS)
    assert {name: whole[name] for name in TOTALS if whole[name]} == {
        "observations refused": 6,
        "keyframes refused": 2,
        "factors refused": 2,
        "landmarks dropped": 6,
        "observations pruned": 6,
    }
    assert whole["observations refused: behind camera"] == 4
    assert whole["factors refused: loop, bad covariance"] == 2


def test_an_untroubled_update_is_no_event() -> None:
    events = at(EventLog(), 8)
    events.graph(estimate())
    assert (events.take(), events.counts) == ((), {})


def test_a_restored_log_goes_on_the_same() -> None:
    events, twin = at(EventLog(), 4), EventLog()
    events.lost(3)
    events.count({"landmarks dropped": 2, "loops pruned: refuted": 1})
    events.take()
    twin.restore(events.state())
    assert twin.counts == events.counts
    for log in (events, twin):
        log.graph(estimate(dropped_landmarks=np.array([1])))  # still at frame 4
        at(log, 5).lost(3)
        at(log, 6).tracked(9)
    assert events.take() == twin.take()
    assert twin.counts["landmarks dropped"] == 3


def test_another_session_begins_with_nothing() -> None:
    events = at(EventLog(), 4)
    events.lost(3)
    events.count({"landmarks dropped": 2})
    events.take()
    events.begin_session()
    at(events, 0).tracked(50)
    assert (events.take(), events.counts) == ((), {})


def test_events_of_another_process_come_once_and_are_logged_here(
    caplog: pytest.LogCaptureFixture,
) -> None:
    there, here, sent = at(EventLog(), 2), EventLog(), []
    there.on_event = sent.append
    with caplog.at_level(logging.INFO):
        there.loop_closed((1, 9), 40)
        there.joined(1, 0, 70)
        assert caplog.records == []
        assert there.take() == ()
        for event in [*sent, *sent]:  # sent again after the process was restarted
            here.receive(pickle.loads(pickle.dumps(event)))
    assert kinds(here) == [(2, EventKind.LOOP_CLOSED), (2, EventKind.JOINED)]
    assert len(caplog.records) == 2
