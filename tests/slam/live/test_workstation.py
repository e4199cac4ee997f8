"""The map and masks on another machine: who is admitted, the same result, and the way back."""

from __future__ import annotations

import os
import pickle
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from faults import Clock
from feeding import track_frames
from synthetic_view import CAMERA
from test_live_faults import CONFIG, FRAMES, label_image
from test_map_process import keyframe

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import read_arrays
from bmask_slam.live.channel import END
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.messages import (
    STATE_FILE,
    Finish,
    ImageToSegment,
    MapSaved,
    Masks,
    Ready,
    Resent,
    SaveMap,
    SaveState,
    Started,
    StateSaved,
)
from bmask_slam.live.network import server as server_module
from bmask_slam.live.network.carrying import PIECE, CarriedFiles, FilePiece, Outbox, store
from bmask_slam.live.network.connection import (
    Connection,
    Keys,
    admit,
    introduce,
    make_token,
    read_token,
)
from bmask_slam.live.network.server import WorkstationServer
from bmask_slam.live.network.workstation import Workstation
from bmask_slam.live.processes import map_return, map_worker, supervision
from bmask_slam.live.processes.map_process import MapServer
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.processes.map_worker import MapWorker
from bmask_slam.live.processes.segmentation import RemoteSegmenter
from bmask_slam.live.processes.worker import Failure, WorkstationAwayError
from bmask_slam.semantics.labels import read_label_set
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.world.frame_history import ENTRY

TOKEN = b"a token for the tests only"
NONE = np.zeros(0, ENTRY)


def until(holds: Callable[[], Any], timeout_s: float = 60.0) -> None:
    """Wait until something holds."""
    end_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def both_ends() -> tuple[socket.socket, socket.socket]:
    """Two ends of a connection of TCP."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        one = socket.create_connection(server.getsockname())
        return one, server.accept()[0]


class Cut:
    """Between robot and workstation: hands bytes on, until it is cut; refuses while ``away``."""

    def __init__(self, port: int) -> None:
        self._end = socket.create_server(("127.0.0.1", 0))
        self.port, self._to = self._end.getsockname()[1], port
        self.away = False
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """The workstation goes away."""
        self.away = True
        for end in self._ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._end.close()
        self.cut()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                end = self._end.accept()[0]
                if self.away:
                    end.close()
                    continue
                other = socket.create_connection(("127.0.0.1", self._to))
                self._ends += [end, other]
                for one, two in ((end, other), (other, end)):
                    threading.Thread(target=self._hand_on, args=(one, two), daemon=True).start()

    def _hand_on(self, one: socket.socket, two: socket.socket) -> None:
        with suppress(OSError):
            while data := one.recv(1 << 16):
                two.sendall(data)
            two.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def cut() -> Iterator[Cut]:
    """A workstation behind a connection that can be cut."""
    server = WorkstationServer("127.0.0.1", 0, TOKEN)
    thread = threading.Thread(target=server.serve)
    thread.start()
    with closing(server), closing(Cut(server.port)) as between:
        yield between
        server._closed.set()
        thread.join(10)


def workstation(cut: Cut, token: bytes = TOKEN) -> Workstation:
    return Workstation("127.0.0.1", cut.port, token)


# --- who is admitted -----------------------------------------------------------------------------


def test_only_who_knows_the_token_is_admitted(cut, monkeypatch) -> None:
    started: list[Any] = []
    monkeypatch.setattr(server_module, "_started", lambda *_: started.append(1))
    with pytest.raises(InputError, match="another token"):
        workstation(cut, b"another token of the tests").worker("map", ())
    with socket.create_connection(("127.0.0.1", cut.port)) as end:
        end.sendall(b"GET / HTTP/1.0\r\n".ljust(200))  # what it sends is never unpickled
        assert end.recv(1000).startswith(b"bmask-slam ")  # and the end, or nothing more
    assert not started
    cut.away = True
    with pytest.raises(InputError, match="cannot be reached"):
        workstation(cut).worker("map", ())


def test_who_is_silent_is_dropped(cut, monkeypatch) -> None:
    monkeypatch.setattr(server_module, "HANDSHAKE_S", 0.2)
    with socket.create_connection(("127.0.0.1", cut.port)) as end:
        end.settimeout(10)
        assert end.recv(1) == b""


def test_who_is_silent_keeps_nobody_out(cut) -> None:
    """Strangers that hold all places, and come again."""
    address = "127.0.0.1", cut._to
    with ExitStack() as strangers:
        for _ in range(3 * server_module.MAX_HANDSHAKES):
            strangers.enter_context(socket.create_connection(address))
        with socket.create_connection(address) as end:
            end.settimeout(60)
            assert introduce(end, TOKEN).sending


def test_another_version_is_said() -> None:
    one, two = both_ends()
    two.sendall(b"bmask-slam 8".ljust(64, b"\0"))
    with pytest.raises(InputError, match=r"'bmask-slam 8'.*install the same"):
        introduce(one, TOKEN)
    one.close()
    two.close()


def test_messages_arrive_and_changed_ones_end_the_connection() -> None:
    one, two = both_ends()
    admitted: list[Any] = []
    thread = threading.Thread(target=lambda: admitted.append(admit(two, TOKEN)))
    thread.start()
    keys = introduce(one, TOKEN)
    thread.join()
    sender, receiver = Connection(one, keys), Connection(two, admitted[0])
    large = np.arange(30_000).tobytes()
    sender.send((b"pickle", [large, memoryview(b"")]))
    assert receiver.recv() == (b"pickle", [large, b""])
    assert receiver.received_bytes == sender.sent_bytes < len(large)  # compressed
    before = one.fileno()
    kept: list[bytes] = []
    tap = SimpleNamespace(sendall=lambda data: kept.append(bytes(data)), fileno=lambda: before)
    sender._end = tap
    sender.send((b"second", []))
    for data in (b"".join(kept), b"".join(kept)):
        one.sendall(data)  # the second time it is a replay
    assert receiver.recv() == (b"second", [])
    with pytest.raises(ConnectionAbortedError, match="not sent"):
        receiver.recv()


def test_tokens(tmp_path: Path) -> None:
    path = tmp_path / "config" / "token"
    with pytest.raises(InputError, match="copy the token"):
        read_token(path)
    make_token(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(read_token(path)) > 40
    found = Workstation.of("[::1]:99", path)
    assert (found.host, found.port) == ("::1", 99)
    assert str(read_token(path)) not in repr(found)
    path.write_text("short")
    with pytest.raises(InputError, match="not safe"):
        Workstation.of("host", path)
    with pytest.raises(InputError, match="no address"):
        Workstation.of("host:port", path)


@pytest.mark.parametrize(
    ("address", "host", "port"),
    [
        ("::1", "::1", 7717),
        ("[::1]", "::1", 7717),
        ("[fe80::1%eth0]:80", "fe80::1%eth0", 80),
        ("fe80::1:2", "fe80::1:2", 7717),
        ("robot", "robot", 7717),
        ("10.0.0.1:80", "10.0.0.1", 80),
    ],
)
def test_addresses_have_a_host_and_a_port(tmp_path: Path, address: str, host: str, port) -> None:
    make_token(tmp_path / "token")
    found = Workstation.of(address, tmp_path / "token")
    assert (found.host, found.port) == (host, port)


@pytest.mark.parametrize("address", ["", ":80", "[]:80", "[::1", "[::1]80", "a:", "a:0", "a:65536"])
def test_what_is_no_address_is_refused(tmp_path: Path, address: str) -> None:
    make_token(tmp_path / "token")
    with pytest.raises(InputError, match=r"no address; write HOST or HOST:PORT, as \[::1\]:7717"):
        Workstation.of(address, tmp_path / "token")


def test_the_command_makes_a_token_and_listens(tmp_path, monkeypatch, capsys) -> None:
    served: list[Any] = []
    monkeypatch.setattr(WorkstationServer, "serve", lambda self, ends: served.append(ends()))
    path = tmp_path / "token"
    assert main(["workstation", "--port", "0", "--token-file", str(path)]) == 0
    assert served == [False]
    assert "listening on 127.0.0.1:" in capsys.readouterr().out
    assert main(["live", str(tmp_path), "--workstation", "a:b", "--token-file", str(path)]) == 1


def test_a_name_that_is_none_of_a_host_is_said(tmp_path: Path) -> None:
    for host in ("a..b", "a" * 70):
        with pytest.raises(InputError, match="cannot be reached"):
            Workstation(host, 1, TOKEN).worker("map", ())
        with pytest.raises(InputError, match=host):
            WorkstationServer(host, 0, TOKEN)


def test_a_workstation_outlives_a_lack_of_descriptors(caplog) -> None:
    server = WorkstationServer("127.0.0.1", 0, TOKEN)
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    thread = threading.Thread(target=server.serve)
    with closing(server), socket.socket() as end:
        end.connect(("127.0.0.1", server.port))
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        try:
            thread.start()
            until(lambda: "nobody can be admitted" in caplog.text or not thread.is_alive())
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        assert thread.is_alive()
        keys = introduce(end, TOKEN)
        assert keys.sending != keys.receiving
    thread.join(60)
    assert not thread.is_alive()


def test_a_process_without_its_keys_reads_nothing() -> None:
    one, two = both_ends()
    code = f"from bmask_slam.live.network.server import work; work({two.fileno()})"
    child = subprocess.Popen(
        [sys.executable, "-c", code], pass_fds=[two.fileno()], stdin=subprocess.DEVNULL
    )
    two.close()
    with one:
        Connection(one, Keys(b"", b"")).send((pickle.dumps(("map", (), None)), []))
        assert child.wait(60) == 0
        with suppress(ConnectionResetError):  # it has left everything unread
            assert one.recv(1) == b""  # else it would have answered with a failure


def test_connections_that_have_ended_keep_no_descriptor(cut) -> None:
    there = workstation(cut)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2):
        end = there.worker("nothing", ())
        until(lambda end=end: not end.is_running)
        assert end.receive()
        end.kill()
    cut.cut()
    until(lambda: all(one.fileno() < 0 for one in there.traffic.connections))
    sent = there.traffic.sent_bytes
    cut.away = False
    there.worker("nothing", ()).kill()
    assert len(there.traffic.connections) == 1
    assert there.traffic.sent_bytes >= sent > 0 < there.traffic.received_bytes
    for end in cut._ends:
        end.close()
    until(lambda: len(os.listdir("/proc/self/fd")) <= before)


def test_no_connection_is_opened_for_a_state_that_is_gone(cut, tmp_path: Path) -> None:
    there = workstation(cut)
    with pytest.raises(InputError, match="no such file"):
        there.worker("map", (), tmp_path / "state")
    assert not there.traffic.connections


# --- files ---------------------------------------------------------------------------------------


def test_files_wait_for_messages_and_a_newer_one_takes_their_place() -> None:
    box, path = Outbox(), Path("state")
    old, new, other = (FilePiece(p, 0, NONE) for p in (path, path, Path("map")))
    for item in (old, replace(old, begin=9), other, 1, END, new, 2):
        box.put(item)
    assert [box.get() for _ in range(5)] == [1, 2, other, new, END]


def test_files_of_the_map_are_carried_to_the_robots_paths(tmp_path: Path) -> None:
    here, robot, sent = tmp_path / "workstation", tmp_path / "state", []
    here.mkdir()
    asked = [
        (1, SaveState(robot)),
        (2, SaveMap(tmp_path / "map")),
        (3, Finish(robot, NONE)),
        (4, 5),
    ]
    channel: Any = SimpleNamespace(send=sent.append, messages=lambda: iter(asked))
    files = CarriedFiles(channel, here)
    (_, save), (_, as_map), (_, finish), other = files.messages()
    assert other == (4, 5)
    assert {save.path.parent, as_map.path.parent, finish.path.parent} == {here}
    data = np.random.default_rng(0).bytes(PIECE + 5)
    save.path.write_bytes(data)
    files.send(StateSaved(1, save.path))
    files.send(MapSaved(as_map.path, "no space"))
    files.send("other")
    assert sent[2:] == [MapSaved(tmp_path / "map", "no space"), "other"]
    assert store(sent[0], str) is None
    assert not robot.exists()
    assert store(sent[1], str) == StateSaved(1, robot)
    assert robot.read_bytes() == data
    lost = replace(sent[1], path=tmp_path / "gone" / "state")
    assert store(lost, lambda error: error.errno) == 2


def test_a_file_that_lacks_a_piece_gets_no_name(tmp_path: Path) -> None:
    """The disk was full for a while."""
    path, one = tmp_path / "state", np.ones(1000, np.uint8)
    pieces = [FilePiece(path, 1000 * k, one, "saved" if k == 2 else None) for k in range(3)]
    assert store(pieces[0], str) is None
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        assert store(pieces[1], str) is None
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "No such file" in store(pieces[2], str)
    assert not list(tmp_path.iterdir())


# --- the map's process, with stand-ins -----------------------------------------------------------


class End:
    """Stands in for a worker: what was sent to it, and what it answers."""

    pid, processor_s, was_killed = 1, 0.0, True

    def __init__(self, *given: Any) -> None:
        self.given, self.sent, self.answers, self.is_running = given, [], [], True  # type: ignore[var-annotated]

    def send(self, message: Any) -> None:
        self.sent.append(message)

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        time.sleep(0 if self.answers else min(timeout_s, 0.02))
        found = list(self.answers)
        self.answers.clear()
        return found

    def kill(self) -> None:
        self.is_running = False

    stop = kill


@dataclass(eq=False)
class Away:
    """Stands in for a workstation, and keeps the workers of both machines."""

    there: list[End]
    here: list[End]
    away: bool = False
    refusals: int = 0

    def worker(self, name: str, arguments: Any, state: Path | None = None) -> End:
        if self.refusals and not self.away:
            self.refusals -= 1
            raise InputError(f"another token, {name}")
        if self.away:
            raise WorkstationAwayError("away")
        self.there.append(End(name, arguments, state))
        return self.there[-1]

    def is_reachable(self) -> bool:
        return not self.away


@pytest.fixture
def machines(monkeypatch) -> Away:
    """Both machines, without processes."""
    found = Away([], [])

    def start(*given: Any) -> End:
        found.here.append(End(*given))
        return found.here[-1]

    monkeypatch.setattr(map_worker, "Worker", start)
    monkeypatch.setattr(map_return, "RETRY_S", 0.02)
    monkeypatch.setattr(supervision, "RETRY_S", 0.02)
    return found


def test_the_map_goes_on_here_and_back_with_all_messages(machines, tmp_path: Path) -> None:
    worker = MapWorker(("a",), lambda message: None, MapPlace(tmp_path, machines))
    first = machines.there[0]
    assert (worker.workstation, first.given[1:]) == ("connected", (("a", 0), None))
    worker.send("one")
    worker.send("two")
    first.answers += [Ready(), StateSaved(1, tmp_path / "s1"), Started(2), "late"]
    assert worker.receive() == ["late"]
    machines.away, first.is_running = True, False
    assert worker.has_crashed
    worker.receive_last()
    worker.restart()
    assert (worker.workstation, worker.losses, worker.crashes) == ("away", 1, 0)
    here = machines.here[0]  # it was started before, and has waited
    assert here.sent == [("a", tmp_path / "s1", 2), (2, "two")]
    worker.send("three")
    machines.away = False
    until(lambda: worker.receive() or len(here.sent) > 3)
    number, save = here.sent[-1]
    assert (number, type(save)) == (4, SaveState)
    worker.send("five")
    here.answers += [StateSaved(4, save.path), StateSaved(5, tmp_path / "s5")]
    worker.receive()
    worker.send("six")
    until(lambda: len(machines.there) > 1)
    back = machines.there[1]
    assert back.given == ("map", ("a", 0), save.path)
    back.answers += ["before", Ready(), "first"]
    here.answers.append("last of here")
    found: list[Any] = []
    until(lambda: found.extend(worker.receive()) or worker.workstation == "connected")
    assert found == ["last of here"]
    assert worker.receive() == ["before", "first"]
    assert not here.is_running
    assert back.sent == [(0, Resent(6)), (5, "five"), (6, "six")]  # since the state that it has
    back.is_running = False
    worker.restart()  # from the newer state, which contains 5
    assert machines.here[1].sent == [("a", tmp_path / "s5", 6), (6, "six")]
    worker.kill()


def test_a_failure_there_counts_and_the_end_stays_here(machines, tmp_path: Path) -> None:
    worker = MapWorker((), lambda message: None, MapPlace(tmp_path, machines))
    worker.send("bad")
    machines.there[0].answers += [Ready(), Started(1)]
    worker.receive()
    machines.there[0].is_running = machines.there[0].was_killed = False
    machines.away = True
    worker.restart()
    assert (worker.crashes, worker.losses) == (1, 0)
    worker.send(Finish(tmp_path / "final", NONE))
    machines.away = False
    time.sleep(0.2)
    worker.receive()
    assert len(machines.there) == 1
    assert len(machines.here[0].sent) == 3


def test_a_refusal_later_is_said_and_tried_again(machines, tmp_path, monkeypatch, caplog) -> None:
    """At the start it ends the program."""
    for module in (map_return, supervision):
        monkeypatch.setattr(module, "REFUSED_S", 0.02)
    machines.refusals = 2
    with pytest.raises(InputError, match="another token, map"):
        MapWorker((), lambda message: None, MapPlace(tmp_path, machines))
    with pytest.raises(InputError, match="another token, segmenter"):
        RemoteSegmenter(SegmenterOptions(), tmp_path, workstation=machines)
    machines.away = True
    segmenter = RemoteSegmenter(SegmenterOptions(), tmp_path, workstation=machines)
    machines.refusals, machines.away = 2, False
    with closing(segmenter):
        until(lambda: segmenter.receive_masks() or not segmenter.worker.is_away)
    assert caplog.text.count("another token, segmenter; the segmenter is not used") == 2
    machines.away = True
    worker = MapWorker((), lambda message: None, MapPlace(tmp_path, machines))
    here = machines.here[0]
    machines.refusals, machines.away = 2, False

    def step() -> bool:
        worker.receive()
        here.answers += [StateSaved(number, message.path) for number, message in here.sent]
        here.sent.clear()
        return len(machines.there) > 1

    until(step)
    assert caplog.text.count("another token, map; the map stays here") == 2
    machines.there[-1].answers.append(Ready())
    until(lambda: worker.receive() or worker.workstation == "connected")
    assert (worker.losses, here.is_running) == (0, False)
    worker.kill()


def test_a_map_that_fails_there_is_said_and_not_tried_each_second(
    machines, tmp_path, monkeypatch, caplog
) -> None:
    """Each try saves a state of the whole map here and sends it there."""
    machines.away = True
    worker = MapWorker((), lambda message: None, MapPlace(tmp_path, machines))
    machines.away, here = False, machines.here[0]

    def step() -> bool:
        worker.receive()
        here.answers += [StateSaved(number, message.path) for number, message in here.sent]
        here.sent.clear()
        for there in machines.there:
            there.answers += [Failure("Traceback", "OSError: no space")] * there.is_running
            there.is_running = False
        return "failed: OSError: no space; the map stays here" in caplog.text

    until(step)
    time.sleep(0.3)
    step()
    assert len(machines.there) == 1
    worker.kill()


def test_masks_of_other_classes_are_not_used(machines, tmp_path: Path, caplog) -> None:
    """The workstation was away at the start, and its files name other classes than ours."""
    machines.away = True
    network = SegmenterOptions("mask-scoring-rcnn", weights="some.pth")
    with pytest.raises(InputError, match=r"does not answer.*--labels"):
        RemoteSegmenter(network, tmp_path, workstation=machines)
    for others in ((), ("plant",)):
        machines.away = True
        options = replace(network, labels="paper")
        with closing(RemoteSegmenter(options, tmp_path, workstation=machines)) as segmenter:
            assert segmenter.worker.is_away
            names = read_label_set("paper").names
            assert segmenter.labels.names == names
            segmenter.request(ImageToSegment(0, np.zeros((4, 4, 3), np.uint8), "a.png"))
            machines.away = False
            until(lambda s=segmenter: s.receive_masks() or not s.worker.is_away)
            there = machines.there[-1]
            assert [m.keyframe_id for m in there.sent] == [0]
            there.answers += [Ready((*names, *others)), Masks(0, [], 1.0)]
            assert len(segmenter.receive_masks()) == (not others)
            assert segmenter.worker.given_up == bool(others) != there.is_running
            assert (segmenter.waiting, "has other classes" in caplog.text) == (0, bool(others))


def test_a_slow_segmenter_of_a_workstation_is_not_lost(machines, monkeypatch, tmp_path) -> None:
    """A large network may need half a minute for an image, as nobody here can see."""
    clock = Clock()
    monkeypatch.setattr(supervision, "time", clock)
    start = End.__init__

    def ready(end: End, *given: Any) -> None:
        start(end, *given)
        end.answers.append(Ready(("cup",)))

    monkeypatch.setattr(End, "__init__", ready)
    options = SegmenterOptions("mask-scoring-rcnn", weights="some.pth")
    with closing(RemoteSegmenter(options, tmp_path, workstation=machines)) as segmenter:
        segmenter.request(ImageToSegment(0, np.zeros((4, 4, 3), np.uint8), "a.png"))
        clock.pass_s(60.0)
        assert not segmenter.receive_masks() and not segmenter.worker.is_away
        machines.there[0].answers.append(Masks(0, [], 6e4))
        assert [masks.keyframe_id for masks in segmenter.receive_masks()] == [0]
        segmenter.request(ImageToSegment(1, np.zeros((4, 4, 3), np.uint8), "b.png"))
        clock.pass_s(supervision.DISTANT_S + 1.0)
        segmenter.receive_masks()
        assert (segmenter.worker.crashes, segmenter.worker.is_away) == (0, True)


# --- with processes ------------------------------------------------------------------------------


def messages(folder: Path) -> list[Any]:
    """What tracking sends: four keyframes, a state, and the end."""
    system = SlamSystem(CAMERA)
    last = Finish(folder / "final", NONE)
    made = [keyframe(system, k, (k - 1, np.eye(4)) if k else None) for k in range(4)]
    return [*made[:2], SaveState(folder / "saved"), *made[2:], last]


def test_the_same_map_as_here_also_after_the_workstation_was_lost(
    cut, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(map_return, "RETRY_S", 0.1)
    sent, answers = messages(tmp_path), []  # type: ignore[var-annotated]
    local = MapServer(SlamSystem(CAMERA), answers.append)
    for number, message in enumerate(sent, 1):
        local.handle(number, message)
    expected, saved = (read_arrays(tmp_path / n, STATE_FILE)[1] for n in ("final", "saved"))
    (tmp_path / "final").unlink()
    (tmp_path / "saved").unlink()
    arguments = CAMERA, SystemConfig(), ("background",)
    place = MapPlace(tmp_path, workstation(cut))
    worker = MapWorker(arguments, lambda message: None, place)
    received: list[Any] = []

    def step() -> None:
        received.extend(worker.receive(0.02))
        if worker.has_crashed:
            received.extend(worker.receive_last())
            worker.restart()

    with closing(SimpleNamespace(close=worker.kill)):
        for message in sent[:3]:
            worker.send(message)
        until(lambda: step() or worker.saves == 1)
        found = read_arrays(tmp_path / "saved", STATE_FILE)[1]
        assert found.keys() == saved.keys()
        for name, array in saved.items():  # the same bytes, however they were sent
            if name != "mapper.update_ms":
                np.testing.assert_array_equal(found[name], array, err_msg=name)
        traffic = place.workstation.traffic  # type: ignore[union-attr]
        assert traffic.sent_bytes > 100_000 < traffic.received_bytes
        cut.cut()
        worker.send(sent[3])
        until(lambda: step() or worker.workstation == "away")
        until(lambda: step() or any(getattr(m, "keyframe_id", -1) == 2 for m in received))
        cut.away = False
        until(lambda: step() or worker.workstation == "connected")
        worker.send(sent[4])
        worker.send(sent[5])
        until(lambda: step() or not worker.busy)
    found = read_arrays(tmp_path / "final", STATE_FILE)[1]
    assert found.keys() == expected.keys()
    for name in ("mapper.world.keyframes.T_world_camera", "mapper.world.landmarks.points_world"):
        np.testing.assert_allclose(found[name], expected[name], atol=1e-3)
    assert worker.losses == 1


def test_a_workstation_may_come_after_the_start(cut, tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setattr(map_return, "RETRY_S", 0.1)
    monkeypatch.setattr(supervision, "RETRY_S", 0.1)
    semantics = replace(CONFIG.semantics, segmenter=label_image(tmp_path))
    config = replace(CONFIG, semantics=semantics)
    with pytest.raises(InputError, match="another token"):
        LiveSlam(CAMERA, config, LiveOptions(workstation=workstation(cut, b"a wrong token" * 2)))
    cut.away = True
    caplog.clear()
    with LiveSlam(CAMERA, config, LiveOptions(workstation=workstation(cut))) as slam:
        (said,) = [r.message for r in caplog.records if r.levelname == "WARNING"]
        assert said.startswith(f"the workstation 127.0.0.1:{cut.port} cannot be reached (")
        assert said.endswith("there? The map begins here and goes there once it answers")
        assert set(track_frames(slam, FRAMES[:6])) == {TrackingStatus.OK}
        assert slam.health().workstation == "away"
        assert slam._system.remote.world.landmarks.in_map.any()
        cut.away = False
        until(lambda: slam.catch_up() or slam.health().workstation == "connected")
        assert set(track_frames(slam, FRAMES[6:12])) == {TrackingStatus.OK}
        until(lambda: slam.catch_up() or not slam.health().masks_waiting)
        health = slam.health()
        assert (health.workstation_losses, health.map_deaths, health.segmenter_deaths) == (0, 0, 0)
        assert len(slam._system.segmenter.segmentation_ms) == slam.health().keyframes > 1
    assert "is there again" in caplog.text


def test_masks_come_from_the_workstation_and_later_if_it_was_away(
    cut, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(supervision, "RETRY_S", 0.1)
    options = label_image(tmp_path)
    with closing(RemoteSegmenter(options, tmp_path, workstation=workstation(cut))) as segmenter:
        image = np.zeros((480, 640, 3), np.uint8)
        found: dict[int, Any] = {}

        def step() -> bool:
            found.update({m.keyframe_id: m.instances for m in segmenter.receive_masks()})
            return False

        segmenter.request(ImageToSegment(0, image, "a.png"))
        until(lambda: step() or 0 in found)
        cut.cut()
        until(lambda: step() or segmenter.worker.is_away)
        for number in range(1, 9):
            segmenter.request(ImageToSegment(number, image, "a.png"))
        assert segmenter.worker.crashes == 0
        cut.away = False
        until(lambda: step() or len(found) == 9)
        assert len(found[0]) == len(found[8]) > 0
