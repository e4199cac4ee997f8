"""A system restored from its state has equal attributes and continues identically."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, PlaneViews

from bmask_slam.config.configuration import resolve
from bmask_slam.features.patch_alignment import PATCH_PX
from bmask_slam.graph.arrays import Array, Arrays, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import GraphUpdate, RelativePose
from bmask_slam.graph.files.array_file import part
from bmask_slam.graph.files.disk_arrays import DiskRows
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.smoother.storage import graph_arrays
from bmask_slam.labelling.awaited_masks import kept_depth
from bmask_slam.labelling.label_views import FIRST_LABEL_VIEW, LabelView
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.moving.static_verification import PendingMovable, Removed
from bmask_slam.semantics.instances.instances import Instance, PackedMask, certain, mask_box
from bmask_slam.semantics.instances.surfaces import Segmented, SurfaceClasses
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.tracks.instance_track import Sighting
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_results import OPTIONAL_ARRAYS
from bmask_slam.world.appearance import PATCHES, Patches
from bmask_slam.world.landmark_table import LandmarkTable
from bmask_slam.world.map_state import world_of

FILE = Path("run/checkpoint")
SCRATCH = {
    *("elapsed_s", "stage_ms", "_disk", "_ahead", "_searcher", "revision"),
    *("_observers", "changed", "_were_in_graph", "_sent", "_waiting"),
}
"""Nothing between two frames; counts of changes in this process; what is found anew in the map."""
OPAQUE = ("cv2", "gtsam", "faiss")  # made anew from configuration or state
PLAIN = {int, float, str, bool, type(None)}
SETTINGS = [  # a keyframe nearly every frame, and most of them culled again
    *("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0"),
    *("mapping.redundant_share=0.3", "mapping.redundant_views=2", "features.max_keypoints=250"),
]


def poses(count: int) -> list[Array | None]:
    """Poses sideways along a plane and back; None for two black frames on the way."""
    x = np.concatenate([np.arange(count), np.arange(count)[::-1]]) * 0.03
    turn = [se3_exp(np.array([0, 0.05 * np.sin(40 * a), 0, a - 0.4, 0, 0])) for a in x]
    return [None if i in (9, 10) else T for i, T in enumerate(turn)]


class Halves:
    """A segmenter: the left half of every image is one instance, the right half another.

    All of it is more of a wall than of a floor.
    """

    labels = label_set(("left", "right"))

    def segment(self, image: Image, name: str) -> list[Instance]:
        left = np.zeros(image.shape[:2], bool)
        left[:, : image.shape[1] // 2] = True
        found = [
            Instance(m, mask_box(m), k, certain(k, 3, 0.8), 0.8, 0.7)
            for k, m in ((1, left), (2, ~left))
        ]
        p = np.broadcast_to(np.array([0.6, 0.4], np.float16), (6, 8, 2))
        names, size = label_set(("wall", "floor")), (image.shape[0], image.shape[1])
        return Segmented(found, SurfaceClasses(names, p, image.shape[1] / 8, size))


FRAMES = PlaneViews(poses(14))
CONFIG = resolve(SystemConfig, None, SETTINGS)


@pytest.fixture(scope="module")
def system() -> SlamSystem:
    system = at_checkpoint()
    first, second = list(system.mapper.world.keyframes)[:2]
    loop = RelativePose(first, second, np.eye(4), np.eye(6), robust="dcs", kind="loop")
    smoother = system.mapper.smoother
    old = smoother.estimate().landmark_ids[:40]
    smoother.update(GraphUpdate(relative_poses=(loop,), marginalise_landmarks=old))
    smoother.update(GraphUpdate(landmark_ids=old[:5], points_world=np.zeros((5, 3))))
    smoother.restart()
    system.mapper._factor_selector.remove_landmarks(
        np.array([5, 8])
    )  # none wait between two frames so far
    landmarks = system.mapper.world.landmarks
    landmarks.reserve(len(landmarks), len(landmarks) + 3, np.zeros(0, np.int64))
    loops, pairs = system.mapper.loops, np.array([[3, 7], [4, 9]])
    loops.waiting = [
        LoopConstraint(first, second, np.eye(4), np.eye(6), 30 + k, 1.5, pairs[k:])
        for k in range(2)
    ]
    system.events.count({"landmarks dropped": 3, "observations pruned: mask": 40})
    system.semantics.await_masks(
        system.mapper.world.keyframes[first], kept_depth(FRAMES[3].depth_m)
    )
    seen = np.arange(8.0).reshape(4, 2), np.arange(4), kept_depth(FRAMES[5].depth_m)
    for number, keyframe_id in enumerate((first, second), FIRST_LABEL_VIEW + 2):
        view = LabelView(number, 0.1 * number, keyframe_id, np.eye(4), *seen)
        system.semantics.await_view(view)
    sighting = Sighting(np.array([0.1, 0, 2]), np.full(3, 0.2), certain(1, 3), 1.0)
    system.moving_objects.tracks.update(FRAMES[19].timestamp_s, [sighting])
    removed = [
        Removed(
            k, np.arange(k, 4 + 2 * k), some_patches(4 + k), PackedMask.of(FRAMES[k].depth_m > 2)
        )
        for k in (first, second)
    ]
    system.moving_objects.static_verification.pending = [
        PendingMovable(1, first, 0.25, np.ones((4, 3)), tuple(removed), 2, 1),
        PendingMovable(2, second, 0.5, np.full((3, 3), 0.5), (removed[1],), 1, 3),
    ]
    features = system.mapper.world.keyframes[first].features
    for k in (0, 1):
        seen = features, np.arange(k, 5 + k), np.arange(2 * k, 5 + 2 * k)
        system.frame_observations.append(FRAMES[k].timestamp_s, *seen)
    loops.closed = {(first, second): True, (first, second + 1): False}
    loops.recogniser.dismiss(first, second)
    loops.recogniser._previous = [(frozenset({first, second}), 1), (frozenset({second}), 2)]
    return system


def some_patches(count: int) -> Patches:
    rng = np.random.default_rng(count)
    images = rng.integers(0, 255, (count, PATCHES, PATCH_PX, PATCH_PX), np.uint8)
    return Patches(images, rng.normal(size=(count, PATCHES, 3)))


def at_checkpoint() -> SlamSystem:
    """After 20 frames."""
    system = SlamSystem(CAMERA, CONFIG, Halves())
    for frame in FRAMES[:20]:
        system.process(frame)
    system.restart()
    return system


def restored(state: Arrays) -> SlamSystem:
    system = SlamSystem(CAMERA, CONFIG, Halves())
    system.restore({name: array.copy() for name, array in state.items()}, FILE)
    return system


def differences(a: Any, b: Any, where: str = "system") -> Iterator[str]:
    """Paths of all attributes in which two objects differ, including the order of dictionaries."""
    if type(a) is not type(b):
        yield f"{where}: {type(a)} and {type(b)}"
    elif isinstance(a, np.ndarray):
        if not np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
            yield where
    elif isinstance(a, (int, float, str, Enum, type(None))):
        if a != b:
            yield f"{where}: {a} and {b}"
    elif isinstance(a, (list, tuple, set, frozenset)):
        yield from _different_items(_ordered(a), _ordered(b), where)
    elif isinstance(a, dict):
        yield from differences(list(a), list(b), f"{where}.keys")
        for key in (a.keys() & b.keys()) - SCRATCH:
            yield from differences(a[key], b[key], f"{where}[{key}]")
    elif isinstance(a, FactorTables):  # rows and slots are its own affair
        yield from differences(graph_arrays(a), graph_arrays(b), where)
    elif isinstance(a, DiskRows):
        yield from differences(a.rows, b.rows, where)
    elif isinstance(a, LandmarkTable):  # dead landmarks are not kept
        yield from differences(a.state(), b.state(), where)
    elif type(a).__module__.partition(".")[0] not in OPAQUE:
        yield from differences(vars(a), vars(b), where)


def _ordered(items: Any) -> Any:
    return sorted(items) if isinstance(items, (set, frozenset)) else items


def _different_items(a: Any, b: Any, where: str) -> Iterator[str]:
    if all(isinstance(item, np.ndarray) for item in (*a, *b)) and len(a) + len(b):
        nothing = (a or b)[0][:0]
        yield from differences(np.concatenate([nothing, *a]), np.concatenate([nothing, *b]), where)
        return
    types = list(map(type, a))
    if not set(types) - PLAIN and types == list(map(type, b)) and list(a) == list(b):
        return  # most of a state's items are numbers
    yield from differences(len(a), len(b), f"{where}.length")
    for i, (x, y) in enumerate(
        zip(a, sorted(b) if isinstance(b, (set, frozenset)) else b, strict=False)
    ):
        yield from differences(x, y, f"{where}[{i}]")


def test_a_state_of_an_older_version_is_restored(system: SlamSystem) -> None:
    """It holds counts of votes, which are not used today."""
    names = ("semantics.labels.counts", "semantics.objects.labels.counts")
    older = {**system.state(), **{name: np.zeros(7, np.float32) for name in names}}
    assert list(differences(system, restored(older))) == []


def test_a_state_without_events_is_restored(system: SlamSystem) -> None:
    """Versions before events did not save them: nothing is counted, and nothing is lost."""
    state, empty = system.state(), SlamSystem(CAMERA, CONFIG, Halves()).state()
    events = {name for name in state if name.startswith("mapper.events.")}
    older = restored({name: array for name, array in state.items() if name not in events})
    assert len(events) == 3
    for name, array in older.state().items():
        expected = empty[name] if name in events else state[name]
        np.testing.assert_array_equal(array, expected)


def test_a_state_without_surfaces_is_restored(system: SlamSystem) -> None:
    """Versions before them did not save them: landmarks lie on nothing known."""
    state = system.state()
    surfaces = {name for name in state if name.startswith("semantics.surfaces.")}
    older = restored({name: array for name, array in state.items() if name not in surfaces})
    assert len(surfaces) == 4
    assert len(system.semantics.surfaces.known()) > len(older.semantics.surfaces.known()) == 0
    labels = older.semantics.landmark_labels(np.array([0]), [])
    assert labels is not None
    assert labels.surfaces is None


def test_a_state_without_objects_or_what_is_newer_is_restored(system: SlamSystem) -> None:
    state = system.state()
    none = SlamSystem(CAMERA, CONFIG, Halves()).state()
    objects = {n: a for n, a in none.items() if n.startswith("semantics.objects.")}
    assert restored({**state, **objects}).semantics.objects.state().keys()
    older = {n: a for n, a in state.items() if not n.endswith(OPTIONAL_ARRAYS)}
    assert len(older) == len(state) - 16
    twin = restored(older)
    of_file = world_of(part(older, "mapper.world"))  # as `map` and `optimise` read it
    assert of_file.keyframes.keys() == twin.map.world.keyframes.keys()
    for table in ("log_p", "views", "misses"):
        name = f"semantics.labels.{table}"
        np.testing.assert_array_equal(twin.state()[name], state[name])


def test_every_attribute_is_restored(system: SlamSystem) -> None:
    assert list(differences(system, restored(system.state()))) == []


def test_every_array_of_the_state_matters(system: SlamSystem) -> None:
    """Every array is filled here, and a change in it has an effect or is rejected."""
    state = system.state()
    empty = sorted(name for name, array in state.items() if array.size == 0)
    assert empty == []
    for name, array in state.items():
        changed = np.where(array == array.flat[0], array.flat[-1:], array.flat[:1]).astype(
            array.dtype
        )
        if np.array_equal(changed, array, equal_nan=array.dtype.kind == "f"):
            changed = np.ones_like(array) if not array.any() else np.zeros_like(array)
        try:
            other = restored({**state, name: changed})
        except (InputError, ValueError, IndexError, KeyError):
            continue
        kept = np.array_equal(other.state()[name], array, equal_nan=array.dtype.kind == "f")
        if kept:  # or else it differs where it came from, which takes long to find
            assert next(differences(system, other), None) is not None, name


def test_a_restored_system_continues_identically() -> None:
    """To the last bit: poses, map, graph and final adjustment."""
    system = at_checkpoint()
    twin = restored(system.state())
    for frame in FRAMES[20:]:
        results = [s.process(frame) for s in (system, twin)]
        assert list(differences(*[replace(r, stage_ms={}) for r in results])) == []
    for s in (system, twin):
        s.finish()
        s.mapper.update_ms = []  # times are no part of the result
    assert list(differences(system, twin)) == []


def test_compared_classes_have_only_compared_attributes(system: SlamSystem) -> None:
    """A new attribute must be added to ``graph_arrays`` or the table's columns, too."""
    tables, table = system.mapper.smoother._tables, system.mapper.world.landmarks
    pose_factors = {"pose_factors", "pose_factors_of", "_next_number"}
    assert vars(tables).keys() == {
        *("keyframes", "landmarks", "observations", "marginalised", "own_factors", "next_own"),
        "inertial",
        *pose_factors,
    }
    rows = {"of_keyframe", "of_landmark", "_free", "_columns", "_slots", "_used"}
    assert vars(tables.observations).keys() == rows
    columns = table._store.keys() | table._appearance.views(table.row).keys()
    ids = {"_size", "spare", "reserved_only"}
    assert vars(table).keys() == {*ids, "_store", "_appearance", *columns}
    assert columns - {"in_map", "row"} == table.state().keys() - {"size", "ids", "spare"}
