"""How often the live loop writes its trajectory."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live import recorder
from bmask_slam.live.health import Health
from bmask_slam.live.recorder import SNAPSHOT_S, SNAPSHOT_SHARE, Recorder

NOTHING = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(recorder, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    return clock


def written(clock: SimpleNamespace, cost_s: float, error: Exception | None = None) -> list[float]:
    """Times at which a trajectory is written if this takes so long; 300 s at 10 Hz."""
    times: list[float] = []

    def write(_: Trajectory) -> None:
        times.append(clock.now_s)
        clock.now_s += cost_s
        if error is not None:
            raise error

    folder = SimpleNamespace(
        write_frame=lambda _: None, write_trajectory=write, write_text=lambda *_: None, path="run"
    )
    keeper = Recorder(folder)
    end_s = clock.now_s + 300
    while clock.now_s < end_s:
        keeper.frame(None, Health, lambda: NOTHING)
        clock.now_s += 0.1
    return times


def test_a_short_trajectory_is_written_every_few_seconds(clock: SimpleNamespace) -> None:
    assert np.diff(written(clock, 0.0)) == pytest.approx(SNAPSHOT_S, abs=0.11)


def test_a_long_trajectory_is_written_less_often(clock: SimpleNamespace) -> None:
    times = written(clock, 0.3)
    assert len(times) > 3
    assert np.diff(times) == pytest.approx(0.3 / SNAPSHOT_SHARE, abs=0.11)


def test_a_full_disk_is_not_retried_sooner(clock: SimpleNamespace) -> None:
    times = written(clock, 0.0, OSError(28, "No space left on device"))
    assert np.diff(times) == pytest.approx(SNAPSHOT_S, abs=0.11)


@pytest.mark.parametrize("error", [MemoryError(), ValueError("no such letter"), InputError("full")])
def test_whatever_a_file_raises_tracking_goes_on_and_it_is_said(clock, error, caplog) -> None:
    assert len(written(clock, 0.0, error)) > 50
    texts = [record.getMessage() for record in caplog.records]
    assert len(texts) == 5 and all("tracking goes on" in text for text in texts)
    assert type(error).__name__ in caplog.text or str(error) in texts[0]
