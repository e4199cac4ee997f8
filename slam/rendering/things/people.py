"""People who stand, sit, walk and carry things: bodies of round limbs that move with time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.rendering.engine.builder import UNLABELLED, Painter, Part, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lighting, irradiance
from bmask_slam.rendering.engine.meshes import Shape, ellipsoid, lathe, pose, tapered_capsule, tilt
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.engine.raycast import Geometry
from bmask_slam.rendering.engine.scene import Scene, assemble
from bmask_slam.rendering.things import objects as o
from bmask_slam.rendering.things import skeleton as sk
from bmask_slam.rendering.things.drawing import random_colour
from bmask_slam.rendering.things.furniture import lying_book, office_chair
from bmask_slam.rendering.things.prints import patchwork
from bmask_slam.rendering.things.surfaces import (
    Colour,
    as_image,
    fabric,
    field,
    flat,
    octaves,
    plain,
)
from bmask_slam.rendering.things.walks import Escort, on_round

_SKIN: tuple[Colour, ...] = ((224, 178, 148), (198, 146, 112), (150, 102, 72), (108, 72, 52))
_HAIR: tuple[Colour, ...] = ((40, 30, 24), (92, 60, 36), (150, 112, 62), (120, 118, 116))


@dataclass(frozen=True)
class Role:
    """What a person does in a scene.

    Attributes:
        action: "stand", "sit" or "walk".
        places: (x, y) in metres: one to stand or sit at, or a closed round to walk.
        escorts: whether the round moves with the camera: x to its right, y ahead of it.
        facing_deg: heading of a standing or sitting person, 0 along -y, counter-clockwise.
        carries: "", "suitcase", "book", "cup", "cell phone", "umbrella" or "box".
        speed_m_s: walking speed.
        patched: whether the shirt is of patches, with many corners.
        pulls: whether the person pulls a chair from PULLED_S[0] to PULLED_S[1], where it stays.
    """

    action: str
    places: tuple[tuple[float, float], ...]
    facing_deg: float = 0.0
    carries: str = ""
    speed_m_s: float = 0.8
    patched: bool = False
    pulls: bool = False
    escorts: bool = False


@dataclass(frozen=True)
class Person:
    """A person with a role; ``phase`` in [0, 1) makes the motion of people with equal roles differ.

    ``escort`` is the walk of a person that moves with the camera.
    """

    role: Role
    phase: float
    scale: float
    escort: Escort | None = None

    def bones(self, time_s: float) -> dict[str, Array]:
        """Poses T_world_bone (4, 4) by name, for the body's size."""
        posture, T_world_person = self._posture(time_s)
        if self.role.carries:
            posture = sk.holding(posture, _GRIPS[self.role.carries])
        size = np.diag([self.scale, self.scale, self.scale, 1.0])
        bones = {
            name: T_world_person @ size @ T_person_bone @ np.linalg.inv(size)
            for name, T_person_bone in sk.bones(posture).items()
        }
        if self.role.pulls:
            bones["pulled"] = self._posture(float(np.clip(time_s, *PULLED_S)))[1] @ _BESIDE
        return bones

    def _posture(self, time_s: float) -> tuple[sk.Posture, Array]:
        role = self.role
        if role.action == "walk":
            T_world_person, distance_m = self._walked(time_s)
            stride = 2 * np.pi * distance_m / (1.3 * self.scale)
            return sk.walking(stride, bool(role.carries)), T_world_person
        here = pose(*role.places[0], 0.0, role.facing_deg)
        act = sk.sitting if role.action == "sit" else sk.standing
        return act(time_s, self.phase), here

    def _walked(self, time_s: float) -> tuple[Array, float]:
        if self.escort is not None:
            return self.escort.at(time_s)
        return on_round(self.role.places, self.role.speed_m_s * time_s, self.phase)


_GRIPS = {
    "suitcase": "hang",
    "book": "front",
    "cup": "front",
    "cell phone": "high",
    "umbrella": "front",
    "box": "both",
}

PULLED_S = (5.0, 7.0)
"""First and last time at which a chair is pulled."""
_BESIDE = pose(-0.75, 0.3, 0.0, 30)


@dataclass(frozen=True)
class Cast:
    """All people in a scene.

    Attributes:
        people: the people, in order of their instances.
        parts: surfaces of bodies and carried things, each in its bone's frame.
        owners: for each part the number of its person and the name of its bone.
        lighting: the scene's lamps.
    """

    people: tuple[Person, ...]
    parts: list[Part]
    owners: list[tuple[int, str]]
    lighting: Lighting

    def geometry(self, time_s: float, scene: Scene) -> Geometry:
        """All bodies as they are at a time, lit without cast shadows."""
        poses = [person.bones(time_s) for person in self.people]
        placed = []
        for part, (who, bone) in zip(self.parts, self.owners, strict=True):
            shape = part.shape.moved(poses[who][bone])
            light = np.ones(shape.corners.shape[:2])
            if not part.shines:
                points, normals = shape.corners.reshape(-1, 3), shape.normals.reshape(-1, 3)
                light = irradiance(self.lighting, points, normals).reshape(light.shape)
            placed.append(replace(part, shape=shape, light=light))
        return assemble(placed, scene.first_moving_texture + np.arange(len(placed)))


def add_people(
    b: SceneBuilder, roles: tuple[Role, ...], lighting: Lighting, path: CameraPath
) -> Cast:
    """Make a person for each role; each is an instance of the builder."""
    people, parts, owners = [], [], []
    for who, role in enumerate(roles):
        phase, scale = b.rng.random(), b.rng.uniform(0.94, 1.06)
        phase = 0.0 if role.pulls else phase
        escort = Escort(path, role.places, role.speed_m_s, phase) if role.escorts else None
        person = Person(role, phase, scale, escort)
        people.append(person)
        load = [*_load(b, role.carries), *(_pulled(b) if role.pulls else [])]
        for bone, part in [*_body(b, person.scale, role.patched), *load]:
            parts.append(part)
            owners.append((who, bone))
    return Cast(tuple(people), parts, owners, lighting)


def _moving_parts(b: SceneBuilder, category: str, build: Callable[[], None]) -> list[Part]:
    """The parts that ``build`` adds as one new instance, removed from the static scene."""
    first = len(b.parts)
    with b.at(np.eye(4), category):
        build()
    parts = b.parts[first:]
    del b.parts[first:]
    return parts


def _body(b: SceneBuilder, scale: float, patched: bool) -> list[tuple[str, Part]]:
    names: list[str] = []

    def build() -> None:
        for bone, shape, painter in _limbs(b.rng, patched):
            larger = Shape(scale * shape.corners, shape.normals, shape.uvs)
            extent = np.ptp(larger.corners.reshape(-1, 3), axis=0)
            b.solid(larger, painter, (np.pi * float(extent[:2].max()), float(extent[2])), 600)
            names.append(bone)

    parts = _moving_parts(b, "person", build)
    return list(zip(names, parts, strict=True))


def _limbs(rng: np.random.Generator, patched: bool) -> list[tuple[str, Shape, Painter]]:
    """Bone, shape in the bone's frame and painter of every limb, for a person of 1.72 m."""
    skin, hair = _SKIN[rng.integers(4)], _HAIR[rng.integers(4)]
    shirt = fabric(random_colour(rng, 60, 230), random_colour(rng, 20, 240))
    shirt = patchwork() if patched else shirt
    trousers, shoes = fabric(random_colour(rng, 25, 110)), plain(random_colour(rng, 20, 90))
    profile = [(0.11, -0.01), (0.138, 0.02), (0.134, 0.08), (0.125, 0.18), (0.15, 0.36),
               (0.148, 0.44), (0.1, 0.5), (0.05, 0.53)]  # fmt: skip
    torso = lathe(np.array(profile), 20, (1.22, 0.8))
    pelvis = ellipsoid((0.165, 0.105, 0.13))
    neck = tapered_capsule(0.1, 0.048, 0.045).moved(pose(0, 0, 0.51))
    head = ellipsoid((0.078, 0.098, 0.118), 24).moved(pose(0, -0.015, 0.125))
    limbs: list[tuple[str, Shape, Painter]] = [
        ("torso", torso, shirt),
        ("torso", pelvis, trousers),
        ("torso", neck, plain(skin)),
        ("head", head, _face(skin, hair)),
    ]
    for side in ("right", "left"):
        limbs += [
            (f"{side} thigh", tapered_capsule(sk.THIGH_M, 0.088, 0.06), trousers),
            (f"{side} shin", tapered_capsule(sk.SHIN_M, 0.06, 0.042), trousers),
            (f"{side} foot", _shoe(), shoes),
            (f"{side} upper arm", tapered_capsule(sk.UPPER_ARM_M, 0.06, 0.043), shirt),
            (f"{side} forearm", tapered_capsule(sk.FOREARM_M, 0.042, 0.03), shirt),
            (
                f"{side} hand",
                ellipsoid((0.024, 0.042, 0.085), 12).moved(pose(0, 0, 0.07)),
                plain(skin),
            ),
        ]
    return limbs


def _shoe() -> Shape:
    return ellipsoid((0.05, 0.055, 0.145), 14).moved(pose(0, 0.025, 0.07))


def _face(skin: Colour, hair: Colour) -> Painter:
    """A head unrolled: the face in the middle, hair above and behind."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = flat(rows, columns, skin) + 5 * octaves(rows, columns, [2, 8, 30], rng)[..., None]
        u = np.abs(np.linspace(-1, 1, columns))[None]
        v = np.linspace(0, 1, rows)[:, None]
        line = np.where(u < 0.27, 0.3, np.clip(0.3 + (u - 0.27) * 3.5, 0, 0.78))
        line = line + 0.015 * field(rows, columns, (rows, 4), rng)
        strands = flat(rows, columns, hair) + 14 * field(rows, columns, (12, 1.5), rng)[..., None]
        picture = np.ascontiguousarray(np.where((v < line)[..., None], strands, picture))
        tone = tuple(0.62 * np.array(skin))
        _features(picture, hair, tone)
        return as_image(picture)

    return paint


def _features(picture: Floats, hair: Colour, tone: Colour) -> None:
    """Draw eyes, brows, nose and mouth in the middle of an unrolled head."""
    rows, columns = picture.shape[:2]
    middle, level, w = columns // 2, round(0.47 * rows), max(1, columns // 40)
    for sign in (-1, 1):
        x = middle + sign * round(0.062 * columns)
        white, iris = (w, max(1, w // 3)), (max(1, w // 2), max(1, w // 3))
        cv2.ellipse(picture, (x, level), white, 0, 0, 360, (238, 238, 236), -1, cv2.LINE_AA)
        cv2.ellipse(picture, (x, level), iris, 0, 0, 360, (46, 34, 28), -1, cv2.LINE_AA)
        brow = level - round(0.055 * rows)
        cv2.line(picture, (x - w, brow), (x + w, brow), hair, max(1, w // 4), cv2.LINE_AA)
    tip = (middle - w // 3, round(0.58 * rows))
    cv2.line(picture, (middle, level), tip, tone, max(1, w // 3), cv2.LINE_AA)
    lips = (round(1.3 * w), max(1, w // 4))
    cv2.ellipse(
        picture, (middle, round(0.68 * rows)), lips, 0, 0, 360, (160, 74, 70), -1, cv2.LINE_AA
    )


def _load(b: SceneBuilder, carries: str) -> list[tuple[str, Part]]:
    """The parts in the right hand, in the frame of its grip: z up, -y to the front."""
    if not carries:
        return []

    def build() -> None:
        if carries == "suitcase":
            with b.at(pose(-0.06, 0, -0.71, 90)):
                o.suitcase(b, random_colour(b.rng, 30, 200), pulled_out=False)
        elif carries == "book":
            with b.at(pose(0.06, -0.05, 0.03) @ tilt("x", 25)):
                lying_book(b)
        elif carries == "cup":
            with b.at(pose(0, -0.04, -0.02)):
                o.cup(b, random_colour(b.rng, 60, 230))
        elif carries == "box":
            with b.at(pose(0.2, -0.1, -0.1)):
                o.parcel(b)
        elif carries == "umbrella":
            with b.at(pose(0, 0, 0) @ tilt("x", 180) @ pose(0, 0, -0.84)):
                o.umbrella(b, random_colour(b.rng, 60, 230), opened=True)
        else:
            with b.at(tilt("x", 80)):
                o.cell_phone(b)

    category = UNLABELLED if carries == "box" else carries
    return [("right grip", part) for part in _moving_parts(b, category, build)]


def _pulled(b: SceneBuilder) -> list[tuple[str, Part]]:
    parts = _moving_parts(b, "chair", lambda: office_chair(b, (150, 60, 44)))
    return [("pulled", part) for part in parts]
