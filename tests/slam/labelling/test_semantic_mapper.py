"""Masks label the landmarks of the map: in time, late, repeated, for a culled keyframe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.run_folder.landmark_file import read_landmarks, write_landmarks
from bmask_slam.run_folder.semantic_files import read_labels, write_labels
from bmask_slam.semantics.beliefs.label_store import LabelEstimates
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.instances.surfaces import Segmented, SurfaceClasses
from bmask_slam.semantics.labels import LabelSet, label_set
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

FILE = Path("run/checkpoint")
EDGE_M = 0.1  # world x: left of it on the plane is one thing, right of it another
MANY_KEYFRAMES = [  # and most of them culled again
    *("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0"),
    *("mapping.redundant_share=0.3", "mapping.redundant_views=2", "features.max_keypoints=400"),
]


def frames(count: int) -> list[Frame]:
    x = np.concatenate([np.arange(count), np.arange(count)[::-1]]) * 0.03
    poses = [se3_exp(np.array([0, 0.02 * np.sin(40 * a), 0, a - 0.2, 0, 0])) for a in x]
    return [named(render_plane(pose, k), k) for k, pose in enumerate(poses)]


def named(frame: Frame, number: int) -> Frame:
    return Frame(frame.index, frame.timestamp_s, frame.rgb, frame.depth_m, f"rgb/{number}.png")


class Sides:
    """A segmenter of the plane's left and right side, from the true poses."""

    labels: LabelSet = label_set(("left", "right"))

    def __init__(self, system_frames: list[Frame], late: bool = False) -> None:
        self.count = len(system_frames) // 2
        self.late = late

    def segment(self, image: Image, name: str) -> list[Instance]:
        if self.late:
            raise InputError(f"{name}: still being segmented")
        return self.instances(int(Path(name).stem))

    def instances(self, number: int) -> list[Instance]:
        x = np.concatenate([np.arange(self.count), np.arange(self.count)[::-1]])[number] * 0.03
        T_first_camera = se3_exp(np.array([0, 0.02 * np.sin(40 * x), 0, x, 0, 0]))
        columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
        rays = CAMERA.backproject(np.stack([columns, rows], -1), np.array(1.0))
        rays = rays @ T_first_camera[:3, :3].T
        x_world = T_first_camera[0, 3] + rays[..., 0] / rays[..., 2] * 2.0
        left = x_world < EDGE_M
        sides = ((1, left), (2, ~left))
        found = [Instance(m, mask_box(m), k, certain(k, 3, 0.9), 0.9, 0.8) for k, m in sides]
        p = np.where(left[4::8, 4::8, None], [0.8, 0.2], [0.1, 0.9]).astype(np.float16)
        return Segmented(found, SurfaceClasses(label_set(("wall", "door")), p, 8.0, left.shape))


FRAMES = frames(8)


def run(segmenter: Sides, settings: list[str] | None = None) -> SlamSystem:
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, settings or []), segmenter)
    for frame in FRAMES:
        system.process(frame)
    return system


@pytest.fixture(scope="module")
def at_once() -> SlamSystem:
    return run(Sides(FRAMES), MANY_KEYFRAMES)


def estimates(system: SlamSystem) -> LabelEstimates:
    found = system.landmarks().labels
    assert found is not None
    return found.estimates


def right_share(system: SlamSystem) -> float:
    """The share of labelled landmarks with the right label."""
    cloud, found = system.landmarks(), estimates(system)
    known = found.labels > 0
    truth = np.where(cloud.points_world[:, 0] < EDGE_M, 1, 2)
    assert known.mean() > 0.9
    return float((found.labels == truth)[known].mean())


def test_landmarks_get_the_label_of_their_mask(at_once: SlamSystem) -> None:
    assert right_share(at_once) > 0.995
    assert np.median(estimates(at_once).probability) > 0.97
    assert estimates(at_once).views.max() > 5


def test_the_side_that_a_segmenter_found_to_be_up_is_used_and_kept(tmp_path: Path) -> None:
    segmenter = Sides(FRAMES)
    system = SlamSystem(CAMERA, SystemConfig(), segmenter)
    system.process(FRAMES[0])
    assert system.objects().up_world == pytest.approx([0, -1, 0], abs=0.02)
    told = Segmented(segmenter.instances(0), up="right")
    segmenter.instances = lambda number: told  # type: ignore[method-assign]
    turned = SlamSystem(CAMERA, SystemConfig(), segmenter)
    turned.process(FRAMES[0])
    assert turned.objects().up_world == pytest.approx([1, 0, 0], abs=0.02)
    again = SlamSystem(CAMERA, SystemConfig(), segmenter)
    again.restore(turned.state(), tmp_path)
    assert again.objects().up_world == pytest.approx([1, 0, 0], abs=0.02)


def late_system() -> SlamSystem:
    segmenter = Sides(FRAMES, late=True)
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, MANY_KEYFRAMES), segmenter)
    system.semantics._done.add(-1)  # so that a segmenter's refusal is no reason to end the run
    for frame in FRAMES:
        system.process(frame)
    return system


def test_late_masks_in_any_order_give_the_same_labels(at_once: SlamSystem) -> None:
    system = late_system()
    world, culled = system.mapper.world, system.mapper.world.culled
    assert len(culled) > 2
    numbers = {k: keyframe_number(system, k) for k in (*world.keyframes, *culled)}
    order = np.random.default_rng(0).permutation(sorted(numbers))
    for k in order.tolist():
        instances = system.semantics.segmenter.instances(numbers[k])  # type: ignore[attr-defined]
        done = system.semantics.attach(k, instances)
        assert done.refused == ""
        assert len(done.landmark_ids) > (0 if k in culled else 100)
    assert right_share(system) > 0.995
    same = estimates(system).labels == estimates(at_once).labels
    assert same.mean() > 0.99
    assert system.semantics._waiting == {}


def keyframe_number(system: SlamSystem, keyframe_id: int) -> int:
    """Every frame is a keyframe."""
    assert system.mapper.world.next_keyframe_id == len(FRAMES)
    return keyframe_id


def test_repeated_masks_count_once(at_once: SlamSystem) -> None:
    semantics, before = at_once.semantics, at_once.semantics.state()
    for k in (3, *list(at_once.mapper.world.culled)[:2]):
        done = semantics.attach(k, Sides(FRAMES).instances(k))
        assert "already" in done.refused
    unknown = semantics.attach(4711, Sides(FRAMES).instances(0))
    assert "not in the map" in unknown.refused
    after = semantics.state()
    assert all(np.array_equal(after[name], before[name]) for name in before)


def test_masks_of_another_size_are_refused_and_change_nothing() -> None:
    system = late_system()
    small = np.ones((10, 10), bool)
    bad = Instance(small, mask_box(small), 1, certain(1, 3), 1.0, 1.0)
    with pytest.raises(InputError, match="shape"):
        system.semantics.attach(3, [bad])
    assert system.semantics.labels.known().tolist() == []
    assert system.semantics.attach(3, Sides(FRAMES).instances(3)).refused == ""


def test_labels_follow_fused_and_culled_landmarks(at_once: SlamSystem) -> None:
    """Labels of removed landmarks are removed."""
    semantics, landmarks = at_once.semantics, at_once.mapper.world.landmarks
    semantics.follow_map()
    assert landmarks.in_map[semantics.labels.known()].all()
    a, b, removed = semantics.labels.known()[[3, 8, 12]]
    both = semantics.labels.estimates(np.array([a, b])).views.sum()
    world = at_once.mapper.world
    world.replace_landmarks(np.array([a]), np.array([b]))
    landmarks.remove(np.array([removed]))
    semantics.follow_map()
    assert semantics.labels.estimates(np.array([a, b, removed])).views.tolist() == [0, both, 0]


def test_the_estimate_is_the_same_with_and_without_masks(at_once: SlamSystem) -> None:
    without = SlamSystem(CAMERA, resolve(SystemConfig, None, MANY_KEYFRAMES))
    for frame in FRAMES:
        without.process(frame)
    poses = [s.trajectory().poses_world_camera for s in (without, at_once)]
    assert np.array_equal(*poses)
    assert without.landmarks().labels is None
    assert without.semantics.state()["labels.ids"].size == 0


class Unsure(Sides):
    """Has a low score on the right side."""

    def instances(self, number: int) -> list[Instance]:
        left, right = super().instances(number)
        return [left, Instance(right.mask, right.box, 2, certain(2, 3, 0.45), 0.45, 0.45)]


def test_a_weak_detection_votes_but_makes_no_object() -> None:
    system = run(Unsure(FRAMES), MANY_KEYFRAMES)
    on_right = system.landmarks().points_world[:, 0] > EDGE_M + 0.05
    often = on_right & (estimates(system).views > 5)
    assert often.sum() > 100
    assert (estimates(system).labels[often] == 2).mean() > 0.8  # most viewpoints are not new
    assert {o.label for o in system.objects().objects} == {1}


def test_the_first_keyframe_must_have_masks_the_others_may_lack_them() -> None:
    class Sometimes(Sides):
        def segment(self, image: Image, name: str) -> list[Instance]:
            if name == "rgb/3.png":
                raise InputError(f"{name}: not there")
            return super().segment(image, name)

    system = run(Sometimes(FRAMES), MANY_KEYFRAMES)
    assert 3 in system.semantics._waiting
    with pytest.raises(InputError, match="still being"):
        run(Sides(FRAMES, late=True))


def test_a_map_continues_with_its_labels_or_without_masks() -> None:
    system = run(Sides(FRAMES))
    state = system.state()

    class Others(Sides):
        labels = label_set(("up", "down"))

    with pytest.raises(InputError, match="take the segmenter that it was made with"):
        SlamSystem(CAMERA, SystemConfig(), Others(FRAMES)).restore(state, FILE)
    silent = SlamSystem(CAMERA, SystemConfig())
    silent.restore(state, FILE)
    assert np.array_equal(estimates(silent).labels, estimates(system).labels)
    before = silent.semantics.labels.state()
    silent.begin_session()
    silent.process(FRAMES[0])
    after = silent.semantics.labels.state()
    assert all(np.array_equal(after[name], before[name]) for name in before)
    config = resolve(SystemConfig, None, MANY_KEYFRAMES)
    unlabelled = SlamSystem(CAMERA, config)
    for frame in FRAMES[:3]:
        unlabelled.process(frame)
    fresh = SlamSystem(CAMERA, config, Sides(FRAMES))
    fresh.restore(unlabelled.state(), FILE)
    for frame in FRAMES[3:]:
        fresh.process(frame)
    assert right_share(fresh) > 0.99


def test_the_two_sides_are_two_objects_with_their_landmarks(at_once: SlamSystem) -> None:
    left, right = at_once.objects().objects
    assert (left.label, right.label) == (1, 2)
    assert left.centroid_world[0] < EDGE_M < right.centroid_world[0]
    for o in (left, right):
        assert o.centroid_world[2] == pytest.approx(2.0, abs=0.01)
        assert len(o.keyframe_ids) == len(FRAMES)  # culled ones did see it, too
        own = at_once.mapper.world.landmarks
        assert own.in_map[o.landmark_ids].all()
        side = own.points_world[o.landmark_ids, 0] < EDGE_M
        assert (side == (o is left)).mean() > 0.99


def test_late_masks_make_the_same_objects(at_once: SlamSystem) -> None:
    system = late_system()
    for k in sorted((*system.mapper.world.keyframes, *system.mapper.world.culled), reverse=True):
        system.semantics.attach(k, Sides(FRAMES).instances(k))
    pairs = zip(at_once.objects().objects, system.objects().objects, strict=True)
    for a, b in pairs:
        assert a.label == b.label
        assert np.allclose(a.centroid_world, b.centroid_world, atol=0.02)


def test_files(at_once: SlamSystem, tmp_path: Path) -> None:
    from bmask_slam.graph.files.ply import read_ply

    cloud = at_once.landmarks()
    write_labels(tmp_path / "labels.csv", cloud)
    write_landmarks(tmp_path / "landmarks.ply", cloud)
    table, points = read_labels(tmp_path), read_ply(tmp_path / "landmarks.ply")
    assert np.array_equal(table.ids, points["id"])
    assert set(table.labels) <= {"unknown", "left", "right"}
    names = ("unknown", "left", "right")
    assert [names[k] for k in points["label"]] == list(table.labels)
    assert np.allclose(table.probability, points["probability"], atol=1e-5)
    assert np.allclose(table.entropy, points["entropy"], atol=1e-5)
    landmarks = read_landmarks(tmp_path / "landmarks.ply", names)
    assert landmarks.surfaces is not None
    assert cloud.labels is not None
    assert cloud.labels.surfaces is not None
    expected = cloud.labels.surfaces.names
    given = [expected.map_name(k) for k in cloud.labels.surfaces.labels.tolist()]
    assert landmarks.surfaces.tolist() == given
    at_once.files()["objects.png"](tmp_path / "objects.png")
    assert (tmp_path / "objects.png").stat().st_size > 10_000
    (tmp_path / "labels.csv").write_text("id,label\n")
    with pytest.raises(InputError, match="no column"):
        read_labels(tmp_path)


def test_landmarks_lie_on_the_surfaces_that_the_pixels_show(at_once: SlamSystem) -> None:
    cloud = at_once.landmarks()
    assert cloud.labels is not None
    found = cloud.labels.surfaces
    assert found is not None
    sure = np.abs(cloud.points_world[:, 0] - EDGE_M) > 0.05
    left = cloud.points_world[sure, 0] < EDGE_M
    assert 20 < left.sum() < len(left) - 20
    assert (found.labels[sure] == np.where(left, 1, 2)).mean() > 0.98
    assert (found.probability[sure] > 0.75).mean() > 0.9
