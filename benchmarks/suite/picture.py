"""The picture at the top of README.md, from a run folder and its sequence alone.

    bmask-slam run SEQUENCE --out RUN && bmask-slam map RUN
    python -m benchmarks.suite.picture RUN SEQUENCE --out docs/images/overview.png [--frame N]

Above: a frame with the map's landmarks projected into it by the frame's pose; the landmarks and the
camera's path from above; the path against the reference. Below: the network's masks of the frame;
the dense map; its labels.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bmask_slam.evaluation.plot import draw_top_view
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.metrics import absolute_error
from bmask_slam.graph.trajectory import Trajectory, associate, associate_stamps, read_tum
from bmask_slam.rendering.engine.path import look_at
from bmask_slam.semantics.instances.overlay import draw
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import open_sequence

VIEW_SIZE = (960, 720)
BACKGROUND = 24
NEAR_M, FAR_M = 0.8, 5.0
AGREEMENT = 0.03
SUPERSAMPLING = 2
ELEVATION_SLOPE = 0.9
MARGIN = 0.06
MIN_VIEWS = 3
DISC_M = 0.035


def draw_landmarks(frame: Frame, camera: Camera, T_world_camera: Array, points: Array) -> Image:
    """The frame, half grey, with a ring for every landmark that its depth image confirms.

    Rings are coloured by depth, near ones yellow and far ones pink, and as large as a disc of
    2.5 cm would appear.
    """
    points_camera = transform(inverse(T_world_camera), points)
    points_camera = points_camera[points_camera[:, 2] > 0.1]
    pixels, depth_m = camera.project(points_camera), points_camera[:, 2]
    limit = (camera.width - 1, camera.height - 1)
    inside = (pixels >= 0).all(axis=1) & (pixels <= limit).all(axis=1)
    pixels, depth_m = pixels[inside], depth_m[inside]
    column, row = np.rint(pixels).astype(int).T
    visible = np.abs(frame.depth_m[row, column] - depth_m) < AGREEMENT * depth_m
    gray = cv2.cvtColor(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    size = (SUPERSAMPLING * camera.width, SUPERSAMPLING * camera.height)
    picture = cv2.resize(cv2.addWeighted(frame.rgb, 0.6, gray, 0.4, 0), size)
    colours = depth_colours(depth_m)
    for k in np.flatnonzero(visible)[np.argsort(-depth_m[visible])]:
        centre = np.rint(SUPERSAMPLING * (pixels[k] + 0.5) - 0.5).astype(int).tolist()
        radius = int(np.clip(SUPERSAMPLING * 0.0125 * camera.fx / depth_m[k], 4, 14))
        cv2.circle(picture, centre, radius, colours[k].tolist(), 2, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def depth_colours(depth_m: Array) -> Image:
    """Colours (N, 3), red first: near yellow, far pink."""
    share = np.clip((depth_m - NEAR_M) / (FAR_M - NEAR_M), 0, 1)
    levels = np.rint(255 * (1 - 0.7 * share)).astype(np.uint8)
    coloured = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)[:, 0, ::-1]
    return np.ascontiguousarray(coloured)


def fitted_view(points: Array, azimuth_deg: float) -> tuple[Array, Camera]:
    """A view T_view_world from above and aside in which most of the points fill the picture."""
    low, high = np.percentile(points, (2, 98), axis=0)
    middle, extent_m = (low + high) / 2, np.linalg.norm(high - low)
    azimuth = np.deg2rad(azimuth_deg)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), ELEVATION_SLOPE])
    T_view_world = inverse(look_at(middle + 1.1 * extent_m * direction, middle))
    x, y, z = transform(T_view_world, points).T
    (left, top), (right, bottom) = np.percentile(np.stack([x / z, y / z], axis=1), (1, 99), axis=0)
    width, height = VIEW_SIZE
    focal_px = (1 - MARGIN) * min(width / (right - left), height / (bottom - top))
    cx = width / 2 - focal_px * (left + right) / 2
    cy = height / 2 - focal_px * (top + bottom) / 2
    return T_view_world, Camera(width, height, focal_px, focal_px, cx, cy)


def draw_cloud(points: Array, colours: Image, trajectory: Trajectory, azimuth_deg: float) -> Image:
    """Landmarks (N, 3), world z up, as discs of DISC_M, with the camera's path."""
    T_view_world, view = fitted_view(points, azimuth_deg)
    picture = np.full((view.height, view.width, 3), BACKGROUND, np.uint8)
    points_view = transform(T_view_world, points)
    pixels = view.project(points_view)
    brighter = np.clip(1.25 * colours.astype(float) + 25, 0, 255)
    for k in np.argsort(-points_view[:, 2]):
        radius = max(DISC_M / 2 * view.fx / points_view[k, 2], 1.6)
        centre = np.rint(16 * pixels[k]).astype(int).tolist()
        cv2.circle(picture, centre, int(16 * radius), brighter[k].tolist(), -1, cv2.LINE_AA, 4)
    draw_path(picture, view, T_view_world, trajectory)
    return picture


def draw_path(picture: Image, view: Camera, T_view_world: Array, trajectory: Trajectory) -> None:
    """Draw the camera's path, and its pyramid of view a few times on the way."""
    path = view.project(transform(T_view_world, trajectory.positions_world))
    line = np.rint(16 * path).astype(np.int32)[:, None]
    cv2.polylines(picture, [line], False, (80, 170, 255), 3, cv2.LINE_AA, 4)
    corners = 0.16 * np.array([[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
    for index in np.linspace(0, len(trajectory) - 1, 9).astype(int):
        T_world_camera = trajectory.poses_world_camera[index]
        pyramid = transform(T_world_camera, np.vstack([np.zeros(3), corners]))
        ends = np.rint(16 * view.project(transform(T_view_world, pyramid))).astype(np.int32)
        for k in range(4):
            shape = np.stack([ends[0], ends[1 + k], ends[1 + (k + 1) % 4]])[:, None]
            cv2.polylines(picture, [shape], True, (255, 196, 60), 2, cv2.LINE_AA, 4)


def draw_masks(frame: Frame, sequence: Path) -> tuple[Image, int]:
    """The frame with its instances, and how many there are."""
    segmenter = make_segmenter(SegmenterOptions(), sequence)
    instances = segmenter.segment(frame.rgb, frame.name)
    return draw(frame.rgb, instances, segmenter.labels), len(instances)


def read_image(path: Path) -> Image:
    """A picture of the run folder, red first."""
    picture = cv2.imread(str(path))
    if picture is None:
        raise SystemExit(f"error: {path}: no picture; make it with  bmask-slam map RUN")
    return np.asarray(picture[:, :, ::-1], np.uint8)


def show(axis: Axes, picture: Image, title: str) -> None:
    """An image without axes, under a title."""
    axis.imshow(picture, interpolation="antialiased")
    axis.set_axis_off()
    axis.set_title(title, fontsize=9)


def main() -> None:
    """Parse, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("sequence", type=Path, help="the sequence it came from")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frame", type=int, help="to show (default: the middle one)")
    parser.add_argument("--azimuth", type=float, default=-120, help="of the view, degrees")
    parser.add_argument("--view", default="overview", help="of the dense map")
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    if sequence.groundtruth is None:
        raise SystemExit(f"error: {arguments.sequence}: has no groundtruth.txt to compare with")
    estimate = read_tum(arguments.run / "trajectory.txt")
    cloud = read_ply(arguments.run / "landmarks.ply")
    points = np.stack([cloud[name] for name in "xyz"], axis=1).astype(float)
    colours = np.stack([cloud[name] for name in ("red", "green", "blue")], axis=1)
    steady = cloud["observations"] >= MIN_VIEWS
    frame = sequence.load(len(sequence) // 2 if arguments.frame is None else arguments.frame)
    (row,), _ = associate_stamps(estimate.timestamps_s, np.array([frame.timestamp_s]))
    overlay = draw_landmarks(frame, sequence.camera, estimate.poses_world_camera[row], points)
    error = absolute_error(*associate(estimate, sequence.groundtruth))
    aligned = error.alignment.apply(estimate)
    points_reference = transform(error.alignment.T_reference_estimate, points)
    view = draw_cloud(points_reference[steady], colours[steady], aligned, arguments.azimuth)
    figure = Figure(figsize=(15, 8.2), dpi=100, layout="constrained")
    axes, below = figure.subplots(2, 3, width_ratios=(4, 4, 3.6))
    show(axes[0], overlay, f"frame {frame.index}: landmarks of the map, by depth")
    show(axes[1], view, f"{int(steady.sum())} of {len(points)} landmarks and the camera's path")
    draw_top_view(axes[2], aligned, sequence.groundtruth)
    rmse_mm, count = 1000 * error.translation_m.rmse, len(error.aligned)
    axes[2].set_title(f"ATE RMSE {rmse_mm:.1f} mm over {count} frames", fontsize=9)
    masks, count = draw_masks(frame, arguments.sequence)
    show(below[0], masks, f"{count} instances, by the network that comes with the project")
    dense = arguments.run / "dense"
    show(below[1], read_image(dense / f"view_{arguments.view}.png"), "the dense map")
    labelled = read_image(dense / f"view_{arguments.view}_semantic.png")
    show(below[2], labelled, "its labels")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out)
    with PIL.Image.open(arguments.out) as picture:
        few = picture.convert("RGB").quantize(256, dither=PIL.Image.Dither.FLOYDSTEINBERG)
    few.save(arguments.out, optimize=True)


if __name__ == "__main__":
    main()
