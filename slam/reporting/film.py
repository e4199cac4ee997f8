"""A short film of a run: the images beside the map that grows, with path and objects."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from matplotlib import get_data_path
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import SIDES, side_towards
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.trajectory import MAX_STAMP_ERROR_S, nearest_indices
from bmask_slam.reporting.drawing import COLOURS
from bmask_slam.reporting.film_cloud import (
    DEPTH_STEP_PX,
    Shot,
    in_image,
    keyframe_stamps,
    make_cloud,
    path_breaks,
    sampled_points,
)
from bmask_slam.reporting.film_view import SWING_DEG, Colour, MapPicture, MapView, make_view
from bmask_slam.run_folder.folder import DENSE
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.run_folder.semantic_files import OBJECTS, SavedObject, read_scene
from bmask_slam.semantics.objects.boxes3d import EDGES
from bmask_slam.semantics.segmenters.upright import turned
from bmask_slam.sequences.sequence import open_sequence

FILM, KINDS = "film.gif", (".gif", ".webp", ".mp4")
STRIP_PX, GAP_PX = 30, 4
LAST_S = 2.0
"""The last picture stays so long before the film begins again."""
MIN_SHOTS = 2
MAX_NAMES = 12
PAPER, INK, SOFT = (255, 255, 255), (28, 28, 26), (150, 150, 145)
RGB: list[Colour] = [(int(c[1:3], 16), int(c[3:5], 16), int(c[5:], 16)) for c in COLOURS]
PATH_COLOUR, CAMERA_COLOUR = RGB[1], RGB[0]


@dataclass(frozen=True)
class FilmOptions:
    """What to film.

    Attributes:
        run: folder of a run with trajectory.txt.
        out: file to write, .gif, .webp or .mp4; None: film.gif in the run's folder.
        sequence: the run's images; None: where they were.
        seconds: how long the film is, without its end.
        fps_hz: pictures a second.
        width_px: of the film.
    """

    run: Path
    out: Path | None = None
    sequence: Path | None = None
    seconds: float = 6.0
    fps_hz: float = 10.0
    width_px: int = 720

    def __post_init__(self) -> None:
        """Raise InputError for a size or a length that makes no film."""
        if not (1 <= self.seconds <= 120 and 1 <= self.fps_hz <= 30):
            raise InputError("film: give 1 to 120 seconds, and 1 to 30 pictures a second")
        if not 200 <= self.width_px <= 3840:
            raise InputError(f"film: width {self.width_px} px: give 200 to 3840")
        if self.path.suffix.lower() not in KINDS:
            raise InputError(f"{self.path}: unknown kind of film; use {', '.join(KINDS)}")

    @property
    def path(self) -> Path:
        """The file to write."""
        return self.out or self.run / FILM


def write_film(
    options: FilmOptions, progress: Callable[[int, int], None] = lambda done, total: None
) -> Path:
    """Write the film of a run and return its path. The same run gives the same bytes.

    The map is the dense one if there is one, else made of the depth images of the film's frames.

    Raises:
        InputError: no run, no images, fewer than two frames with a pose, or no such folder.
    """
    run = Run(options.run)
    if not options.path.parent.is_dir():
        raise InputError(f"{options.path.parent}: no such folder for the film; make it first")
    film = _Film(options, run)
    film.shoot(progress)
    with whole_file(options.path) as temporary:
        write = _write_video if options.path.suffix.lower() == ".mp4" else _write_animation
        write(temporary, list(film.pictures()), options)
    return options.path


class _Film:
    """Shoots frames of a run, and draws the pictures of the film one after the other."""

    def __init__(self, options: FilmOptions, run: Run) -> None:
        self._options, self._run = options, run
        folder = options.sequence or find_sequence(options.run)
        has_camera = (options.run / "graph").is_file()
        self._sequence = open_sequence(folder, camera=self._run.camera if has_camera else None)
        self._dense = options.run / DENSE / "cloud.ply"
        self._shots: list[Shot] = []
        scene = read_scene(options.run) if (options.run / OBJECTS).is_file() else None
        self._objects = () if scene is None else scene.objects
        self._up = None if scene is None else scene.up_world
        self._turns = SIDES.index(self._upper_side())
        self._camera, self._T_camera_upright = self._sequence.camera.turned(self._turns)
        self._size = self._image_size()
        labels = sorted({o.label for o in self._objects})
        self._colours = {label: RGB[k % (len(RGB) - 1)] for k, label in enumerate(labels)}

    def _upper_side(self) -> str:
        """The side of most images that is up: by the objects' world, or as the camera says."""
        if self._up is None or not len(self._run.trajectory):
            return self._sequence.camera.up or SIDES[0]
        ups = self._run.trajectory.poses_world_camera[:, :3, :3].transpose(0, 2, 1) @ self._up
        return side_towards(ups.mean(axis=0))

    def _image_size(self) -> tuple[int, int]:
        """Width and height of each half of the film; even, as videos want them."""
        camera = self._camera
        width = (self._options.width_px - GAP_PX) // 4 * 2
        return width, round(width * camera.height / camera.width / 2) * 2

    def shoot(self, progress: Callable[[int, int], None]) -> None:
        """Read the frames of the film. Raises InputError for fewer than MIN_SHOTS."""
        stamps_s, trajectory = self._sequence.timestamps_s, self._run.trajectory
        if not len(trajectory):
            raise InputError(f"{self._run.path}: no frame has a pose; there is nothing to film")
        near = nearest_indices(trajectory.timestamps_s, stamps_s)
        late_s = np.abs(trajectory.timestamps_s[near] - stamps_s)
        tracked = np.flatnonzero(late_s <= MAX_STAMP_ERROR_S)
        wanted = min(round(self._options.seconds * self._options.fps_hz), len(tracked))
        chosen = tracked[np.linspace(0, len(tracked) - 1, wanted).round().astype(int)]
        for done, index in enumerate(chosen.tolist(), 1):
            try:
                shot = self._shot(index, trajectory.poses_world_camera[near[index]])
            except InputError as error:
                self._sequence.skip(index, str(error))
            else:
                self._shots.append(shot)
            progress(done, wanted)
        if len(self._shots) < MIN_SHOTS:
            few = f"{self._run.path} has poses of {len(self._shots)} of its frames, too few to film"
            raise InputError(f"{self._sequence.folder}: {few}; give a longer run, its own images")

    def _shot(self, index: int, T_world_camera: Array) -> Shot:
        """A frame as an upright camera would have taken it."""
        frame, T_world_camera = self._sequence.load(index), T_world_camera @ self._T_camera_upright
        rgb, depth = (turned(image, self._turns) for image in (frame.rgb, frame.depth_m))
        points, colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        if not self._dense.is_file():
            points, colours = sampled_points(rgb, depth, self._camera)
            points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        small = cv2.resize(rgb, self._size, interpolation=cv2.INTER_AREA)
        depth_m = depth[::DEPTH_STEP_PX, ::DEPTH_STEP_PX].copy()
        kept = points.astype(np.float32), colours
        return Shot(index, frame.timestamp_s, small, depth_m, T_world_camera, *kept)

    def pictures(self) -> Iterator[Image]:
        """The pictures (H, W, 3), red first."""
        poses = np.stack([shot.T_world_camera for shot in self._shots])
        up = -poses[:, :3, 1].mean(axis=0) if self._up is None else self._up
        cloud = make_cloud(self._shots, self._camera, self._dense)
        if not len(cloud.first):
            raise InputError(f"{self._run.path}: no depth in the frames; there is nothing to film")
        view = make_view(cloud, poses, up / np.linalg.norm(up), self._size)
        made_s, self._breaks = keyframe_stamps(self._run), path_breaks(self._run, self._shots)
        for number, shot in enumerate(self._shots):
            there = [o for o in self._objects if o.first_seen_s <= shot.timestamp_s]
            left, left_names = self._frame(shot, there)
            right, right_names = self._map(view, poses[: number + 1], there)
            gap = np.full((self._size[1], GAP_PX, 3), PAPER, np.uint8)
            halves = np.hstack([left, gap, right])
            strip = np.full((STRIP_PX, halves.shape[1], 3), PAPER, np.uint8)
            count = int((made_s <= shot.timestamp_s).sum())
            time_s = shot.timestamp_s - self._shots[0].timestamp_s
            text = f"frame {shot.index}    {time_s:.1f} s    keyframes: {count}"
            text += f"    objects: {len(there)}" if self._objects else ""
            names = (left_names, 0), (right_names, self._size[0] + GAP_PX)
            done = (number + 1) / len(self._shots)
            yield self._written(np.vstack([halves, strip]), names, text, done)

    def _frame(self, shot: Shot, there: Sequence[SavedObject]) -> tuple[Image, list[_Name]]:
        """The image with the names of the objects that are in it."""
        camera, names = self._camera, []
        if there:
            centres = np.stack([o.centroid_world for o in there])
            rows, pixels, z = in_image(centres, shot.T_world_camera, camera)
            cells = (pixels / DEPTH_STEP_PX).astype(int)
            depth_m = shot.depth_m[cells[:, 1], cells[:, 0]]
            reach_m = np.array([np.linalg.norm(there[k].box.size_m) / 2 for k in rows.tolist()])
            seen = ~(depth_m < z - reach_m)
            places = pixels * (self._size[0] / camera.width)
            names = [self._name(there[rows[k]], places[k]) for k in np.flatnonzero(seen).tolist()]
        return shot.image, names

    def _map(
        self, view: MapView, poses: Array, there: Sequence[SavedObject]
    ) -> tuple[Image, list[_Name]]:
        """The map as it is at the last of these poses (S, 4, 4), and the names of its objects."""
        turn_deg = SWING_DEG * np.sin(2 * np.pi * len(poses) / len(self._shots))
        drawn = MapPicture(view, float(turn_deg), len(poses))
        for o in there:
            drawn.edges(o.box.corners_world[EDGES], self._colours[o.label])
        drawn.lines(np.split(poses[:, :3, 3], self._breaks), PATH_COLOUR, 2)
        drawn.frustum(poses[-1], self._camera, CAMERA_COLOUR)
        if not there:
            return drawn.image, []
        places, ahead = drawn.place(np.stack([o.box.T_world_box[:3, 3] for o in there]))
        pairs = zip(there, places, ahead, strict=True)
        return drawn.image, [self._name(o, place) for o, place, inside in pairs if inside]

    def _name(self, o: SavedObject, place: Array) -> _Name:
        return o.label[:24], (float(place[0]), float(place[1])), self._colours[o.label]

    @cached_property
    def _font(self) -> ImageFont.FreeTypeFont:
        height = max(9, round(self._size[1] / 26))
        return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", height)

    def _written(
        self, picture: Image, halves: Sequence[tuple[list[_Name], int]], text: str, share: float
    ) -> Image:
        """The picture with names that do not cover each other, the text, and how far it is.

        ``halves``: the names in each half, by places in it, and where it begins.
        """
        image = Pillow.fromarray(picture)
        pen = ImageDraw.Draw(image)
        for names, left in halves:
            taken: list[_Rectangle] = []
            for name, (x, y), colour in names[:MAX_NAMES]:
                middle = x + left, y
                low_x, low_y, high_x, high_y = pen.textbbox(middle, name, self._font, anchor="mm")
                box = low_x - 3, low_y - 2, high_x + 3, high_y + 2
                inside = left <= box[0] and box[2] < left + self._size[0]
                inside &= box[1] >= 0 and box[3] < self._size[1]
                if inside and not any(_overlap(box, other) for other in taken):
                    taken.append(box)
                    pen.rectangle(box, fill=PAPER, outline=colour)
                    pen.text(middle, name, font=self._font, anchor="mm", fill=INK)
        height = self._size[1]
        place = (6, height + STRIP_PX / 2 + 2)
        pen.text(place, text, font=self._font, anchor="lm", fill=INK)
        pen.rectangle((0, height, share * image.width, height + 3), fill=CAMERA_COLOUR)
        return np.asarray(image)


_Name = tuple[str, tuple[float, float], Colour]
_Rectangle = tuple[float, float, float, float]


def _overlap(a: _Rectangle, b: _Rectangle) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _write_animation(path: Path, pictures: Sequence[Image], options: FilmOptions) -> None:
    """Write a GIF, with one palette for all pictures, or a WebP, that begins again at its end."""
    images = [Pillow.fromarray(picture) for picture in pictures]
    duration_ms = [round(1000 / options.fps_hz)] * len(images)
    duration_ms[-1] = round(1000 * LAST_S)
    if path.suffix.lower() == ".gif":
        some = np.vstack(pictures[:: max(len(pictures) // 6, 1)])
        palette = Pillow.fromarray(some).quantize(255, Pillow.Quantize.MEDIANCUT)
        none = Pillow.Dither.NONE
        images = [image.quantize(palette=palette, dither=none) for image in images]
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration_ms, loop=0)


def _write_video(path: Path, pictures: Sequence[Image], options: FilmOptions) -> None:
    """Write an MP4 (MPEG-4 Part 2, which players know; browsers want H.264)."""
    height, width = pictures[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), code, options.fps_hz, (width, height))
    if not writer.isOpened():
        raise InputError(f"{path}: OpenCV has no encoder for it here; use .gif or .webp")
    shown = [*pictures, *[pictures[-1]] * round(LAST_S * options.fps_hz)]
    for picture in shown:
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    written = cv2.VideoCapture(str(path))  # the writer says nothing of a full disk
    is_whole = round(written.get(cv2.CAP_PROP_FRAME_COUNT)) == len(shown)
    written.release()
    if not is_whole:
        raise InputError(f"{options.path}: cannot be written whole; free some space")
