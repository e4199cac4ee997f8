"""How measurements of other sensors are handed to a system, offline and live alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bmask_slam.back_end.reinterpretation import KeyframeMotion, reinterpret_frames, use_camera
from bmask_slam.features.brisk import BriskExtractor
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.own_factors import own_factor
from bmask_slam.graph.geometry import quaternion_from_rotation
from bmask_slam.graph.sensors.streams import Measurements, measurements
from bmask_slam.moving.moving_object_filter import MovingObjectFilter
from bmask_slam.system_results import SystemResults
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.world.frame_observations import FrameObservations


class SensorInput(ABC):
    """Takes measurements, at any time and in any order that ``sensors.late_s`` allows.

    Stamps are in seconds of the frames' clock. Each method takes one measurement or many. All raise
    InputError for what is no measurement: the text names the argument, the value and the cure.
    """

    @abstractmethod
    def add_measurements(self, new: Measurements) -> None:
        """Use the measurements of a sensor."""

    @abstractmethod
    def add_factor(self, factor: Any) -> int:
        """Add a factor of GTSAM with the keys of `key_of_keyframe` and `key_of_landmark`.

        Returns its number, by which ``remove_factor`` removes it. Its noise and robust kernel are
        its own. It holds its keyframes in the map, and goes with a landmark that is removed.
        A ``gtsam.CustomFactor`` cannot be saved, since it is code: saving raises InputError.

        Raises:
            InputError: no factor, another key, a variable that is not in the graph, or an error
                that is not finite.
        """

    @abstractmethod
    def remove_factor(self, number: int) -> None:
        """Remove a factor by the number that ``add_factor`` returned; an unknown one is ignored."""

    def add_odometry(self, timestamps_s: ArrayLike, T_odom_base: ArrayLike) -> None:
        """Add poses (4, 4) or (N, 4, 4) of wheel or visual odometry; only their motion counts.

        ``sensors.odometry`` says how the camera is mounted on the base, and how sure a motion is.
        """
        poses = np.array(T_odom_base, float)
        if poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
            raise InputError(
                f"add_odometry: shape {poses.shape}; give finite poses (4, 4) or (N, 4, 4)"
            )
        poses = poses.reshape(-1, 4, 4)
        quaternions = quaternion_from_rotation(poses[:, :3, :3])
        self._add("odometry", timestamps_s, np.hstack([poses[:, :3, 3], quaternions]))

    def add_accelerometer(self, timestamps_s: ArrayLike, force_m_s2: ArrayLike) -> None:
        """Add specific forces (3,) or (N, 3) in m/s^2, which point up at rest."""
        self._add("accelerometer", timestamps_s, force_m_s2)

    def add_position(
        self, timestamps_s: ArrayLike, position_m: ArrayLike, sigma_m: ArrayLike | None = None
    ) -> None:
        """Add positions (3,) or (N, 3) of the antenna in a local frame with z up.

        ``sigma_m`` of each coordinate, one for all or (N,); None: ``sensors.position.sigma_m``.
        """
        positions = np.array(position_m, float, ndmin=2)
        if sigma_m is not None:
            sigmas = np.broadcast_to(np.array(sigma_m, float), (len(positions),))
            positions = np.column_stack([positions, sigmas])
        self._add("position", timestamps_s, positions)

    def add_imu(
        self, timestamps_s: ArrayLike, rate_rad_s: ArrayLike, force_m_s2: ArrayLike
    ) -> None:
        """Add an IMU's rates and specific forces, (3,) or (N, 3) each, in its own frame.

        ``sensors.imu`` says how it is mounted, and its noise.
        """
        rates, forces = np.array(rate_rad_s, float, ndmin=2), np.array(force_m_s2, float, ndmin=2)
        if rates.shape != forces.shape:
            raise InputError(f"add_imu: {len(rates)} rates and {len(forces)} forces; give as many")
        self._add("imu", timestamps_s, np.hstack([rates, forces]))

    def _add(self, sensor: str, timestamps_s: ArrayLike, values: ArrayLike) -> None:
        stamps_s, rows = np.array(timestamps_s, float, ndmin=1), np.array(values, float, ndmin=2)
        if stamps_s.shape != (len(rows),):
            raise InputError(
                f"add_{sensor}: {len(stamps_s)} stamps for {len(rows)} measurements; give one each"
            )
        self.add_measurements(measurements(sensor, np.column_stack([stamps_s, rows])))


class SensorSystem(SystemResults, SensorInput):
    """A system with its map and graph in this process, which takes measurements and factors.

    It can also go on with another camera, to which the keyframes of the map are adapted.
    """

    camera_tracker: CameraTracker
    extractor: BriskExtractor
    moving_objects: MovingObjectFilter
    frame_observations: FrameObservations

    def add_measurements(self, new: Measurements) -> None:
        """Use the measurements of a sensor beside the camera."""
        self.map.add_measurements(new)

    def add_factor(self, factor: Any) -> int:
        """See `SensorInput.add_factor`; the graph is optimised at once."""
        number = self.mapper.smoother.tables.next_own
        self._change_factors([(number, own_factor(factor).factor)], ())
        return number

    def remove_factor(self, number: int) -> None:
        """See `SensorInput.remove_factor`; the graph is optimised at once."""
        self._change_factors([], (number,))

    def use_camera(
        self,
        camera: Camera,
        motions: Mapping[int, KeyframeMotion],
        frame_motions: Mapping[float, KeyframeMotion] | None = None,
    ) -> None:
        """Go on with another camera; what was seen in known motion is interpreted anew by it.

        ``motions`` are those of keyframes by id, ``frame_motions`` of other frames by stamp; what
        frames of unknown motion observe is forgotten.
        """
        reinterpret_frames(self.frame_observations, frame_motions or {}, self.camera, camera)
        self.camera = camera
        self.camera_tracker.use_camera(camera)
        self._map_uses_camera(camera, motions)

    def leave_out(self, camera: Camera) -> None:
        """Find nothing more in what this camera says is covered; nothing else may differ in it."""
        self.camera = camera
        self.camera_tracker.use_camera(camera)
        self.extractor.leave_out(camera)
        self.moving_objects.leave_out(camera)

    def begin_anew(self) -> None:
        """Begin a segment with the next keyframe, apart from a map that is bent.

        Its landmarks leave the graph, and nothing is recognised by them; markers stay.
        """
        self.map.prune_landmarks(np.flatnonzero(self.map.world.landmarks.in_map))
        self.camera_tracker.reset(0)
        self.camera_tracker.begin_apart()

    def _map_uses_camera(self, camera: Camera, motions: Mapping[int, KeyframeMotion]) -> None:
        use_camera(self.mapper, camera, motions)

    def _change_factors(self, added: list[tuple[int, Any]], removed: tuple[int, ...]) -> None:
        """Change the graph; tracking moves with the map."""
        reference = self.camera_tracker.reference
        T_before = None if reference is None else reference.T_world_camera
        self.mapper.change_own_factors(added, removed)
        if reference is not None and T_before is not None:
            self.camera_tracker.follow_map(T_before, reference.T_world_camera)
