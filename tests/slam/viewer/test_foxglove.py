"""What Foxglove gets: an MCAP file read by MCAP's own library, and a websocket's messages."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pytest

from bmask_slam.cli import main
from bmask_slam.commands.arguments import view_options
from bmask_slam.events import Event, EventKind
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer import scene
from bmask_slam.viewer.options import ViewOptions
from bmask_slam.viewer.scene import Scene
from bmask_slam.viewer.shown import Box, Ellipsoid, as_jpeg

pytest.importorskip("foxglove")
T = se3_exp(np.array([0.1, -0.4, 0.2, 1.0, 2.0, 3.0]))
STAMP_S = 1_700_000_000.25
POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
COLOURS = np.array([[255, 0, 10], [20, 30, 40]], np.uint8)


def fill(scene: Scene) -> None:
    scene.log_camera(Camera(640, 480, 525.0, 520.0, 319.5, 239.5))
    scene.set_time(STAMP_S)
    lost = Event(3, STAMP_S, EventKind.LOST, "no match")
    information = np.diag([1e6, 1e6, 1e6, 1e4, 1e4, 1e4])
    result = FrameResult(
        0, STAMP_S, TrackingStatus.OK, T, inliers=7, information=information,
        stage_ms={"tracking": 5.0}, events=(lost,),
    )  # fmt: skip
    rgb = np.full((480, 640, 3), (250, 10, 20), np.uint8)
    scene.log_frame(result, rgb)
    scene.log_points("world/landmarks", POINTS, COLOURS, 0.01)
    scene.log_submap(5, POINTS.astype(np.float32), COLOURS)
    scene.move_submap(5, T)
    scene.log_line("world/trajectory", POINTS, (80, 170, 255))
    scene.log_boxes([Box(OrientedBox(T, np.array([0.2, 0.4, 0.6])), "chair 0.90", COLOURS[0])])
    mask = np.zeros((480, 640), bool)
    mask[100:200, 300:400] = True
    box, surely = np.array([300.0, 100, 400, 200]), np.array([0.1, 0.9])
    instances = [
        Instance(mask, box, 1, surely, 0.9, 0.9),
        Instance(~mask, box, 1, surely, 0.1, 0.1),
    ]
    scene.log_masks(as_jpeg(rgb), instances, ["unknown", "chair"])


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The last message of each topic, and its stamp, as MCAP's library decodes them."""
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    from mcap.reader import make_reader

    path = tmp_path_factory.mktemp("foxglove") / "a.mcap"
    scene = Scene("a", ViewOptions(foxglove_file=path))
    fill(scene)
    scene.close()
    found: dict[str, Any] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                content = reader._decoder_factories[0].decoder_for("protobuf", schema)(message.data)
            key = channel.topic
            if key == "/tf":
                key += f" {content.child_frame_id}"
            found[key] = content, message.log_time
    return found


def test_frames_are_where_the_camera_and_the_submaps_are(messages) -> None:
    for frame in ("camera", "submap_5"):
        transform, log_time = messages[f"/tf {frame}"]
        assert transform.parent_frame_id == "world"
        assert [getattr(transform.translation, a) for a in "xyz"] == pytest.approx(T[:3, 3])
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_quat([getattr(transform.rotation, a) for a in "xyzw"]).as_matrix()
        np.testing.assert_allclose(turn, T[:3, :3], atol=1e-9)
        assert log_time == 1_700_000_000_250_000_000
    pose, _ = messages["/pose"]
    assert (pose.frame_id, pose.pose.position.z) == ("world", pytest.approx(T[2, 3]))
    assert (pose.timestamp.seconds, pose.timestamp.nanos) == (1_700_000_000, 250_000_000)


@pytest.mark.parametrize(("topic", "frame"), [("/landmarks", "world"), ("/submaps/5", "submap_5")])
def test_points_keep_places_and_colours(messages, topic: str, frame: str) -> None:
    cloud, _ = messages[topic]
    assert cloud.frame_id == frame
    offsets = {field.name: field.offset for field in cloud.fields}
    assert offsets == {"x": 0, "y": 4, "z": 8, "red": 12, "green": 13, "blue": 14, "alpha": 15}
    rows = np.frombuffer(cloud.data, [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    assert rows.dtype.itemsize == cloud.point_stride
    np.testing.assert_allclose(rows["xyz"], POINTS)
    np.testing.assert_array_equal(rows["rgba"][:, :3], COLOURS)


def test_objects_have_boxes_and_names(messages) -> None:
    (entity,) = messages["/objects"][0].entities
    (cube,), (text,) = entity.cubes, entity.texts
    assert (cube.size.x, cube.size.y, cube.size.z) == pytest.approx((0.2, 0.4, 0.6))
    assert cube.pose.position.x == pytest.approx(T[0, 3])
    assert text.text == "chair 0.90"


def test_the_path_and_where_the_camera_may_be(messages) -> None:
    (path,) = messages["/trajectory"][0].entities
    assert [p.y for p in path.lines[0].points] == [2.0, 5.0]
    (entity,) = messages["/camera/uncertainty"][0].entities
    assert entity.frame_id == "camera"
    assert entity.spheres[0].size.x == pytest.approx(2 * 3 * 10 * 0.01)  # 3 sigma, enlarged


def test_the_image_its_camera_and_the_masks_fit(messages) -> None:
    image = messages["/camera/image"][0]
    picture = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (240, 320, 3)
    assert np.abs(picture[9, 9].astype(int) - (20, 10, 250)).max() < 8  # blue first
    camera = messages["/camera/calibration"][0]
    assert (camera.width, camera.height, camera.K[0]) == (320, 240, 262.5)
    assert list(camera.K[6:]) == [0, 0, 1]
    masks = messages["/keyframe/masks"][0]
    (outline,), (name,) = masks.points, masks.texts  # the unsure one is left out
    assert name.text == "chair 0.90"
    assert {(p.x, p.y) for p in outline.points} == {
        (150.5, 50.5), (199.5, 50.5), (199.5, 99.5), (150.5, 99.5)
    }  # fmt: skip


def test_plots_and_log(messages) -> None:
    assert messages["/plots/status"][0] == {"status": 2.0}
    assert messages["/plots/ms"][0] == {"tracking": 5.0}
    sigmas = messages["/plots/uncertainty"][0]
    assert sigmas["position_mm"] == pytest.approx(10 * 3**0.5)
    assert sigmas["rotation_0.1deg"] == pytest.approx(np.degrees(1e-3) * 3**0.5 * 10)
    log = messages["/log"][0]
    assert (log.message, log.level) == ("lost: no match", 3)


@pytest.mark.parametrize("seed", range(3))
def test_an_ellipsoid_is_that_of_its_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 1e-3
    found = Ellipsoid.of(np.zeros(3), root @ root.T)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    again = found.rotation @ np.diag((found.half_sizes_m / 30) ** 2) @ found.rotation.T
    np.testing.assert_allclose(again, root @ root.T, atol=2e-11)


# --- the websocket -------------------------------------------------------------------------------


class Client:
    """As much of a websocket client (RFC 6455) as a subscriber needs."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += self._socket.recv(1)
        assert b" 101 " in answer, answer

    def send(self, message: dict[str, Any]) -> None:
        data, key = json.dumps(message).encode(), os.urandom(4)
        masked = bytes(b ^ key[k % 4] for k, b in enumerate(data))
        self._socket.sendall(bytes([0x81, 0xFE]) + struct.pack(">H", len(data)) + key + masked)

    def frames(self) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of each frame."""
        while True:
            first, length = self._read(2)
            if length in (126, 127):
                size = 2 if length == 126 else 8
                length = int.from_bytes(self._read(size), "big")
            yield first & 15, self._read(length)

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            chunk = self._socket.recv(count - len(data))
            assert chunk, "the server ended"
            data += chunk
        return data

    def close(self) -> None:
        self._socket.close()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_a_client_that_comes_later_gets_every_topic(tmp_path: Path) -> None:
    port = free_port()
    scene = Scene("live", ViewOptions(foxglove_port=port))
    assert scene.addresses == [f"in Foxglove (Open connection): ws://127.0.0.1:{port}"]
    fill(scene)
    client = Client(port)
    topics: dict[int, str] = {}
    got: set[str] = set()
    wanted = {"/tf", "/landmarks", "/objects", "/camera/image", "/keyframe/masks", "/trajectory"}
    for opcode, data in client.frames():
        if opcode == 1 and (told := json.loads(data))["op"] == "advertise":
            new = {c["id"]: c["topic"] for c in told["channels"]}
            topics |= new
            client.send(
                {"op": "subscribe", "subscriptions": [{"id": k, "channelId": k} for k in new]}
            )
        elif opcode == 2 and data[0] == 1:
            got.add(topics[struct.unpack_from("<I", data, 1)[0]])
        if wanted <= got:
            break
    scene.set_time(STAMP_S + 1)
    scene.log_numbers("ms", {"tracking": 6.0})  # those are not kept: they come as they are made
    for opcode, data in client.frames():
        if (
            opcode == 2
            and data[0] == 1
            and topics[struct.unpack_from("<I", data, 1)[0]] == "/plots/ms"
        ):
            assert json.loads(data[13:]) == {"tracking": 6.0}
            break
    client.close()
    scene.close()


def test_a_taken_port_and_a_foreign_address(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of 127.0.0.1: .*--foxglove PORT"):
            Scene("a", ViewOptions(foxglove_port=port))
        closing = mock.Mock()
        monkeypatch.setattr(scene.RerunTransport, "close", closing)
        with pytest.raises(InputError, match=f"port {port}"):
            Scene("a", ViewOptions(record=tmp_path / "a.rrd", foxglove_port=port))
        closing.assert_called_once()
    Scene("a", ViewOptions(foxglove_port=free_port(), host="0.0.0.0")).close()
    assert "0.0.0.0: everyone who reaches" in caplog.text


def test_without_foxglove_the_error_names_the_extra(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match=r"pip install 'bmask-slam\[foxglove\]'"):
        Scene("a", ViewOptions(foxglove_file=tmp_path / "a.mcap"))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, ViewOptions(window=True)),
        ("8765", ViewOptions(foxglove_port=8765)),
        ("a/b.MCAP", ViewOptions(foxglove_file=Path("a/b.MCAP"))),
    ],
)
def test_where_view_shows_it(given: str | None, expected: ViewOptions) -> None:
    told: dict[str, Any] = {"record": None, "serve": 0, "host": "127.0.0.1", "foxglove": given}
    assert view_options(Namespace(**told), window=True) == expected


def test_what_is_neither_a_port_nor_a_file_is_refused(capsys) -> None:
    assert main(["view", "run", "--foxglove", "run.rrd"]) == 1
    assert "--foxglove run.rrd: give a port, or a file" in capsys.readouterr().err


# --- whole runs ----------------------------------------------------------------------------------


def topics_of(path: Path) -> dict[str, int]:
    """Messages by topic."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    return {summary.channels[k].topic: count for k, count in counts.items()}


def test_a_finished_run_is_shown_with_its_images_masks_and_uncertainty(
    office: Path, tmp_path: Path, caplog
) -> None:
    run, file = tmp_path / "run", tmp_path / "run.mcap"
    command = ["run", str(office), "--segmenter", "truth", "--max-frames", "10", "--quiet"]
    assert main([*command, "--calibrate", "off", "--out", str(run)]) == 0
    assert main(["view", str(run), "--foxglove", str(file)]) == 0
    found = topics_of(file)
    assert found["/tf"] == found["/plots/status"] == 10
    assert found["/camera/image"] == 10
    assert found["/keyframe/masks"] == found["/keyframe/image"] >= 1
    assert {"/landmarks", "/keyframes", "/trajectory", "/uncertainty", "/objects"} <= set(found)
    assert found["/plots/uncertainty"] == found["/keyframe/image"]
    office_moved = tmp_path / "elsewhere"
    assert main(["view", str(run), "--foxglove", str(file), "--sequence", str(office_moved)]) == 0
    assert "shown without images" in caplog.text
    assert "/camera/image" not in topics_of(file)


def test_live_masks_come_with_the_image_of_their_keyframe(tmp_path: Path) -> None:
    """They arrive later than the image, and those of a keyframe that is not known are left out."""
    from types import SimpleNamespace

    from bmask_slam.labelling.results import MapObjects
    from bmask_slam.live.display import MAX_UNSEGMENTED, Display
    from bmask_slam.live.messages import Masks
    from bmask_slam.semantics.labels import label_set
    from bmask_slam.semantics.objects.publication import MapObject

    names = label_set(("chair",))
    no_ids = np.zeros(0, np.int64)
    chair = MapObject(
        4, 1, np.array([0.2, 0.8]), np.zeros(3), OrientedBox(T, np.ones(3)), no_ids, no_ids, 0, 1
    )
    asked: list[int] = []
    remote = SimpleNamespace(
        changes=0,
        objects=MapObjects(names, [chair], np.array([0, -1.0, 0])),
        ask_for_objects=lambda: asked.append(1),
    )
    system = SimpleNamespace(
        label_names=names.names, mask_listeners=[], segmenter=object(), remote=remote, dense=None
    )
    file = tmp_path / "a.mcap"
    scene = Scene("a", ViewOptions(foxglove_file=file))
    display = Display(scene)
    display.follow(system)
    rgb, mask = np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), bool)
    for k in range(MAX_UNSEGMENTED + 1):
        result = FrameResult(k, STAMP_S + k, TrackingStatus.OK, T, keyframe_id=k)
        display.frame(result, rgb, system)
    seen = Instance(mask, np.array([0.0, 0, 64, 48]), 1, np.array([0.1, 0.9]), 0.9, 0.9)
    (listener,) = system.mask_listeners
    listener(Masks(0, [seen]))  # too old
    listener(Masks(3, [seen]))
    display._show_objects(system)
    display._show_objects(system)  # asked again after OBJECTS_S alone
    scene.close()
    found = topics_of(file)
    assert found["/keyframe/masks"] == found["/keyframe/image"] == 1
    assert found["/objects"] == 1
    assert asked == [1]
