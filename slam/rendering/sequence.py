"""Rendered indoor sequences with exact ground truth, in TUM layout."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.rendering.annotations import (
    OBJECTS_TRUTH,
    VisibleInstance,
    coco,
    true_boxes,
    visible_instances,
)
from bmask_slam.rendering.config import (
    CLOSED,
    MARKERS,
    RenderConfig,
    check_config,
    kinect_camera,
)
from bmask_slam.rendering.engine.builder import SceneBuilder
from bmask_slam.rendering.engine.lighting import Lighting
from bmask_slam.rendering.engine.path import CameraPath, camera_poses, poses_at
from bmask_slam.rendering.engine.raycast import Geometry, Renderer, View, to_image
from bmask_slam.rendering.engine.scene import Scene, build_scene
from bmask_slam.rendering.engine.sensor import blur, exposure_gain, measure_depth, optical_flow
from bmask_slam.rendering.markers import PlacedMarker, add_markers, write_truth
from bmask_slam.rendering.rooms.random_room import draw_room
from bmask_slam.rendering.sensors import write_sensors
from bmask_slam.rendering.things.people import Cast, Role, add_people
from bmask_slam.rendering.writer import new_folder, stored_depth, write_json, write_lists, write_png
from bmask_slam.sequences.cameras import write_camera

_WORKERS, _SHUTTER_SHARE, _IMAGE_NOISE = 2, 0.6, 2.0


def render_sequence(
    config: RenderConfig, out: Path, progress: Callable[[int, int], None] = lambda done, total: None
) -> Path:
    """Render a sequence to the new folder ``out`` and return it.

    ``progress(done, total)`` is called after every frame. The folder appears when it is complete.

    Raises:
        InputError: unknown scene, impossible number, or ``out`` not empty or not writable.
    """
    check_config(config)
    with new_folder(Path(out)) as folder:
        load_open3d()  # if it is not there, that is said before a room is built
        job = _prepare(config, folder)
        visible = []
        with closing(_draw_all(job)) as drawn:  # whatever happens, no thread writes afterwards
            for found in drawn:
                visible.append(found)
                progress(len(visible), len(job.poses))
        write_lists(folder, job.stamps, job.poses)
        write_camera(folder / "camera.yaml", job.camera)
        write_sensors(folder, config, job.poses, _plan(config).path)
        write_json(folder / "annotations.json", coco(visible, job.stamps, job.camera, job.scene))
    return Path(out)


@dataclass(frozen=True)
class _Job:
    """Everything that stays the same from frame to frame.

    ``poses`` are T_world_camera (N, 4, 4) when colour is taken.
    """

    config: RenderConfig
    folder: Path
    camera: Camera
    path: CameraPath
    poses: Array
    stamps: list[str]
    scene: Scene
    cast: Cast
    renderer: Renderer


@dataclass(frozen=True)
class _Plan:
    """A scene before it is built."""

    path: CameraPath
    roles: tuple[Role, ...]
    lighting: Lighting
    furnish: Callable[[SceneBuilder], None]


def _plan(config: RenderConfig) -> _Plan:
    if config.name == "room":
        room = draw_room(config.seed)
        return _Plan(room.path, room.roles, room.lighting, room.furnish)
    module = importlib.import_module(f"bmask_slam.rendering.rooms.{config.name}")
    path = module.path(config.rounds) if config.name in CLOSED else module.PATH
    return _Plan(path, module.ROLES, module.LIGHTING, module.furnish)


def _prepare(config: RenderConfig, folder: Path) -> _Job:
    plan = _plan(config)
    poses = camera_poses(plan.path, config.fps, config.seed, sweeping=config.sweeping)
    if config.frames is not None and config.frames > len(poses):
        raise InputError(
            f"frames={config.frames}: the path of {config.name!r} has {len(poses)} frames at "
            f"{config.fps:g} Hz; ask for at most as many"
        )
    if config.people > len(plan.roles):
        raise InputError(
            f"people={config.people}: {config.name!r} has room for {len(plan.roles)}; ask for fewer"
        )
    poses = poses[: config.frames]
    detail = float(np.clip(config.width / 640, 0.25, 1.0))
    alike = RenderConfig(config.name, None, config.seed, config.people, config.carry)
    hung = (MARKERS,) if MARKERS in config.sensors else ()
    alike = replace(alike, rounds=config.rounds, sensors=hung)
    boxes, cast, scene, markers = _built(alike, detail)
    if markers:
        write_truth(folder, markers)
    write_json(folder / OBJECTS_TRUTH, boxes)
    camera = kinect_camera(config)
    stamps = [f"{i / config.fps:.6f}" for i in range(len(poses))]
    shown = Renderer(camera, scene.atlas, scene.static)
    return _Job(config, folder, camera, plan.path, poses, stamps, scene, cast, shown)


@lru_cache(maxsize=4)
def _built(
    config: RenderConfig, detail: float
) -> tuple[dict[str, Any], Cast, Scene, list[PlacedMarker]]:
    """The true boxes, people, scene and markers; textures have ``detail`` of the full resolution.

    The last are kept, for other rates and lengths; ``config`` may hold only what they depend on.
    """
    plan = _plan(config)
    builder = SceneBuilder(config.seed, detail=detail)
    plan.furnish(builder)
    boxes = true_boxes(builder)
    roles = plan.roles
    if config.carry:
        roles = (replace(roles[0], carries="box", pulls=True), *roles[1:])
    cast = add_people(builder, roles[: config.people], plan.lighting, plan.path)
    markers = add_markers(builder, plan.path) if config.sensors else []
    scene = build_scene(builder, plan.lighting, cast.parts, config.seed)
    return boxes, cast, scene, markers


def _draw_all(job: _Job) -> Generator[list[VisibleInstance], None, None]:
    """Draw and write frames on worker threads; annotations come in order."""
    waiting: deque[Future[list[VisibleInstance]]] = deque()
    with ThreadPoolExecutor(_WORKERS) as pool:
        for i in range(len(job.poses)):
            waiting.append(pool.submit(_draw, job, i))
            if len(waiting) > 2 * _WORKERS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _draw(job: _Job, i: int) -> list[VisibleInstance]:
    """Draw, disturb and write frame ``i``: a function of the configuration and ``i`` alone."""
    time_s = i / job.config.fps
    view = job.renderer.render(_poses(job, time_s), _moving(job, time_s))
    rng = np.random.default_rng([job.config.seed, 3, i])
    rgb = _exposed(job, i, view, rng)
    true_m, normals = view.depth_m, view.normals
    if job.config.depth_delay_ms:
        delayed_s = time_s + job.config.depth_delay_ms / 1e3
        late = _poses(job, delayed_s)
        true_m, normals = job.renderer.render_depth(late, _moving(job, delayed_s))
    depth_m = measure_depth(true_m, normals, job.camera, rng) if job.config.noise else true_m
    name = f"{job.stamps[i]}.png"
    write_png(job.folder / "rgb" / name, rgb)
    write_png(job.folder / "depth" / name, stored_depth(depth_m, job.camera.depth_scale))
    write_png(job.folder / "instances" / name, view.instances)
    if job.config.true_depth:
        write_png(job.folder / "depth_true" / name, stored_depth(true_m, job.camera.depth_scale))
    if job.config.normals:
        write_png(job.folder / "normals" / name, to_image(127.5 * view.normals + 127.5))
    return visible_instances(view.instances)


def _poses(job: _Job, time_s: float) -> Array:
    """T_world_camera (4, 4) of an image at a time; of each row (H, 4, 4) where they take turns."""
    config = job.config
    if not config.rolling_shutter_ms:
        return poses_at(job.path, np.array([time_s]), config.seed, config.sweeping)[0]
    shares = job.camera.share_of_rows(np.arange(float(config.height)))
    rows_s = time_s + config.rolling_shutter_ms / 1e3 * shares
    return poses_at(job.path, rows_s, config.seed, config.sweeping)


def _moving(job: _Job, time_s: float) -> Geometry | None:
    """What moves, where it is at this time."""
    return job.cast.geometry(time_s, job.scene) if job.cast.parts else None


def _exposed(job: _Job, i: int, view: View, rng: np.random.Generator) -> Image:
    """The colour image (H, W, 3) uint8 with motion blur, exposure and noise."""
    config, rgb = job.config, view.rgb
    if config.motion_blur:
        pair = job.poses[max(i - 1, 0)], job.poses[min(i + 1, len(job.poses) - 1)]
        steps = max(1, min(i + 1, len(job.poses) - 1) - max(i - 1, 0))
        flow = optical_flow(view.depth_m, job.camera, inverse(pair[1]) @ pair[0])
        rgb = blur(rgb, _SHUTTER_SHARE / steps * flow)
    if config.exposure_change:
        rgb = rgb * np.float32(exposure_gain(i / config.fps, config.seed))
    if config.noise:
        rgb = rgb + _IMAGE_NOISE * rng.standard_normal(rgb.shape, dtype=np.float32)
    return to_image(rgb)
