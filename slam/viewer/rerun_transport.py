"""What is shown, in Rerun: a recording, a browser or a window, with a blueprint of its own."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.viewer.options import ViewOptions, naming
from bmask_slam.viewer.shown import Box, Ellipsoid, Points, SegmentedImage, quaternion
from bmask_slam.viewer.web_viewer import WebViewer

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.mapping.surface.parts import SurfacePart

logger = logging.getLogger(__name__)

TIMELINE = "time"
FLUSH_S = 10.0
"""The longest wait for a viewer at the end."""
FILE_FLUSH_S = 60.0
"""The longest wait for a file. After an error in writing, Rerun's flush, disconnect and destructor
may wait for ever, for a thread that has ended."""
MAX_NAMES = 40
"""With more objects names show where the mouse is; in a view so full none could be read."""


class RerunTransport:
    """Sends to Rerun."""

    def __init__(self, name: str, options: ViewOptions) -> None:
        """Show it as asked for.

        Raises:
            InputError: Rerun is not installed, it finds no window's program, the port is taken, or
                the recording cannot be written.
        """
        self._rr: Any = import_extra("rerun", "the viewer", "view")
        self._file = options.record
        self._viewer: WebViewer | None = None
        self._stream = self._rr.RecordingStream(f"bmask-slam {name}")
        if options.record is not None:
            with naming(options.record):
                self._stream.save(str(options.record))
        elif options.serve:
            import rerun_cli  # noqa: PLC0415 - a part of Rerun

            self._viewer = WebViewer(rerun_cli, options.host, options.serve)
            self._stream.connect_grpc(self._viewer.address)
        elif options.window:
            try:
                self._stream.spawn()
            except RuntimeError as error:
                reason = str(error).partition("\n")[0]
                raise InputError(
                    f"the viewer's window does not open ({reason}); activate the environment that "
                    "Rerun is installed in, or use --serve or --record F.rrd"
                ) from error
        self._stream.send_blueprint(_blueprint())
        self._log("world", self._rr.ViewCoordinates.RDF, static=True)

    @property
    def url(self) -> str:
        """What to open in a browser; "" if it is not served."""
        return self._viewer.url if self._viewer else ""

    @property
    def address(self) -> str:
        """See `Transport`."""
        return f"in a browser: {self.url}" if self.url else ""

    def set_time(self, timestamp_s: float) -> None:
        """See `Transport`."""
        self._stream.set_time(TIMELINE, duration=timestamp_s)

    def names(self, names: Sequence[str]) -> None:
        """See `Transport`."""
        infos = [
            self._rr.AnnotationInfo(k, name, [int(c) for c in class_colour(k)] if k else [0] * 4)
            for k, name in enumerate(names)
        ]
        self._log("/", self._rr.AnnotationContext(infos), static=True)

    def camera(self, K: Array, size: tuple[int, int]) -> None:
        """See `Transport`."""
        pinhole = self._rr.Pinhole(
            image_from_camera=K, resolution=list(size), image_plane_distance=0.3
        )
        self._log("world/camera/image", pinhole, static=True)

    def pose(self, path: str, T_world_child: Array) -> None:
        """See `Transport`."""
        T = T_world_child
        self._log(path, self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def image(self, jpeg: bytes) -> None:
        """See `Transport`."""
        self._log("world/camera/image", self._jpeg(jpeg))

    def segmented(self, image: SegmentedImage) -> None:
        """See `Transport`."""
        self._log("keyframe/image", self._jpeg(image.jpeg))
        for name in ("keyframe/masks", "keyframe/names"):
            if not image.instances:
                self._log(name, self._rr.Clear(recursive=False))
        if not image.instances:
            return
        labels = image.labels.astype(np.uint16)
        self._log("keyframe/masks", self._rr.SegmentationImage(labels, opacity=0.5))
        self._log(
            "keyframe/names",
            self._rr.Boxes2D(
                array=[i.box for i in image.instances],
                array_format=self._rr.Box2DFormat.XYXY,
                labels=[i.text for i in image.instances],
                colors=[i.colour for i in image.instances],
                show_labels=True,
            ),
        )

    def points(self, path: str, shown: Points) -> None:
        """See `Transport`."""
        labels = None if shown.labels is None else shown.labels.astype(np.uint16)
        points = self._rr.Points3D(
            shown.points,
            colors=shown.colours,
            radii=shown.radius_m,
            class_ids=labels,
            show_labels=False,
        )
        self._log(path, points)

    def surface(self, path: str, part: SurfacePart) -> None:
        """See `Transport`."""
        if not len(part.triangles):
            self.clear(path)
            return
        mesh = self._rr.Mesh3D(
            vertex_positions=part.vertices,
            triangle_indices=part.triangles,
            vertex_normals=part.normals,
            vertex_colors=part.colours,
        )
        self._log(path, mesh)

    def lines(self, path: str, lines: Sequence[Array], colour: Sequence[int]) -> None:
        """See `Transport`."""
        self._log(path, self._rr.LineStrips3D(lines, colors=[colour]))

    def boxes(self, boxes: Sequence[Box]) -> None:
        """See `Transport`."""
        self._log(
            "world/objects",
            self._rr.Boxes3D(
                centers=[b.box.T_world_box[:3, 3] for b in boxes],
                half_sizes=[b.box.size_m / 2 for b in boxes],
                quaternions=[quaternion(b.box.T_world_box[:3, :3]) for b in boxes],
                colors=[b.colour for b in boxes],
                labels=[b.text for b in boxes],
                show_labels=len(boxes) <= MAX_NAMES,
            ),
        )

    def ellipsoids(self, path: str, shown: Sequence[Ellipsoid]) -> None:
        """See `Transport`."""
        ellipsoids = self._rr.Ellipsoids3D(
            centers=[e.centre for e in shown],
            half_sizes=[e.half_sizes_m for e in shown],
            quaternions=[quaternion(e.rotation) for e in shown],
            colors=[(255, 200, 0)],
        )
        self._log(path, ellipsoids)

    def numbers(self, group: str, values: Mapping[str, float]) -> None:
        """See `Transport`."""
        for name, value in values.items():
            self._log(f"plots/{group}/{name}", self._rr.Scalars([float(value)]))

    def event(self, text: str, is_bad: bool) -> None:
        """See `Transport`."""
        self._log("events", self._rr.TextLog(text, level="WARN" if is_bad else "INFO"))

    def clear(self, path: str) -> None:
        """See `Transport`."""
        self._log(path, self._rr.Clear(recursive=True))

    def close(self) -> None:
        """Write buffered data and end the recording.

        A viewer that does not take the data within FLUSH_S loses the rest of it, and one that is
        served ends with it.

        Raises:
            InputError: the recording cannot be written to its end.
        """
        if self._viewer is not None:  # first: the stream would wait for one that takes nothing
            self._viewer.close()
        elif self._file is not None:
            with naming(self._file):
                self._end_file()
        else:
            self._flush()
        self._stream.disconnect()

    def _end_file(self) -> None:
        """Write buffered data; a stream that fails is left as it is, to the end of the process."""
        try:
            self._stream.flush(timeout_sec=FILE_FLUSH_S)
        except RuntimeError:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._stream))
            self._rr.unregister_shutdown()
            raise

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH_S)
        except RuntimeError as error:
            logger.warning("the viewer did not take all data: %s", error)

    def _jpeg(self, jpeg: bytes) -> Any:
        return self._rr.EncodedImage(contents=jpeg, media_type="image/jpeg")

    def _log(self, path: str, value: Any, static: bool = False) -> None:
        self._stream.log(path, value, static=static)


def _blueprint() -> Any:
    """The map, the camera's image, the keyframe with masks; below them the plots and the log."""
    import rerun.blueprint as rrb  # noqa: PLC0415 - a part of Rerun

    pictures = rrb.Vertical(
        rrb.Spatial2DView(
            origin="world/camera/image",
            contents=["+ $origin/**", "+ world/objects"],
            name="camera, with the map's objects",
        ),
        rrb.Spatial2DView(origin="keyframe", name="last keyframe with masks"),
    )
    plots = [
        rrb.TimeSeriesView(origin=f"plots/{group}", name=name)
        for group, name in (
            ("status", "status: 2 OK, 1 weak, 0 lost"),
            ("ms", "ms a frame"),
            ("uncertainty", "uncertainty, mm and 0.1 deg"),
        )
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(origin="world", name="map"), pictures, column_shares=[3, 2]
            ),
            rrb.Horizontal(*plots, rrb.TextLogView(origin="events", name="events")),
            row_shares=[5, 2],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed"),
    )
