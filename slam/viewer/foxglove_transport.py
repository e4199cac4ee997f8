"""What is shown, in Foxglove: an MCAP file, or a websocket that its app connects to.

Frames: ``world``, ``camera``, ``submap_ID``. A client that comes later gets the last message of
each topic but plots and log.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.viewer.options import LOCAL, ViewOptions, naming
from bmask_slam.viewer.shown import Box, Ellipsoid, Points, SegmentedImage, quaternion

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.mapping.surface.parts import SurfacePart

logger = logging.getLogger(__name__)

WORLD, CAMERA = "world", "camera"
SERIES = {"type": "object", "additionalProperties": {"type": "number"}}
LINE_PX, NAME_PX, OUTLINE_PX, NAME_IN_IMAGE_PX = 2.0, 14.0, 2.0, 12.0
UNCERTAIN = (255, 200, 0)
ALPHA = 0.35
NOT_KEPT = "-"


class FoxgloveTransport:
    """Sends to Foxglove."""

    def __init__(self, name: str, options: ViewOptions) -> None:
        """Open the file, or the websocket.

        Raises:
            InputError: foxglove-sdk is not installed, the port is taken, or the file cannot be
                written.
        """
        self._fg: Any = import_extra("foxglove", "--foxglove", "foxglove")
        self._m: Any = import_extra("foxglove.messages", "--foxglove", "foxglove")
        self._channels: dict[str, Any] = {}
        self._last: dict[str, dict[str, tuple[Any, int]]] = {}
        self._ns = 0
        self._context = self._fg.Context()
        self.address = ""
        self._file = options.foxglove_file
        if self._file is not None:
            with naming(self._file):
                self._sink = self._fg.open_mcap(
                    self._file, allow_overwrite=True, context=self._context
                )
        else:
            self._sink = self._served(name, options.host, options.foxglove_port)

    def _served(self, name: str, host: str, port: int) -> Any:
        if host not in (LOCAL, "localhost"):
            logger.warning("%s: everyone who reaches this address sees the map and images", host)
        listener = _listener(self._fg.ServerListener, self.send_again)
        try:
            server = self._fg.start_server(
                name=name, host=host, port=port, server_listener=listener, context=self._context
            )
        except (RuntimeError, OSError, ValueError, OverflowError) as error:
            cure = "give a free port with --foxglove PORT, and an address of this machine with"
            raise InputError(f"port {port} of {host}: {error}; {cure} --host") from error
        self.address = f"in Foxglove (Open connection): ws://{host}:{server.port}"
        return server

    def send_again(self, topic: str) -> None:
        """Send a topic's last messages, to a client that came later; from any thread."""
        for message, stamp_ns in list(self._last.get(topic, {}).values()):
            self._channels[topic].log(message, log_time=stamp_ns)

    def set_time(self, timestamp_s: float) -> None:
        """See `Transport`."""
        whole_s = math.floor(timestamp_s)  # a stamp of today in ns has more digits than a float
        self._ns = max(10**9 * whole_s + round(1e9 * (timestamp_s - whole_s)), 0)

    def names(self, names: Sequence[str]) -> None:
        """Nothing: Foxglove shows names of boxes and masks, not of points."""

    def camera(self, K: Array, size: tuple[int, int]) -> None:
        """See `Transport`."""
        P = np.column_stack([K, np.zeros(3)])
        calibration = self._m.CameraCalibration(
            timestamp=self._stamp, frame_id=CAMERA, width=size[0], height=size[1],
            K=K.ravel().tolist(), P=P.ravel().tolist(), R=np.eye(3).ravel().tolist(),
            D=[0.0] * 5, distortion_model="plumb_bob",
        )  # fmt: skip
        self._send("/camera/calibration", "CameraCalibration", calibration)

    def pose(self, path: str, T_world_child: Array) -> None:
        """See `Transport`."""
        frame = self._frame(f"{path}/")
        m, (position, orientation) = (
            self._m,
            self._place(T_world_child[:3, 3], T_world_child[:3, :3]),
        )
        transform = m.FrameTransform(
            timestamp=self._stamp, parent_frame_id=WORLD, child_frame_id=frame,
            translation=position, rotation=orientation,
        )  # fmt: skip
        self._send("/tf", "FrameTransform", transform, frame)
        if frame == CAMERA:
            pose = m.Pose(position=position, orientation=orientation)
            here = m.PoseInFrame(timestamp=self._stamp, frame_id=WORLD, pose=pose)
            self._send("/pose", "PoseInFrame", here)

    def image(self, jpeg: bytes) -> None:
        """See `Transport`."""
        self._image("/camera/image", jpeg)

    def _image(self, topic: str, jpeg: bytes) -> None:
        image = self._m.CompressedImage(
            timestamp=self._stamp, frame_id=CAMERA, data=jpeg, format="jpeg"
        )
        self._send(topic, "CompressedImage", image)

    def segmented(self, image: SegmentedImage) -> None:
        """See `Transport`."""
        m = self._m
        self._image("/keyframe/image", image.jpeg)
        outlines = [
            m.PointsAnnotation(
                timestamp=self._stamp, type=m.PointsAnnotationType.LineLoop,
                points=[m.Point2(x=x + 0.5, y=y + 0.5) for x, y in outline.tolist()],
                outline_color=self._colour(seen.colour), thickness=OUTLINE_PX,
                fill_color=self._colour(seen.colour, ALPHA),
            )
            for seen in image.instances
            for outline in seen.outlines
        ]  # fmt: skip
        texts = [
            m.TextAnnotation(
                timestamp=self._stamp, text=seen.text, font_size=NAME_IN_IMAGE_PX,
                position=m.Point2(x=float(seen.box[0]), y=float(max(seen.box[1], 12.0))),
                text_color=self._colour((255, 255, 255)),
                background_color=self._colour((0, 0, 0), 0.6),
            )
            for seen in image.instances
        ]  # fmt: skip
        masks = m.ImageAnnotations(timestamp=self._stamp, points=outlines, texts=texts)
        self._send("/keyframe/masks", "ImageAnnotations", masks)

    def points(self, path: str, shown: Points) -> None:
        """See `Transport`."""
        m, number = self._m, self._m.PackedElementFieldNumericType
        packed = np.zeros(len(shown.points), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
        packed["xyz"], packed["rgba"] = shown.points, 255
        packed["rgba"][:, :3] = shown.colours
        fields = [
            m.PackedElementField(name=n, offset=4 * k, type=number.Float32)
            for k, n in enumerate("xyz")
        ]
        fields += [
            m.PackedElementField(name=n, offset=12 + k, type=number.Uint8)
            for k, n in enumerate(("red", "green", "blue", "alpha"))
        ]
        cloud = m.PointCloud(
            timestamp=self._stamp, frame_id=self._frame(path), point_stride=packed.itemsize,
            pose=self._pose(np.zeros(3), np.eye(3)), fields=fields, data=packed.tobytes(),
        )  # fmt: skip
        self._send(_topic(path), "PointCloud", cloud)

    def _frame(self, path: str) -> str:
        """The frame of a path; a submap's, whose pose may come later, too."""
        if path.startswith("world/submaps/"):
            return f"submap_{path.split('/')[2]}"
        return CAMERA if path.startswith("world/camera/") else WORLD

    def surface(self, path: str, part: SurfacePart) -> None:
        """Nothing: of triangles each vertex is an object here; submaps show the same."""

    def lines(self, path: str, lines: Sequence[Array], colour: Sequence[int]) -> None:
        """See `Transport`."""
        m = self._m
        shown = [
            m.LinePrimitive(
                type=m.LinePrimitiveLineType.LineStrip, thickness=LINE_PX, scale_invariant=True,
                pose=self._pose(np.zeros(3), np.eye(3)), color=self._colour(colour),
                points=[m.Point3(x=x, y=y, z=z) for x, y, z in line.tolist()],
            )
            for line in lines
        ]  # fmt: skip
        self._entity(path, lines=shown)

    def boxes(self, boxes: Sequence[Box]) -> None:
        """See `Transport`."""
        m = self._m
        cubes, texts = [], []
        for box in boxes:
            T, size = box.box.T_world_box, [float(s) for s in box.box.size_m]
            pose = self._pose(T[:3, 3], T[:3, :3])
            sizes = m.Vector3(x=size[0], y=size[1], z=size[2])
            colour = self._colour(box.colour, ALPHA)
            cubes.append(m.CubePrimitive(pose=pose, size=sizes, color=colour))
            texts.append(
                m.TextPrimitive(
                    pose=pose, billboard=True, font_size=NAME_PX, scale_invariant=True,
                    color=self._colour(box.colour), text=box.text,
                )
            )  # fmt: skip
        self._entity("world/objects", cubes=cubes, texts=texts)

    def ellipsoids(self, path: str, shown: Sequence[Ellipsoid]) -> None:
        """See `Transport`."""
        m = self._m
        spheres = [
            m.SpherePrimitive(
                pose=self._pose(e.centre, e.rotation),
                size=m.Vector3(**dict(zip("xyz", (2 * e.half_sizes_m).tolist(), strict=True))),
                color=self._colour(UNCERTAIN, ALPHA),
            )
            for e in shown
        ]
        self._entity(path, spheres=spheres)

    def numbers(self, group: str, values: Mapping[str, float]) -> None:
        """See `Transport`."""
        if values:
            topic = f"/plots/{group}"
            if topic not in self._channels:
                self._channels[topic] = self._fg.Channel(
                    topic, schema=SERIES | {"title": group}, context=self._context
                )
            told = {name: float(value) for name, value in values.items()}
            self._channels[topic].log(told, log_time=self._ns)

    def event(self, text: str, is_bad: bool) -> None:
        """See `Transport`."""
        level = self._m.LogLevel.Warning if is_bad else self._m.LogLevel.Info
        line = self._m.Log(timestamp=self._stamp, level=level, message=text, name="bmask-slam")
        self._send("/log", "Log", line, NOT_KEPT)

    def clear(self, path: str) -> None:
        """An empty cloud: only submaps are removed."""
        self.points(path, Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0.0))

    def close(self) -> None:
        """See `Transport`."""
        if self._file is None:
            self._sink.stop()
        else:
            with naming(self._file):
                self._sink.close()

    def _entity(self, path: str, **primitives: Any) -> None:
        entity = self._m.SceneEntity(
            timestamp=self._stamp, frame_id=self._frame(path), id=path, frame_locked=True,
            **primitives,
        )  # fmt: skip
        self._send(_topic(path), "SceneUpdate", self._m.SceneUpdate(entities=[entity]))

    def _send(self, topic: str, kind: str, message: Any, key: str = "") -> None:
        """Log a message; the first of a topic makes its channel. The last of each key is kept."""
        if topic not in self._channels:
            make = getattr(self._fg.channels, f"{kind}Channel")
            self._channels[topic] = make(topic, context=self._context)
        if key != NOT_KEPT:
            self._last.setdefault(topic, {})[key] = message, self._ns
        self._channels[topic].log(message, log_time=self._ns)

    @property
    def _stamp(self) -> Any:
        return self._m.Timestamp(sec=self._ns // 10**9, nsec=self._ns % 10**9)

    def _pose(self, position: Array, rotation: Array) -> Any:
        place, turn = self._place(position, rotation)
        return self._m.Pose(position=place, orientation=turn)

    def _place(self, position: Array, rotation: Array) -> tuple[Any, Any]:
        """A Vector3 and a Quaternion."""
        place = dict(zip("xyz", np.asarray(position, float).tolist(), strict=True))
        turn = dict(zip("xyzw", quaternion(rotation).tolist(), strict=True))
        return self._m.Vector3(**place), self._m.Quaternion(**turn)

    def _colour(self, colour: Sequence[int] | Bytes, alpha: float = 1.0) -> Any:
        r, g, b = (float(c) / 255 for c in colour)
        return self._m.Color(r=r, g=g, b=b, a=alpha)


def _topic(path: str) -> str:
    """``world/camera/uncertainty`` is ``/camera/uncertainty``."""
    return path.removeprefix("world")


def _listener(base: type, send_again: Callable[[str], None]) -> Any:
    """A listener of the SDK that calls back with the topic that a client subscribes to."""

    class Listener(base):
        def on_subscribe(self, client: Any, channel: Any) -> None:
            send_again(channel.topic)

    return Listener()
