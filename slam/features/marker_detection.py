"""Finds fiducial markers in a frame: the corners of ArUco's and AprilTag's squares, with depth."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.features.keypoint_depth import sample_depth
from bmask_slam.features.marker_corners import refined_corners
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, make_pose
from bmask_slam.graph.sensors.markers import (
    CORNERS,
    MarkerPose,
    MarkersConfig,
    SeenCorners,
    fit_marker,
)
from bmask_slam.graph.sensors.streams import COLUMNS, Measurements
from bmask_slam.sequences.frame import Frame

FREE = np.inf
"""Sigma of the logarithm of a size that is not known."""


class MarkerDetector:
    """Detects the markers of one dictionary. It holds OpenCV's detector: use one per thread."""

    def __init__(self, config: MarkersConfig, features: FeatureConfig) -> None:
        self.config = config
        self._features = features
        dictionary = dictionary_of(config)
        self._modules = int(dictionary.markerSize) + 2
        self._detector = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())

    def detect(self, frame: Frame, camera: Camera) -> Measurements:
        """The markers in a frame, as rows of "markers" by rising ids; pure.

        Of an id that is there twice none is used, since one of them is another marker. Nor is one
        in what the camera says is covered, since it is attached to the camera.
        """
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        found, numbers, _ = self._detector.detectMarkers(gray)
        ids = np.zeros(0, int) if numbers is None else np.ravel(numbers)
        if camera.covered and len(ids):
            columns, lines = np.rint(np.reshape(found, (-1, 2))).astype(int).T
            free = camera.visible()[lines, columns].reshape(-1, 4).all(axis=1)
            found, ids = [f for f, is_free in zip(found, free, strict=True) if is_free], ids[free]
        rows = []
        for number in sorted(set(ids.tolist())):
            which = np.flatnonzero(ids == number)
            rough = np.asarray(found[which[0]], float).reshape(4, 2)
            if len(which) > 1 or not self.config.uses(number):
                continue
            sides_px = np.linalg.norm(rough - np.roll(rough, 1, axis=0), axis=1)
            corners = refined_corners(gray, rough, self._modules)
            if corners is not None and sides_px.min() >= self.config.min_side_px:
                row = self._row(corners, frame, camera)
                rows.append([frame.timestamp_s, number, *row])
        table = np.array(rows, float).reshape(-1, len(COLUMNS["markers"]))
        return Measurements("markers", table)

    def _row(self, corners: Array, frame: Frame, camera: Camera) -> Array:
        """The columns of `SeenCorners` for corners (4, 2) in pixels of the image."""
        focal = np.array([camera.fx, camera.fy])
        places = (camera.undistort(corners) - [camera.cx, camera.cy]) / focal
        depth_m, spread_m = sample_depth(frame.depth_m, corners, self._features)
        noise = camera.noise_of_depth(self._features.disparity_sigma_px)
        sigmas = np.hypot(noise.inverse_depth_sigma(1 / depth_m), spread_m / depth_m**2)
        sigma = self.config.corner_px / focal.mean()
        return np.concatenate([places.ravel(), [sigma], 1 / depth_m, sigmas])


def dictionary_of(config: MarkersConfig) -> Any:
    """OpenCV's dictionary."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{config.dictionary}"))


def draw_marker(config: MarkersConfig, number: int, side_px: int) -> Image:
    """The print of a marker (side_px, side_px) uint8, without its white border."""
    return np.asarray(dictionary_of(config).generateImageMarker(number, side_px))


def possible_poses(seen: SeenCorners, log_size: float, log_size_sigma: float) -> list[MarkerPose]:
    """The poses that a marker may have, the best first: a small square looks alike from two sides.

    First guesses are those of Collins and Bartoli (IJCV 109, 2014), scaled by the depth where the
    size is not known; then there is none without depth.
    """
    if not np.isfinite(log_size_sigma):
        log_size = 0.0
    square = np.exp(log_size) * CORNERS
    _, turns, places, _ = cv2.solvePnPGeneric(
        square, seen.places, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    found = []
    for turn, place in zip(turns, places, strict=True):
        T_camera_marker = make_pose(cv2.Rodrigues(turn)[0], np.ravel(place))
        size = log_size
        if not np.isfinite(log_size_sigma):
            if not np.isfinite(seen.inverse_depths).any():
                return []
            z = square @ T_camera_marker[2, :3] + T_camera_marker[2, 3]
            scale = 1 / float(np.nanmedian(seen.inverse_depths * z))
            T_camera_marker[:3, 3] *= scale
            size = float(np.log(scale))
        fitted = fit_marker(seen, inverse(T_camera_marker), size, log_size_sigma)
        if fitted is not None:
            found.append(fitted)
    return sorted(found, key=lambda pose: pose.chi2)
