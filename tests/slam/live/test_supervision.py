"""A process that hangs is told from one that a busy machine slows down."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
from faults import LONG_S, Clock, wait_until

from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import Ready
from bmask_slam.live.processes import supervision
from bmask_slam.live.processes.supervision import RestartPolicy, SupervisedWorker
from bmask_slam.live.processes.worker import Failure, Worker


class FakeWorker(SimpleNamespace):
    """What supervision asks of a process."""

    def __init__(self, name: str, target: str) -> None:
        super().__init__(is_running=True, processor_s=0.0, pid=0, messages=["answer"])
        self.kill = lambda: None
        self.send = lambda message: None

    def receive(self) -> list[str]:
        return [self.messages.pop()] if self.messages else []


@pytest.mark.parametrize(
    ("silent_s", "used_s", "hangs"),
    [
        (19, 0.0, False),
        (25, 0.0, True),  # stopped, or waits for ever
        (25, 24.0, True),  # an endless loop
        (25, 3.0, False),  # it works, but beside many others
        (190, 15.0, False),
        (190, 1.0, False),  # beside ten others, of which all come first
        (190, 0.3, True),
        (590, 15.0, False),
        (610, 15.0, True),
    ],
)
def test_silence_counts_by_the_processor_time_that_was_used(
    monkeypatch: pytest.MonkeyPatch, silent_s: float, used_s: float, hangs: bool
) -> None:
    clock = Clock()
    monkeypatch.setattr(supervision, "time", clock)
    monkeypatch.setattr(supervision, "Worker", FakeWorker)
    worker = SupervisedWorker("mapper", "m:f", (), RestartPolicy(answer_s=20.0))
    assert worker.receive() == ["answer"]
    worker._worker.processor_s = 7.0
    worker.send("work", begins=True)
    worker._worker.processor_s += used_s
    clock.pass_s(silent_s)
    assert not worker.restart_if_needed(busy=False)
    assert worker.restart_if_needed(busy=True) == hangs
    assert worker.crashes == hangs


def test_what_comes_with_the_first_message_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the masks of an image that was sent while the network was loading."""
    monkeypatch.setattr(supervision, "Worker", FakeWorker)
    worker = SupervisedWorker("segmenter", "m:f", (), RestartPolicy())
    batches = [["later"], [Ready(("chair",)), "masks", "more masks"], []]
    monkeypatch.setattr(worker._worker, "receive", lambda *_: batches.pop())
    assert worker.wait_until_ready().labels == ("chair",)
    assert worker.receive() == ["masks", "more masks", "later"]


def test_why_a_process_has_died_is_said_also_if_it_comes_last(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its end may be seen before its last message has been read."""
    monkeypatch.setattr(supervision, "Worker", FakeWorker)
    worker = SupervisedWorker("segmenter", "m:f", (), RestartPolicy())
    process = worker._worker
    assert isinstance(process, FakeWorker)
    process.is_running, process.messages = False, []
    process.kill = lambda: process.messages.append(Failure("OSError: no space"))
    assert worker.receive() == []
    assert worker.restart_if_needed(busy=True)
    assert "the segmenter failed: OSError: no space" in caplog.text


def use_processor(channel: Channel) -> None:
    """Work, then answer each message with the processor's time that was used, until killed."""
    while time.process_time() < 0.3:
        pass
    channel.send("worked")
    for _ in channel.messages():
        channel.send(time.process_time())


def test_the_processor_time_of_a_worker_is_the_systems() -> None:
    worker = Worker("child", f"{__name__}:use_processor")
    try:
        wait_until(lambda: worker.receive(0.1))
        worker.send("stop")
        (used_s,) = worker.receive(LONG_S)
        assert used_s == pytest.approx(worker.processor_s, abs=0.1)
    finally:
        worker.kill()
    assert worker.processor_s == 0
