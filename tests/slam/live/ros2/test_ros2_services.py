"""Services over DDS: save_map, reset and localise_only, and the dense cloud."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from ros2_processes import LOOPBACK, begin_process
from test_ros2_maps import T_MAP_WORLD, Run, room, some_objects
from test_ros2_sensors import StandIn

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose, se3_exp, transform
from bmask_slam.live.messages import MapSaved
from bmask_slam.live.play import finishing
from bmask_slam.live.ros2 import services as services_module
from bmask_slam.live.ros2.dds import CALL_BYTES, HEADER_BYTES, DdsService, carried_type
from bmask_slam.live.ros2.grid import LiveCloud
from bmask_slam.live.ros2.outputs import Robot, Ros2Frames
from bmask_slam.live.ros2.publisher import Ros2Publisher
from bmask_slam.live.ros2.services import ENDED, SAVE_S, Ros2Services
from bmask_slam.live.ros2.transport import encoded, typestore
from bmask_slam.run_folder.map_file import read_map
from bmask_slam.tracking.results import FrameResult, TrackingStatus

DOMAIN, FRAMES = 78, 50
TRIGGER, SET_BOOL = (typestore().types[f"std_srvs/srv/{n}_Request"] for n in ("Trigger", "SetBool"))


class Call:
    """Stands in for a request."""

    def __init__(self, message: Any) -> None:
        self.message, self.answers = message, []  # type: ignore[var-annotated]

    def reply(self, message: Any) -> None:
        self.answers.append((message.success, message.message))


class Served(SimpleNamespace):
    """Stands in for a `LiveSlam`: one without a map refuses to be only located in."""

    has_map, saved, out = True, (), Path("/run")

    @property
    def extends(self) -> bool:
        return self.mode

    @extends.setter
    def extends(self, extends: bool) -> None:
        if not self.has_map:
            raise InputError("there is no map yet")
        self.mode = extends

    def save_map(self, path: Path) -> None:
        self.path = path

    def saved_maps(self) -> list[MapSaved]:
        found, self.saved = list(self.saved), ()
        return found


def node() -> Any:
    """A node whose services are lists of calls, by their names."""
    made = StandIn()
    made.calls = {}

    def service(name: str, kind: str) -> Any:
        waiting = made.calls.setdefault(name.rpartition("/")[2], [])

        def take() -> list[Call]:
            taken = list(waiting)
            waiting.clear()
            return taken

        return SimpleNamespace(take=take)

    made.service = service
    return made


def test_localise_only_is_refused_without_a_map() -> None:
    ros, run = node(), Served(has_map=False)
    services, on, off = Ros2Services(ros, "/x"), Call(SET_BOOL(True)), Call(SET_BOOL(False))
    ros.calls["localise_only"] += [on]
    assert not services.serve(run)
    assert on.answers == [(False, "there is no map yet")]
    run.has_map = True
    ros.calls["localise_only"] += [Call(SET_BOOL(True)), off]
    services.serve(run)
    assert (run.extends, off.answers[0][0]) == (True, True)


def test_a_map_is_saved_or_it_is_said_why_not(monkeypatch) -> None:
    ros, run, now = node(), Served(), SimpleNamespace(s=0.0)
    monkeypatch.setattr(services_module, "time", SimpleNamespace(monotonic=lambda: now.s))
    services, calls = Ros2Services(ros, "/x"), [Call(TRIGGER(0)) for _ in range(5)]
    ros.calls["save_map"] += calls[:1]
    services.serve(run)
    assert (run.path, calls[0].answers) == (Path("/run/map"), [])
    run.saved = (MapSaved(run.path),)
    services.serve(run)
    assert calls[0].answers == [(True, "/run/map")]
    ros.calls["save_map"] += calls[1:2]
    services.serve(run)
    run.saved = (MapSaved(run.path, "the disk is full"),)
    services.serve(run)
    assert calls[1].answers == [(False, "the disk is full")]
    ros.calls["save_map"] += calls[2:3]
    services.serve(run)
    now.s = SAVE_S + 1
    services.serve(run)
    assert calls[2].answers == [(False, "the map's process does not answer")]
    run.out = None
    ros.calls["save_map"] += calls[3:4]
    services.serve(run)
    assert calls[3].answers == [(False, "the run has no folder")]
    run.out = Path("/run")
    ros.calls["save_map"] += calls[4:]
    reset = Call(TRIGGER(0))
    ros.calls["reset"] += [reset]
    assert services.serve(run)
    assert (services.reset_asked, reset.answers) == (True, [])
    services.begin(Path("a"), Path("b"))
    assert not services.reset_asked
    assert reset.answers == [(True, "the run until now is in a, the new one in b")]
    assert calls[4].answers == [(False, "the run ended before its map was saved")]


def test_an_answer_that_came_too_late_is_none_of_the_next_call() -> None:
    """Also one that a process which was started again has given a second time."""
    ros, run = node(), Served(saved=[MapSaved(Path("/run/map"))])
    services, call = Ros2Services(ros, "/x"), Call(TRIGGER(0))
    ros.calls["save_map"] += [call]
    services.serve(run)
    services.serve(run)
    assert (run.path, call.answers) == (Path("/run/map"), [])
    run.saved = [MapSaved(Path("/run/map"), "the disk is full")]
    services.serve(run)
    assert call.answers == [(False, "the disk is full")]


def test_many_calls_save_few_maps() -> None:
    """The map's process is kept busy by nobody; each answer is of a map saved after its call."""
    ros, run, asked = node(), Served(), []  # type: ignore[var-annotated]
    run.save_map = asked.append
    services, calls = Ros2Services(ros, "/x"), [Call(TRIGGER(0)) for _ in range(101)]
    ros.calls["save_map"] += calls[:1]
    services.serve(run)
    for call in calls[1:]:
        ros.calls["save_map"] += [call]
        services.serve(run)
    assert asked == [Path("/run/map")]
    run.saved = (MapSaved(asked[0]),)
    services.serve(run)
    assert [len(call.answers) for call in calls] == [1] + 100 * [0]
    assert len(asked) == 2
    run.saved = (MapSaved(asked[1]),)
    services.serve(run)
    assert {tuple(call.answers) for call in calls} == {((True, "/run/map"),)}
    assert len(asked) == 2


def test_who_waits_at_the_end_is_answered(tmp_path: Path) -> None:
    for folder, answer in ((tmp_path, (True, str(tmp_path / "map"))), (None, (False, ENDED))):
        (tmp_path / "map").touch()
        ros, run = node(), Served(out=tmp_path)
        services = Ros2Services(ros, "/x")
        save, reset, late = (Call(TRIGGER(0)) for _ in range(3))
        ros.calls["save_map"] += [save]
        services.serve(run)
        ros.calls["reset"] += [reset]
        services.serve(run)
        ros.calls["save_map"] += [late]
        only = Call(SET_BOOL(True))
        ros.calls["localise_only"] += [only]
        services.end(folder)
        assert save.answers == [answer]
        assert reset.answers == late.answers == only.answers == [(False, ENDED)]


def test_a_call_has_its_number_before_its_fields() -> None:
    """As rmw_cyclonedds' cdds_request_header_t: uint64 guid, int64 sequence number."""
    name, sent = "std_srvs/srv/SetBool", []
    writer = SimpleNamespace(send_bytes=sent.append)
    answer = typestore().types[f"{name}_Response"](True, "yes")
    number = (7).to_bytes(8, "little") + (9).to_bytes(8, "little")
    data = encoded(SET_BOOL(True), f"{name}_Request")
    received = [data[:HEADER_BYTES] + number + data[HEADER_BYTES:], data[:HEADER_BYTES] + number]
    reader = SimpleNamespace(take_bytes=lambda: received)
    end: Any = DdsService((f"{name}_Request", f"{name}_Response"), reader, writer)
    (request,) = end.take()  # the second has no fields
    assert request.message.data
    request.reply(answer)
    assert sent == [b"\0\1\0\0" + number + b"\1\0\0\0\4\0\0\0yes\0"]
    idl = carried_type(f"{name}_Response")
    assert idl.__idl__.idl_transformed_typename == "std_srvs::srv::dds_::SetBool_Response_"
    assert len(number) == CALL_BYTES


def test_a_second_process_calls_each_service(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    calls = ["localise_only=on", "save_map", "localise_only=off", "reset"]
    with begin_process("ros2_player", DOMAIN, 20, tmp_path / "heard", *calls) as player:
        out = tmp_path / "run"
        options = ("--segmenter", "none", "--calibrate", "off", "--quiet", "--silence", "60")
        options += ("--reliable",)  # on a full machine of best effort hardly an image is whole
        frames = ("--max-frames", str(FRAMES))
        code = main(["live", f"ros2:{DOMAIN}", "--out", str(out), *frames, *options])
        player.communicate(timeout=60)
        assert (code, player.returncode) == (0, 0)
    answers = json.loads((tmp_path / "heard").read_text())["answers"]
    assert [a["name"] for a in answers] == [call.partition("=")[0] for call in calls]
    assert all(a["success"] for a in answers)
    assert answers[1]["text"] == str(out / "map")
    assert read_map(out)[0]["mapper.world.keyframes.id"].tolist()
    assert f"{out}-2" in answers[3]["text"]
    for folder in (out, tmp_path / "run-2"):
        assert (folder / "trajectory.txt").exists()
        assert len((folder / "frames.csv").read_text().splitlines()) > 3


def test_the_cloud_follows_its_keyframes_and_is_thinned() -> None:
    cloud = LiveCloud(T_MAP_WORLD, 0.1)
    assert cloud.cloud({4: np.eye(4)}) is None
    points = np.array([[0.0, 0.0, 2.0], [0.001, 0.001, 2.001], [1.0, 0.0, 2.0]], np.float32)
    red, blue = (
        np.full((3, 3), 0, np.uint8) + np.array(c, np.uint8) for c in ([9, 0, 0], [0, 0, 9])
    )
    cloud.add(4, points, red)
    T = se3_exp(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    found, colours = cloud.cloud({4: T})
    expected = transform(T_MAP_WORLD @ T, points.astype(float))
    assert len(found) == len(colours) == 2
    assert all(np.abs(expected - p).sum(axis=1).min() < 1e-6 for p in found)
    cloud.add(5, points, blue)
    found, colours = cloud.cloud({4: T, 5: T, 6: T})
    assert len(found) == 2
    assert colours[:, 2].tolist() == [9, 9]  # the newest
    assert cloud.cloud({6: T}) is None  # the keyframes were culled


class Ending(Run):
    """A run that makes a submap when it is closed, as the last dense map does."""

    out = Path("/nowhere/run")

    def __enter__(self) -> Ending:
        return self

    def __exit__(self, *_: object) -> None:
        self.listeners[0](4, room(2.02), np.zeros((len(room(2.02)), 3), np.uint8))


def test_everything_is_published_when_the_source_falls_silent() -> None:
    ros, run = node(), Ending()
    publish = Ros2Publisher(ros, Ros2Frames(), Robot(T_MAP_WORLD, True))
    services, call = Ros2Services(ros, "/x"), Call(TRIGGER(0))
    with pytest.raises(InputError, match="no frame"), finishing(run, publish, services) as slam:
        publish(FrameResult(0, 5.0, TrackingStatus.OK, np.eye(4)), slam)
        ros.calls["save_map"] += [call]
        raise InputError("no frame for 10 s")
    assert ros.topics["/bmask_slam/cloud"][-1].width > 100
    assert ros.topics["/bmask_slam/map"][-1].info.width > 20
    assert call.answers == [(False, ENDED)]


def test_another_run_begins_with_an_empty_map() -> None:
    ros, publish = node(), None
    publish = Ros2Publisher(ros, Ros2Frames(), Robot(T_MAP_WORLD, True))
    first, second = Run(), Run()
    first.objects = some_objects  # type: ignore[method-assign]
    second.objects = lambda: None  # type: ignore[assignment, return-value, method-assign]
    result = FrameResult(0, 5.0, TrackingStatus.OK, np.eye(4), 0)
    publish(result, first)
    first.listeners[0](4, room(2.02), np.zeros((len(room(2.02)), 3), np.uint8))
    assert publish._making is not None
    publish._making.result(10)
    publish._make_grid(5.0, {4: make_pose(np.eye(3), np.zeros(3))})
    assert ros.topics["/bmask_slam/cloud"][-1].width >= 1
    assert ros.topics["/bmask_slam/map"][-1].info.width > 20
    publish(result, second)
    assert ros.topics["/bmask_slam/cloud"][-1].width == 0
    assert ros.topics["/bmask_slam/map"][-1].data.tolist() == [-1]
    assert [len(m.markers) for m in ros.topics["/bmask_slam/object_markers"]] == [3, 1]
