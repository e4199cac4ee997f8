"""Decoding of colour and depth images, with checks for all ways in which they can be broken.

And reduction of large ones, and undistortion where a lens is beyond a camera's five coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.camera import MAX_REDUCTION, Camera
from bmask_slam.graph.errors import MAX_NUMBER, InputError
from bmask_slam.semantics.instances.image_files import decode_image, read_colour

SURFACE_STEP = 0.05
"""Relative change of depth, in time or from pixel to pixel, beyond which it is another surface."""
MIN_WORKING_PX = 225_000
"""Images are reduced to no fewer pixels, such as 640 x 360."""
TILE_PX, MOST_SHARE, SPARSE_SHARE, LEAST_TILES = 7, 0.9, 0.75, 30
"""Depth is scattered where nine of ten tiles have it at a smaller share of their pixels, of those
with depth in the middle, if these are enough."""
FILLED_PX = 3.0
"""How far a scattered depth counts."""


def read_rgb(path: Path, camera: Camera) -> Image:
    """The colour image (H, W, 3), red first; grey images are expanded.

    Raises:
        InputError: a missing, truncated or unreadable file, more than 8 bits a channel, or
            another size than the camera's.
    """
    rgb = read_colour(path)
    check_size(path, rgb, camera)
    return reduced_colour(rgb, camera.reduced_by)


def read_depth(path: Path, camera: Camera) -> Floats:
    """The depth image (H, W) in metres (paper eq. 9: z = d / s, and an offset), NaN where missing.

    Raises:
        InputError: as for ``read_rgb``, and for anything but one channel of 16 bits.
    """
    stored = decode_image(path, cv2.IMREAD_UNCHANGED)
    check_depth_type(path, stored, camera)
    check_size(path, stored, camera)
    return depth_in_metres(reduced_depth(stored, camera.reduced_by), camera)


def working_camera(camera: Camera) -> Camera:
    """The camera of images as they are used: large ones are reduced by a whole number.

    What tracking and map measure in pixels, such as how far a point moves from frame to frame and
    how large what BRISK describes is, is right for 640 x 480. Larger images take longer, and where
    the camera moves fast they are tracked no better.
    """
    width, height = camera.width, camera.height
    for k in range(MAX_REDUCTION, 1, -1):
        if width % k == height % k == 0 and width * height >= MIN_WORKING_PX * k**2:
            return camera.reduced(k)
    return camera


def reduced_colour(rgb: Image, k: int) -> Image:
    """Colour (k H, k W, 3) at a k-th of its size: the mean of the pixels that become one."""
    if k == 1:
        return rgb
    size = rgb.shape[1] // k, rgb.shape[0] // k
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def reduced_depth(stored: NDArray, k: int) -> NDArray:
    """Depth (k H, k W) at a k-th of its size, in any unit, 0 or NaN where missing.

    Of the pixels that become one, the mean of those on the nearest surface; 0 if none has depth.
    """
    if k == 1:
        return stored
    whole = stored.astype(np.float32)
    whole[~(whole > 0)] = np.inf
    pixels = [whole[i::k, j::k] for i in range(k) for j in range(k)]
    limit = np.minimum.reduce(pixels) * np.float32(1 + SURFACE_STEP)
    limit[np.isinf(limit)] = 0
    total, count = np.zeros_like(limit), np.zeros_like(limit)
    for pixel in pixels:
        near = pixel <= limit
        np.add(total, pixel, out=total, where=near)
        count += near
    return np.divide(total, count, out=np.zeros_like(total), where=count > 0)


def check_depth_type(path: Path, stored: NDArray, camera: Camera) -> None:
    """Refuse what is not one channel of 16 bits or float32. Raises InputError."""
    if stored.ndim == 3:
        raise InputError(
            f"{path}: {stored.shape[2]} channels where depth is expected; "
            "list 16-bit single-channel depth images (are rgb and depth swapped?)"
        )
    if stored.dtype not in (np.uint16, np.float32):
        raise InputError(
            f"{path}: {8 * stored.dtype.itemsize}-bit depth, which is too coarse; "
            f"store 16-bit depth with {camera.depth_scale:g} to the metre"
        )


def depth_in_metres(stored: NDArray, camera: Camera) -> Floats:
    """Depth (H, W) in metres from stored values, integers or floats.

    Paper eq. 9 and an offset, 1/z less the camera's ``depth_distortion``; NaN where the values are
    0, negative or not finite, and in what is covered. Scattered depth is filled.
    """
    stored = filled_depth(stored)
    depth_m = np.divide(stored, np.float32(camera.depth_scale), dtype=np.float32)
    if camera.depth_offset_m:
        depth_m += np.float32(camera.depth_offset_m)
    if any(camera.depth_distortion):
        with np.errstate(invalid="ignore", divide="ignore"):
            depth_m /= 1 - depth_m * _depth_bend(camera)
    depth_m[~((stored > 0) & (depth_m > 0) & (depth_m < np.inf))] = np.nan
    return without_covered(depth_m, camera)


def filled_depth(stored: NDArray) -> NDArray:
    """Depth (H, W) in any unit, 0 or NaN where missing; if it is scattered, with the nearest value.

    A coarser depth camera that was registered point by point leaves a grid of holes in the colour
    image, in which no window around a keypoint has depth enough. Holes of other depth images stay.
    """
    valid = np.asarray(stored > 0)
    rows, columns = (size // TILE_PX for size in valid.shape)
    if min(rows, columns) == 0:
        return stored
    tiles = valid[: rows * TILE_PX, : columns * TILE_PX].astype(np.float32)
    shares = cv2.resize(tiles, (columns, rows), interpolation=cv2.INTER_AREA)
    shares = shares[tiles[TILE_PX // 2 :: TILE_PX, TILE_PX // 2 :: TILE_PX] > 0]
    if len(shares) < LEAST_TILES or np.quantile(shares, MOST_SHARE) >= SPARSE_SHARE:
        return stored
    distance, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(labels.max() + 1, stored.dtype)
    values[labels[valid]] = stored[valid]
    return np.where(distance <= FILLED_PX, values[labels], stored.dtype.type(0))


def without_covered(depth_m: Floats, camera: Camera) -> Floats:
    """A depth image (H, W) with NaN in the parts that do not show the room, changed in place."""
    for left, top, right, bottom in camera.covered:
        depth_m[top:bottom, left:right] = np.nan
    return depth_m


@lru_cache(2)
def _depth_bend(camera: Camera) -> Floats:
    """What the sensor adds to the inverse depth of each pixel (H, W), in 1/m."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return camera.depth_bend(np.stack([u, v], axis=-1)).astype(np.float32)


def depth_between(near_m: Floats, other_m: Floats, share: float) -> Floats:
    """Depth (H, W) at a time between two depth images, ``share`` of the way to the other.

    At a fixed pixel on a surface the INVERSE depth changes linearly (exactly for a plane and a
    small motion). Where the two show different surfaces it cannot be told which one the pixel shows
    in between: NaN. Where the other one has no depth, the value is that of the nearer image.
    """
    one_surface = np.abs(near_m - other_m) < SURFACE_STEP * near_m
    with np.errstate(divide="ignore"):
        between = near_m * other_m / (other_m + np.float32(share) * (near_m - other_m))
    return np.where(one_surface, between, np.where(np.isnan(other_m), near_m, np.float32(np.nan)))


def check_size(path: Path, image: NDArray, camera: Camera) -> None:
    """Refuse an image of another size than the camera records. Raises InputError."""
    height, width = image.shape[:2]
    recorded = camera.width * camera.reduced_by, camera.height * camera.reduced_by
    if (width, height) != recorded:
        raise InputError(
            f"{path}: {width}x{height} pixels, but the camera has {recorded[0]}x{recorded[1]}; "
            "colour and registered depth must both have the size in camera.yaml"
        )


_MAX_REMAPPED_PX = 32_767
"""Longest side of an image that OpenCV's remap takes."""
_RATIONAL_TERMS, _FISHEYE_TERMS = (8, 12, 14), (4,)


@dataclass(frozen=True)
class Lens:
    """A lens with more distortion than a camera's five coefficients can say.

    Attributes:
        camera: the pinhole that its undistorted images are of; K is the same in both.
        terms: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 and those that may follow, or the four of a fisheye.
        is_fisheye: the equidistant model (Kannala and Brandt 2006), not the rational one.
    """

    camera: Camera
    terms: tuple[float, ...]
    is_fisheye: bool = False

    def fault(self) -> str:
        """What no lens can be, in words; "" for a possible one."""
        counts = _FISHEYE_TERMS if self.is_fisheye else _RATIONAL_TERMS
        if len(self.terms) not in counts:
            return f"{len(self.terms)} distortion coefficients, not {' or '.join(map(str, counts))}"
        if not (np.abs(np.array(self.terms)) <= MAX_NUMBER).all():
            return "a number that is not finite"
        size = max(self.camera.width, self.camera.height)
        return f"{size} pixels in a row" if size > _MAX_REMAPPED_PX else ""

    def undistorted_colour(self, rgb: Image) -> Image:
        """Colour (H, W, 3) as the pinhole sees it, black where the lens does not look."""
        return np.asarray(cv2.remap(rgb, *_lens_maps(self), cv2.INTER_LINEAR), np.uint8)

    def undistorted_depth(self, stored: NDArray) -> NDArray:
        """Stored depth (H, W) by nearest pixels, 0 where the lens does not look."""
        return np.asarray(cv2.remap(stored, *_lens_maps(self), cv2.INTER_NEAREST))

    def is_of_recorded(self, camera: Camera) -> bool:
        """Whether a camera is of the images as recorded, and not of the undistorted ones.

        Of the two it is that to which its own projection of the same rays is nearer.
        """
        pinhole = self.camera
        if (camera.width, camera.height) != (pinhole.width, pinhole.height):
            return True
        steps = max(1, max(camera.width, camera.height) // 40)
        rows, columns = np.mgrid[: camera.height : steps, : camera.width : steps]
        straight: Array = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(float)
        recorded = np.stack([m[rows, columns].ravel() for m in _lens_maps(self)], axis=-1)
        own = camera.project_distorted(pinhole.backproject(straight, np.ones(len(straight))))
        apart = [np.median(np.linalg.norm(own - one, axis=1)) for one in (recorded, straight)]
        return bool(apart[0] < apart[1])


@lru_cache(4)
def _lens_maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Columns and rows (H, W) in the recorded image of each pixel of the undistorted one."""
    K, terms, same = lens.camera.K, np.array(lens.terms), np.eye(3)
    make = cv2.fisheye.initUndistortRectifyMap if lens.is_fisheye else cv2.initUndistortRectifyMap
    size = lens.camera.width, lens.camera.height
    columns, rows = make(K, terms, same, K, size, cv2.CV_32FC1)
    return columns, rows
