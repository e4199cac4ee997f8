"""Factors of a user: they pull with the right sign, survive a file, and go by number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane, sideways_path

from bmask_slam import key_of_keyframe, key_of_landmark
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array, no_ids
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import GraphUpdate
from bmask_slam.graph.factors.own_factors import factor_of, own_factor, text_of
from bmask_slam.graph.smoother.repair import repair
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.live.messages import ChangeOwnFactors
from bmask_slam.live.processes.map_process import MapServer
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

SETTINGS = [
    *("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0"),
    "features.max_keypoints=300",
]
CONFIG = resolve(SystemConfig, None, [*SETTINGS, "keyframes.late_shared=2.0"])
FIRM = gtsam.noiseModel.Isotropic.Sigma(3, 1e-5)
OFF_M = np.array([0.05, -0.02, 0.03])


def system() -> SlamSystem:
    """Four keyframes before a plane."""
    made = SlamSystem(CAMERA, CONFIG)
    for k, T in enumerate(sideways_path(np.arange(8) * 0.03)):
        made.process(render_plane(T, k))
    return made


def newest(made: SlamSystem) -> tuple[int, Array]:
    keyframe = list(made.mapper.world.keyframes.values())[-1]
    return keyframe.id, keyframe.T_world_camera[:3, 3]


def position(keyframe: int, where: Array) -> gtsam.NonlinearFactor:
    return gtsam.GPSFactor(key_of_keyframe(keyframe), where, FIRM)


def custom(keyframe: int, where: Array) -> gtsam.CustomFactor:
    """The same as a function of Python: camera position less ``where``."""

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> Array:
        pose = values.atPose3(this.keys()[0])
        if H is not None:
            H[0] = np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
        return np.asarray(pose.translation() - where)

    return gtsam.CustomFactor(FIRM, [key_of_keyframe(keyframe)], error)


@pytest.mark.parametrize("make", [position, custom])
def test_a_factor_pulls_its_keyframe_until_it_is_removed(make: Any) -> None:
    made = system()
    keyframe, before = newest(made)
    number = made.add_factor(make(keyframe, before + OFF_M))
    made.mapper.smoother.optimise_batch()
    pulled = made.mapper.smoother.estimate().poses_world_camera[-1, :3, 3]
    np.testing.assert_allclose(pulled, before + OFF_M, atol=2e-3)
    made.remove_factor(number)
    made.finish()
    np.testing.assert_allclose(newest(made)[1], before, atol=2e-3)


def test_a_factor_survives_a_state_and_a_saved_graph(tmp_path: Path) -> None:
    made = system()
    keyframe, before = newest(made)
    point = key_of_landmark(int(made.mapper.smoother.tables.landmarks.ids[5]))
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(1.3), gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    )
    made.add_factor(position(keyframe, before + OFF_M))
    made.add_factor(gtsam.RangeFactor3D(key_of_keyframe(keyframe), point, 2.1, robust))
    made.restart()
    again = SlamSystem(CAMERA, CONFIG)
    again.restore(made.state(), Path("run/checkpoint"))
    made.mapper.smoother.save(tmp_path / "graph")
    loaded = Smoother.load(tmp_path / "graph")
    for smoother in (again.mapper.smoother, loaded):
        own = smoother.tables.own_factors
        assert {n: text_of(one.factor) for n, one in own.items()} == {
            n: text_of(one.factor) for n, one in made.mapper.smoother.tables.own_factors.items()
        }
    for one in (made, again):
        one.finish()
    np.testing.assert_array_equal(newest(made)[1], newest(again)[1])


def test_code_cannot_be_saved_and_says_so() -> None:
    made = system()
    number = made.add_factor(custom(*newest(made)))
    with pytest.raises(InputError, match=f"own factor {number}: a CustomFactor cannot be saved"):
        made.state()
    made.remove_factor(number)
    assert not [name for name in made.state() if "own_factor" in name]
    again = SlamSystem(CAMERA, CONFIG)
    again.restore(made.state(), Path("run/checkpoint"))
    for one in (made, again):  # a number is given once
        assert one.add_factor(position(*newest(made))) == number + 1


def test_a_text_that_claims_more_than_it_has_is_refused() -> None:
    text = text_of(gtsam.GPSFactor(key_of_keyframe(0), np.ones(3), gtsam.noiseModel.Unit.Create(3)))
    assert factor_of(text).keys() == [key_of_keyframe(0)]
    at = text.index(" 3 1.00")
    for count in ("9999999999", str(2**60)):
        with pytest.raises(ValueError, match="cannot be read"):
            factor_of(f"{text[:at]} {count}{text[at + 2 :]}")
    with pytest.raises(ValueError, match="too long"):
        factor_of(text + " " * 1_000_000)


def test_a_factor_that_cannot_enter_is_refused() -> None:
    made = system()
    keyframe, before = newest(made)
    for factor, reason in (
        (position(99, before), "keyframe 99 is not in the graph"),
        (gtsam.GPSFactor(7, before, FIRM), "key 7 is no keyframe's and no landmark's"),
        (position(keyframe, before * np.nan), "its error is nan"),
        (spoilt(keyframe, ["nan"]), "its Jacobians are not finite"),
        ("a text", "give a factor of GTSAM|cannot be read"),
    ):
        with pytest.raises((InputError, ValueError), match=reason):
            made.add_factor(factor)


@pytest.mark.parametrize("given", ["x", "22 serialization::archive", 7, None])
def test_what_is_no_factor_is_refused(given: object) -> None:
    words = f"add_factor: a {type(given).__name__}; give a factor of GTSAM"
    with pytest.raises(InputError, match=words):
        system().add_factor(given)


def spoilt(keyframe: int, fails: list[str]) -> gtsam.CustomFactor:
    """A factor of which the Jacobian is NaN, or which raises, once ``fails`` says so."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> Array:
        if fails[0] == "raises":
            raise ValueError("no measurement there")
        if H is not None:
            H[0] = np.full((3, 6), np.nan) if fails[0] else np.eye(3, 6)
        return np.zeros(3)

    return gtsam.CustomFactor(FIRM, [key_of_keyframe(keyframe)], error)


@pytest.mark.parametrize(("how", "batch"), [("nan", False), ("raises", False), ("nan", True)])
def test_a_factor_that_fails_later_goes_alone(how: str, batch: bool) -> None:
    """Not the keyframe that it spoils; and the graph can be solved again."""
    made, fails = system(), [""]
    keyframe, _ = newest(made)
    smoother = made.mapper.smoother
    before = smoother.tables.keyframes.ids.tolist()
    own = own_factor(spoilt(keyframe, fails))
    number = made.add_factor(own.factor)
    fails[0] = how
    smoother.restart()
    estimate = smoother.optimise_batch() if batch else smoother.update(GraphUpdate())
    assert estimate.failed_own_factors == (number,)
    assert f"own factor {number} was removed: the graph could not be solved" in estimate.notes()
    assert not smoother.tables.own_factors
    assert not len(estimate.dropped_keyframes)
    assert smoother.tables.keyframes.ids.tolist() == before
    assert smoother.update(GraphUpdate(own_factors=((7, own),))).failed_own_factors == (7,)
    assert not smoother.update(GraphUpdate()).rebuilt


def test_repair_passes_over_a_keyframe_that_is_not_there() -> None:
    smoother = system().mapper.smoother
    model = smoother.tables, CAMERA, CONFIG.graph
    assert not repair(("keyframe", 99), no_ids(), *model).dropped_keyframes.size


def test_a_saved_factor_of_the_wrong_type_is_refused(tmp_path: Path) -> None:
    """A point's prior with the key of a keyframe, as only a file can have it."""
    made = system()
    keyframe, before = newest(made)
    wrong = gtsam.PriorFactorPoint3(key_of_keyframe(keyframe), before, FIRM)
    with pytest.raises(InputError, match="its error cannot be computed"):
        made.add_factor(wrong)
    made.mapper.smoother.tables.own_factors[3] = own_factor(wrong)
    made.mapper.smoother.save(tmp_path / "graph")
    with pytest.raises(InputError, match="own factor 3: its error cannot be computed"):
        Smoother.load(tmp_path / "graph")


def test_the_maps_process_takes_texts_and_reports_refusals() -> None:
    made = system()
    keyframe, before = newest(made)
    server = MapServer(made, lambda answer: None)
    good, bad = (text_of(position(k, before + OFF_M)) for k in (keyframe, 99))
    assert factor_of(good).keys() == [key_of_keyframe(keyframe)]
    server.handle(1, ChangeOwnFactors(((4, good),), ()))
    server.handle(2, ChangeOwnFactors(((5, bad),), ()))
    assert list(made.mapper.smoother.tables.own_factors) == [4]
    texts = [event.text for event in made.events.take()]
    assert any("keyframe 99 is not in the graph" in text for text in texts)
    server.handle(3, ChangeOwnFactors((), (4,)))
    assert not made.mapper.smoother.tables.own_factors
