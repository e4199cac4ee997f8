"""A map and a camera in Rerun; entity paths follow the tree of frames, world first.

====================  ==============================================================================
world/camera          the camera's pose; below it ``image``
world/trajectory      the path so far
world/keyframes       their positions; ``world/loops``: lines between the ends of closed loops
world/landmarks       points in the colours of their labels, else in their own
world/objects         boxes with labels
world/dense           the dense cloud of a finished run
world/surface/X_Y_Z   in a live run: a part of the dense map's surface, as triangles
world/submaps/ID      in a live run: some points of each submap, in the frame of its keyframe
plots/...             status, inliers, milliseconds of each stage, queues
====================  ==============================================================================
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer.web_viewer import LOCAL, WebViewer

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.mapping.surface.parts import SurfacePart

logger = logging.getLogger(__name__)

TIMELINE = "time"
FLUSH_S = 10.0
"""The longest wait for a viewer at the end."""
IMAGE_STEP = 2
JPEG_QUALITY = 70
STATUS = dict.fromkeys(TrackingStatus, 1) | {TrackingStatus.OK: 2, TrackingStatus.LOST: 0}


@dataclass(frozen=True)
class ViewOptions:
    """Where the scene is shown: a recording, a browser on a port (0: none), or Rerun's window.

    ``host`` is the address that the server for the browser listens on.
    """

    record: Path | None = None
    serve: int = 0
    window: bool = False
    host: str = LOCAL

    @property
    def enabled(self) -> bool:
        """Whether it is shown at all."""
        return self.record is not None or self.serve > 0 or self.window


@dataclass(frozen=True, eq=False)
class Box:
    """A labelled box, with a colour (3,)."""

    box: OrientedBox
    text: str
    colour: Bytes


class Scene:
    """Sends a map and frames to Rerun; the arrays given are not changed."""

    def __init__(self, name: str, options: ViewOptions) -> None:
        """Show it as asked for.

        Raises:
            InputError: Rerun is not installed, the recording's folder is not there, or the port is
                taken.
        """
        self._rr: Any = import_extra("rerun", "the viewer", "view")
        self._viewer: WebViewer | None = None
        self._stream = self._rr.RecordingStream(f"bmask-slam {name}")
        if options.record is not None:
            if not options.record.parent.is_dir():
                raise InputError(f"{options.record.parent}: no such folder; make it first")
            refuse_link(options.record)
            self._stream.save(str(options.record))
        elif options.serve:
            import rerun_cli  # noqa: PLC0415 - a part of Rerun

            self._viewer = WebViewer(rerun_cli, options.host, options.serve)
            self._stream.connect_grpc(self._viewer.address)
        elif options.window:
            self._stream.spawn()
        self._path: list[Array] = []
        self._log("world", self._rr.ViewCoordinates.RDF, static=True)

    @property
    def url(self) -> str:
        """What to open in a browser; "" if it is not served."""
        return self._viewer.url if self._viewer else ""

    def log_camera(self, camera: Camera) -> None:
        """Show the camera's field of view."""
        size = [camera.width // IMAGE_STEP, camera.height // IMAGE_STEP]
        K = camera.K / IMAGE_STEP
        self._log(
            "world/camera/image",
            self._rr.Pinhole(image_from_camera=K, resolution=size, image_plane_distance=0.3),
            static=True,
        )

    def log_frame(self, result: FrameResult, rgb: Image | None = None) -> None:
        """Show a frame's pose, its image (H, W, 3) red first, status and times."""
        rr = self._rr
        self._stream.set_time(TIMELINE, duration=result.timestamp_s)
        T = result.T_world_camera
        if T is not None:
            self._log("world/camera", self._pose(T))
            self._path.append(T[:3, 3])
            if len(self._path) % 10 == 0:
                self.log_line("world/trajectory", np.array(self._path), (80, 170, 255))
        if rgb is not None:
            small = np.ascontiguousarray(rgb[::IMAGE_STEP, ::IMAGE_STEP, ::-1])
            quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
            contents = cv2.imencode(".jpg", small, quality)[1].tobytes()
            picture = rr.EncodedImage(contents=contents, media_type="image/jpeg")
            self._log("world/camera/image", picture)
        self.log_numbers("status", {"status": STATUS[result.status]})
        counted = {"matches": result.matches, "inliers": result.inliers, "moving": result.ignored}
        self.log_numbers("features", counted)
        self.log_numbers("ms", result.stage_ms)

    def log_points(
        self, path: str, points: NDArray[np.floating], colours: Bytes, radius_m: float
    ) -> None:
        """Show points (N, 3) with colours (N, 3)."""
        self._log(path, self._rr.Points3D(points, colors=colours, radii=radius_m))

    def log_surface_part(self, part: SurfacePart) -> None:
        """Show a part of a surface in place of what was shown of its region."""
        rr, path = self._rr, f"world/surface/{'_'.join(map(str, part.region))}"
        if not len(part.triangles):
            self._log(path, rr.Clear(recursive=True))
            return
        self._log(
            path,
            rr.Mesh3D(
                vertex_positions=part.vertices,
                triangle_indices=part.triangles,
                vertex_normals=part.normals,
                vertex_colors=part.colours,
            ),
        )

    def log_submap(self, number: int, points: Floats, colours: Bytes) -> None:
        """Show points (N, 3) with colours (N, 3), in the frame given by ``move_submap``."""
        self.log_points(f"world/submaps/{number}", points, colours, 0.006)

    def move_submap(self, number: int, T_world_anchor: Array) -> None:
        """Set the pose (4, 4) of a submap's keyframe."""
        self._log(f"world/submaps/{number}", self._pose(T_world_anchor))

    def remove_submap(self, number: int) -> None:
        """Remove a submap from the scene."""
        self._log(f"world/submaps/{number}", self._rr.Clear(recursive=True))

    def log_line(self, path: str, points: Array, colour: Sequence[int]) -> None:
        """Show a line through points (N, 3)."""
        if len(points) > 1:
            self._log(path, self._rr.LineStrips3D([points], colors=[colour]))

    def log_segments(self, path: str, ends: Array, colour: Sequence[int]) -> None:
        """Show N straight lines with these ends (N, 2, 3)."""
        self._log(path, self._rr.LineStrips3D(ends, colors=[colour]))

    def log_boxes(self, boxes: Sequence[Box]) -> None:
        """Show the map's objects."""
        rr = self._rr
        self._log(
            "world/objects",
            rr.Boxes3D(
                centers=[b.box.T_world_box[:3, 3] for b in boxes],
                half_sizes=[b.box.size_m / 2 for b in boxes],
                quaternions=[_quaternion(b.box.T_world_box[:3, :3]) for b in boxes],
                colors=[b.colour for b in boxes],
                labels=[b.text for b in boxes],
            ),
        )

    def log_numbers(self, group: str, values: Mapping[str, float]) -> None:
        """Add a value to each time series, by name."""
        for name, value in values.items():
            self._log(f"plots/{group}/{name}", self._rr.Scalars([float(value)]))

    def set_time(self, timestamp_s: float) -> None:
        """Set the time of everything that is logged from now on."""
        self._stream.set_time(TIMELINE, duration=timestamp_s)

    def close(self) -> None:
        """Write buffered data and end the recording.

        A viewer that does not take the data within FLUSH_S loses the rest of it.
        """
        try:
            self._stream.flush(timeout_sec=FLUSH_S)
        except RuntimeError as error:
            logger.warning("the viewer did not take all data: %s", error)
        self._stream.disconnect()
        if self._viewer is not None:
            self._viewer.close()

    def _pose(self, T: Array) -> Any:
        return self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])

    def _log(self, path: str, value: Any, static: bool = False) -> None:
        self._stream.log(path, value, static=static)


def _quaternion(rotation: Array) -> Array:
    """x y z w of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - only where boxes are drawn

    return np.asarray(Rotation.from_matrix(rotation).as_quat(), float)
