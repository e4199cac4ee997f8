"""How well the edges of depth images fit those of colour images, for shifts in all directions.

An edge of depth is where the surface in front ends; what lies behind it has mostly another colour.
Depth that is registered to colour has its edges where colour has some, within 3 px with the depth
cameras tried; so neither tracking nor its camera decide what is found here.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bmask_slam.calibration.motion import twists_at
from bmask_slam.graph.arrays import Array, Floats, Image, Ints
from bmask_slam.graph.calibration.registration import EdgeScores, strength_of
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.threads import in_threads
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.tracking.pose.rolling_shutter import velocities

FRAMES = 32
RADIUS = 32
"""Steps of the largest shift; a step is about 1/320 of the image's width."""
WIDTH_STEPS = 320
JUMP = 0.1
"""Relative change of depth from a pixel to the next that is an edge."""
MAX_HOLE_SHARE = 0.075
"""Of the width: a wider hole in the depth is no shadow beside an edge."""
CONTRAST_PX, MAX_CONTRAST = 41, 4.0
FLOW_POINTS = 500
SCALES = (0.8, 0.84, 0.88, 0.92, 0.96, 1.0, 1.04, 1.08, 1.12, 1.16, 1.2)


@dataclass(frozen=True, eq=False)
class EdgeImages:
    """Edges of a frame, as float32 images (H, W).

    Attributes:
        depth: edges of depth, across columns and across rows; 0 or more.
        colour: gradients of grey, by column and by row, over their mean around.
    """

    depth: tuple[Floats, Floats]
    colour: tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class FrameEdges:
    """How the edges of a frame's depth fit those of its colour.

    Attributes:
        scores: (2R + 1, 2R + 1) of the shifts of depth by -R to R steps, rows first.
        points: (n, 3) in m, some of the edges of depth in the camera's frame.
        lag_s: time of the depth image less that of the colour image, by stamps and camera.
    """

    scores: Floats
    points: Array
    lag_s: float

    @classmethod
    def of(cls, rgb: Image, depth_m: Array, lag_s: float, camera: Camera) -> FrameEdges:
        """Those of a colour image (H, W, 3) and a depth image (H, W), NaN where missing."""
        edges = edges_of(rgb, depth_m)
        scores = correlation(edges, _step_px(camera)).astype(np.float32)
        return cls(scores, _edge_points(edges, depth_m, camera), lag_s)


def edge_scores(sequence: Sequence, path: Trajectory) -> EdgeScores:
    """Scores of FRAMES frames of a sequence, spread over the frames that have poses and velocities.

    Depth images are taken as they are, so that the lags are those of their stamps.
    """
    chosen, twists = _chosen_frames(sequence, path)
    recording, pairs, camera = sequence.recording, sequence.pairs, sequence.camera

    def edges(i: int) -> FrameEdges:
        depth_m = recording.read_depth(pairs.depth_files[i], camera).astype(float)
        rgb = recording.read_rgb(pairs.rgb_files[i], camera)
        return FrameEdges.of(rgb, depth_m, float(pairs.lags_s[i]), camera)

    return scores_of(in_threads(edges, chosen.tolist()), twists, camera)


def scores_of(frames: list[FrameEdges], twists: Array, camera: Camera) -> EdgeScores:
    """Scores of n frames of a camera that moved with twists (n, 6)."""
    size = 2 * RADIUS + 1
    flows = [_flow(f.points, twist, camera) for f, twist in zip(frames, twists, strict=True)]
    return EdgeScores(
        np.array([f.scores for f in frames], np.float64).reshape(-1, size, size),
        float(_step_px(camera)),
        np.array(flows).reshape(-1, 2),
        np.array([f.lag_s for f in frames]),
    )


def _step_px(camera: Camera) -> int:
    return max(round(camera.width / WIDTH_STEPS), 1)


def best_scale(sequence: Sequence, path: Trajectory) -> tuple[float, float]:
    """The scale about the image's middle with which depth fits colour best, and its strength.

    A depth camera that is not registered to colour often has another focal length.
    """
    chosen, _ = _chosen_frames(sequence, path)
    camera = sequence.camera
    step = 2 * _step_px(camera)
    total = np.zeros((len(SCALES), 2 * RADIUS + 1, 2 * RADIUS + 1))
    for i in chosen[::2].tolist():
        depth_m = sequence.recording.read_depth(sequence.pairs.depth_files[i], camera).astype(float)
        edges = edges_of(sequence.recording.read_rgb(sequence.pairs.rgb_files[i], camera), depth_m)
        total += [correlation(_scaled(edges, scale), step) for scale in SCALES]
    strengths = [strength_of(scores) for scores in total]
    best = int(np.argmax(strengths))
    return SCALES[best], strengths[best]


def _chosen_frames(sequence: Sequence, path: Trajectory) -> tuple[Ints, Array]:
    """Indices (n,) of frames and the camera's velocities (n, 6) there."""
    if not len(path):
        return np.zeros(0, np.int64), np.zeros((0, 6))
    at = np.unique(nearest_indices(sequence.timestamps_s, path.timestamps_s))
    twists = twists_at(path, sequence.timestamps_s[at])
    moving = np.flatnonzero(twists.any(axis=1))
    places = np.linspace(0, len(moving) - 1, min(FRAMES, len(moving))).round().astype(int)
    return at[moving[places]], twists[moving[places]]


def edges_of(rgb: Image, depth_m: Array) -> EdgeImages:
    """The edges of a colour image (H, W, 3) and a depth image (H, W)."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    by_column, by_row = (
        np.abs(cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8)) for order in ((1, 0), (0, 1))
    )
    depth_m = depth_m.astype(np.float32)
    return EdgeImages(
        (_depth_edges(depth_m), np.ascontiguousarray(_depth_edges(depth_m.T).T)),
        (_normalised(by_column), _normalised(by_row)),
    )


def _normalised(gradient: Floats) -> Floats:
    """A gradient over its mean around, so that textures do not outweigh outlines."""
    mean = cv2.blur(gradient, (CONTRAST_PX, CONTRAST_PX))
    return np.asarray(np.minimum(gradient / (mean + 1.0), MAX_CONTRAST), np.float32)


def _depth_edges(depth_m: Array) -> Floats:
    """1/2 on both sides of each jump along the rows (H, W).

    Beside a surface in front a structured-light camera has a shadow without depth; it belongs to
    what is behind, so a jump over a hole is at the hole's end with the smaller depth.
    """
    height, width = depth_m.shape
    measured = np.flatnonzero(np.isfinite(depth_m))
    first, second = measured[:-1], measured[1:]
    z_m = depth_m.reshape(-1)[measured]
    nearer, farther = np.minimum(z_m[:-1], z_m[1:]), np.maximum(z_m[:-1], z_m[1:])
    jumps = np.flatnonzero(farther > np.exp(JUMP) * nearer)
    first, second, in_front = first[jumps], second[jumps], z_m[jumps] < z_m[jumps + 1]
    narrow = second - first < MAX_HOLE_SHARE * width
    left = np.where(in_front, first, second - 1)[narrow & (first // width == second // width)]
    edges = np.zeros(height * width, np.float32)
    edges[left] += 0.5
    edges[left + 1] += 0.5
    return edges.reshape(height, width)


def correlation(edges: EdgeImages, step: int) -> Array:
    """Scores (2R + 1, 2R + 1) of shifts of depth by -R to R steps of some pixels, rows first."""
    total = np.zeros((2 * RADIUS + 1,) * 2)
    for depth, colour in zip(edges.depth, edges.colour, strict=True):
        height, width = depth.shape
        size = (width // step, height // step)
        small, other = (cv2.resize(e, size, interpolation=cv2.INTER_AREA) for e in (depth, colour))
        shape = [cv2.getOptimalDFTSize(n + 2 * RADIUS) for n in small.shape]
        spectrum = np.conj(np.fft.rfft2(small, shape)) * np.fft.rfft2(other - other.mean(), shape)
        scores = np.roll(np.fft.irfft2(spectrum, shape), (RADIUS, RADIUS), (0, 1))
        total += scores[: len(total), : len(total)]
    return total


def _scaled(edges: EdgeImages, scale: float) -> EdgeImages:
    """The edges of depth larger by a scale about the image's middle."""
    height, width = edges.depth[0].shape
    about = (1 - scale) * np.array([width - 1, height - 1]) / 2
    M = np.array([[scale, 0, about[0]], [0, scale, about[1]]])
    first, second = (cv2.warpAffine(e, M, (width, height)) for e in edges.depth)
    return EdgeImages((first, second), edges.colour)


def _edge_points(edges: EdgeImages, depth_m: Array, camera: Camera) -> Array:
    """Some points (n, 3) of the edges of depth."""
    rows, columns = np.nonzero((edges.depth[0] + edges.depth[1] > 0) & np.isfinite(depth_m))
    some = slice(None, None, max(len(rows) // FLOW_POINTS, 1))
    pixels = np.column_stack([columns, rows])[some].astype(float)
    return camera.backproject(pixels, depth_m[rows, columns][some])


def _flow(points: Array, twist: Array, camera: Camera) -> Array:
    """Velocity (2,) of the image in px/s at points (n, 3): the median."""
    if not len(points):
        return np.zeros(2)
    moved = velocities(points, twist)
    slopes = (moved[:, :2] - points[:, :2] / points[:, 2:] * moved[:, 2:]) / points[:, 2:]
    return np.asarray(np.median(slopes * (camera.fx, camera.fy), axis=0))
