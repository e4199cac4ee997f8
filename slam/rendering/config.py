"""What to render: the configuration of a sequence, and the camera that it is seen with."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, did_you_mean
from bmask_slam.graph.sensors.streams import FILES

SCENES: dict[str, str] = {
    "office": "an office for three with desks, computers and bookcases; one round through it",
    "busy_office": "the same office from the door side, with room for people to walk before it",
    "crowded_office": "the busy office with people who walk along close before the camera",
    "living_room": "a living room with sofa, television, dining table and bookcase; one round",
    "corridor": "a square corridor, a loop of 30 m that ends where it began",
    "building": "three storeys of look-alike rooms along corridors, 626 m; 13 minutes of walking",
    "room": "a room drawn at random from the seed: size, walls, light, furniture and round",
}
"""Names and one-line descriptions of the scenes."""
CLOSED = ("corridor",)
"""Scenes whose path ends where it began: it can be walked more than once."""
MARKERS = "markers"
"""The sensor that is no file, but on the walls."""


@dataclass(frozen=True)
class RenderConfig:
    """What to render; equal configurations give equal bytes.

    Attributes:
        name: one of SCENES.
        frames: number of frames from the start of the path; None for the whole path.
        rounds: how often the path is walked; more than once in a scene of CLOSED only.
        seed: of people, noise, textures and the hand's tremor, and of a random room.
        people: how many people stand, sit, walk and carry things in the scene.
        carry: the first of them carries a box without a class, and pulls a chair for a while.
        noise: apply the Kinect's depth noise and holes, and image noise of 2 grey levels.
        exposure_change: let the brightness vary slowly.
        motion_blur: blur along the image motion while the shutter is open.
        fps: frame rate in hertz.
        depth_delay_ms: take each depth image so much later than the colour image whose stamp
            it gets; ``camera.yaml`` does not say so.
        rolling_shutter_ms: expose the rows of both images one after the other over so long, top
            first, the middle at their time; ``camera.yaml`` does not say so, and people stand still
            meanwhile.
        sweeping: add tilt, pan, roll and translation to the path, as for a calibration.
        width, height: image size in pixels; the field of view stays the Kinect's.
        true_depth: also write the noise-free depth to ``depth_true/``.
        normals: also write camera-frame normals to ``normals/`` as round(127.5 n + 127.5).
        sensors: also write the files of "odometry", "position", "accelerometer", "imu"; "markers":
            hang markers on the walls.
    """

    name: str
    frames: int | None = None
    seed: int = 0
    people: int = 0
    carry: bool = False
    noise: bool = True
    exposure_change: bool = False
    motion_blur: bool = False
    fps: float = 30.0
    depth_delay_ms: float = 0.0
    rolling_shutter_ms: float = 0.0
    sweeping: bool = False
    width: int = 640
    height: int = 480
    true_depth: bool = False
    normals: bool = False
    rounds: int = 1
    sensors: tuple[str, ...] = ()


def kinect_camera(config: RenderConfig) -> Camera:
    """A Kinect's intrinsics, scaled to the image size by (u + 0.5) s - 0.5."""
    sx, sy = config.width / 640, config.height / 480
    return Camera(
        config.width, config.height, fx=525.0 * sx, fy=525.0 * sy,
        cx=320.0 * sx - 0.5, cy=240.0 * sy - 0.5, fps=config.fps, stereo_bf_px_m=40.0 * sx,
    )  # fmt: skip


def check_config(config: RenderConfig) -> None:
    """Raise InputError for an unknown scene or an impossible number."""
    if config.name not in SCENES:
        known = f"{', '.join(SCENES)}{did_you_mean(config.name, SCENES)}"
        raise InputError(f"scene {config.name!r} is unknown; choose one of {known}")
    for name, number in (("frames", config.frames), ("rounds", config.rounds)):
        if number is not None and number < 1:
            raise InputError(f"{name}={number}: must be at least 1")
    if config.rounds > 1 and config.name not in CLOSED:
        raise InputError(
            f"rounds={config.rounds}: the path of {config.name!r} does not end where it began; "
            f"only {', '.join(CLOSED)} can be walked more than once"
        )
    if min(config.people, config.seed) < 0:
        raise InputError(f"people={config.people}, seed={config.seed}: must not be negative")
    if config.carry and not config.people:
        raise InputError("carry: there is nobody to carry anything; ask for people=1")
    if not 0.1 <= config.fps <= 1000:
        raise InputError(f"fps={config.fps}: must be between 0.1 and 1000")
    if not abs(config.depth_delay_ms) <= 1000:
        raise InputError(f"depth delay {config.depth_delay_ms} ms: must be at most 1000 either way")
    if not abs(config.rolling_shutter_ms) <= 1000 / config.fps:
        raise InputError(
            f"rolling shutter {config.rolling_shutter_ms} ms: must be at most the time between "
            f"images, {1000 / config.fps:.3g} ms, either way"
        )
    for sensor in set(config.sensors) - {*FILES, MARKERS}:
        known = ", ".join((*FILES, MARKERS))
        raise InputError(f"sensor {sensor!r} is unknown; choose of {known}")
    if min(config.width, config.height) < 16:
        raise InputError(f"{config.width}x{config.height}: too small; use at least 16x16")
