"""A map and a camera as they are shown, by every transport that was asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bmask_slam.events import Event, EventKind
from bmask_slam.graph.arrays import Array, Bytes, Floats, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.graph.files.whole_file import check_target
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer.foxglove_transport import FoxgloveTransport
from bmask_slam.viewer.options import ViewOptions
from bmask_slam.viewer.rerun_transport import RerunTransport
from bmask_slam.viewer.shown import (
    IMAGE_STEP,
    Box,
    Ellipsoid,
    Points,
    Transport,
    as_jpeg,
    segmented_image,
)

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.mapping.surface.parts import SurfacePart

PATH_EVERY, MAX_PATH = 10, 2000
"""How often the path is shown, in frames, and its most points: a longer one is thinned, since what
was shown before stays in the recording."""
PATH_COLOUR = (80, 170, 255)
STATUS = dict.fromkeys(TrackingStatus, 1) | {TrackingStatus.OK: 2, TrackingStatus.LOST: 0}
BAD = (EventKind.LOST, EventKind.GRAPH)


class Scene:
    """Shows a map and frames; the arrays given are not changed."""

    def __init__(self, name: str, options: ViewOptions) -> None:
        """Show it as asked for.

        Raises:
            InputError: the viewer's library is not installed, a file cannot be written, or the
                port is taken.
        """
        for file in filter(None, (options.record, options.foxglove_file)):
            _check_folder(file)
        self._rerun = RerunTransport(name, options) if options.in_rerun else None
        self._transports: list[Transport] = [self._rerun] if self._rerun else []
        if options.in_foxglove:
            try:
                self._transports.append(FoxgloveTransport(name, options))
            except InputError:
                self.close()
                raise
        self._path: list[Array] = []
        self._path_frames, self._path_step = 0, 1

    @property
    def url(self) -> str:
        """What to open in a browser for Rerun; "" if it is not served."""
        return self._rerun.url if self._rerun else ""

    @property
    def addresses(self) -> list[str]:
        """Where it can be seen, in words."""
        return [each.address for each in self._transports if each.address]

    def log_camera(self, camera: Camera) -> None:
        """Show the camera's field of view; the path begins anew."""
        self._path.clear()
        self._path_frames, self._path_step = 0, 1
        size = -(-camera.width // IMAGE_STEP), -(-camera.height // IMAGE_STEP)
        K = np.diag([1 / IMAGE_STEP, 1 / IMAGE_STEP, 1.0]) @ camera.K
        for each in self._transports:
            each.camera(K, size)

    def log_names(self, names: Sequence[str]) -> None:
        """The names of the classes, by number."""
        for each in self._transports:
            each.names(names)

    def log_frame(self, result: FrameResult, rgb: Image | None = None) -> None:
        """Show a frame's pose, its image (H, W, 3) red first, status, times and events."""
        self.set_time(result.timestamp_s)
        T = result.T_world_camera
        if T is not None:
            for each in self._transports:
                each.pose("world/camera", T)
            self._extend_path(T[:3, 3].copy())
        if rgb is not None:
            self.log_image(as_jpeg(rgb))
        self.log_numbers("status", {"status": STATUS[result.status]})
        counted = {"matches": result.matches, "inliers": result.inliers, "moving": result.ignored}
        self.log_numbers("features", counted)
        self.log_numbers("ms", result.stage_ms)
        if result.information is not None and (covariance := result.covariance) is not None:
            self.log_uncertainty(covariance)
            here = Ellipsoid.of(np.zeros(3), covariance[3:, 3:])
            for each in self._transports:
                each.ellipsoids("world/camera/uncertainty", [here])
        for event in result.events:
            self.log_event(event)

    def _extend_path(self, position: Array) -> None:
        """Add a position (3,) to the path, and show it now and then."""
        if self._path_frames % self._path_step == 0:
            self._path.append(position)
        self._path_frames += 1
        if len(self._path) > MAX_PATH:
            self._path, self._path_step = self._path[::2], 2 * self._path_step
        if self._path_frames % PATH_EVERY == 0:
            self.log_line("world/trajectory", np.array(self._path), PATH_COLOUR)

    def log_image(self, jpeg: bytes) -> None:
        """Show what the camera sees, as ``as_jpeg`` makes it."""
        for each in self._transports:
            each.image(jpeg)

    def log_masks(self, jpeg: bytes, instances: Sequence[Instance], names: Sequence[str]) -> None:
        """Show a keyframe's image, as ``as_jpeg`` makes it, with its instances."""
        shown = segmented_image(jpeg, instances, names)
        for each in self._transports:
            each.segmented(shown)

    def log_uncertainty(self, covariance: Array) -> None:
        """Add the sigmas of a pose, by its covariance (6, 6) [rad, m], to the plot."""
        sigmas = np.sqrt(np.maximum(np.diag(covariance), 0))
        position_m, angle_rad = np.linalg.norm(sigmas[3:]), np.linalg.norm(sigmas[:3])
        shown = {"position_mm": 1e3 * position_m, "rotation_0.1deg": 10 * np.degrees(angle_rad)}
        self.log_numbers("uncertainty", {name: float(value) for name, value in shown.items()})

    def log_ellipsoids(self, path: str, shown: Sequence[Ellipsoid]) -> None:
        """Show where things may be."""
        for each in self._transports:
            each.ellipsoids(path, shown)

    def log_event(self, event: Event) -> None:
        """Show what happened, at the time that is set."""
        for each in self._transports:
            each.event(f"{event.kind.value}: {event.text}", event.kind in BAD)

    def log_points(
        self,
        path: str,
        points: NDArray[np.floating],
        colours: Bytes,
        radius_m: float,
        labels: Ints | None = None,
    ) -> None:
        """Show points (N, 3) with colours (N, 3), and names where the mouse is, by labels (N,)."""
        for each in self._transports:
            each.points(path, Points(points, colours, radius_m, labels))

    def log_surface_part(self, part: SurfacePart) -> None:
        """Show a part of a surface in place of what was shown of its region."""
        for each in self._transports:
            each.surface(f"world/surface/{'_'.join(map(str, part.region))}", part)

    def log_submap(self, number: int, points: Floats, colours: Bytes) -> None:
        """Show points (N, 3) with colours (N, 3), in the frame given by ``move_submap``."""
        self.log_points(f"world/submaps/{number}", points, colours, 0.006)

    def move_submap(self, number: int, T_world_anchor: Array) -> None:
        """Set the pose (4, 4) of a submap's keyframe."""
        for each in self._transports:
            each.pose(f"world/submaps/{number}", T_world_anchor)

    def remove_submap(self, number: int) -> None:
        """Remove a submap from the scene."""
        for each in self._transports:
            each.clear(f"world/submaps/{number}")

    def log_line(self, path: str, points: Array, colour: Sequence[int]) -> None:
        """Show a line through points (N, 3)."""
        if len(points) > 1:
            for each in self._transports:
                each.lines(path, [points], colour)

    def log_segments(self, path: str, ends: Array, colour: Sequence[int]) -> None:
        """Show N straight lines with these ends (N, 2, 3)."""
        for each in self._transports:
            each.lines(path, list(ends), colour)

    def log_boxes(self, boxes: Sequence[Box]) -> None:
        """Show the map's objects."""
        for each in self._transports:
            each.boxes(boxes)

    def log_numbers(self, group: str, values: Mapping[str, float]) -> None:
        """Add a value to each time series, by name."""
        for each in self._transports:
            each.numbers(group, values)

    def set_time(self, timestamp_s: float) -> None:
        """Set the time of everything that is logged from now on."""
        for each in self._transports:
            each.set_time(timestamp_s)

    def close(self) -> None:
        """Write or send what is left, and end.

        Raises:
            InputError: a file cannot be written to its end.
        """
        with ExitStack() as stack:  # each is closed, also after one that fails
            for each in self._transports:
                stack.callback(each.close)


def _check_folder(file: Path) -> None:
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder; make it first")
    check_target(file)
    refuse_link(file)
