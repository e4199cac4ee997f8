"""Saved maps, checkpoints, weights and bags whose parts do not fit together."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from recorded_bags import write_bag
from safetensors.torch import save_file
from synthetic_view import CAMERA, render_or_black

from bmask_slam.config.configuration import resolve
from bmask_slam.dense import saved_map
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.semantics.weights.checkpoints import load_network
from bmask_slam.sequences.bags.bag_file import format_topics, open_bag
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

FILE = Path("run/map")
CONFIG = resolve(
    SystemConfig, None, ("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0")
)


@pytest.fixture(scope="module")
def state() -> Arrays:
    """Of a system after five keyframes."""
    system = SlamSystem(CAMERA, CONFIG)
    for k in range(5):
        system.process(render_or_black(se3_exp(np.array([0, 0, 0, 0.03 * k, 0, 0])), k))
    return system.state()


def changed(state: Arrays) -> Iterator[tuple[str, NDArray]]:
    """Each array in turn: shorter, longer, with a negative or a huge number in it."""
    for name, array in state.items():
        if array.ndim and len(array):
            yield name, array[:-1]
            yield name, np.concatenate([array, array[-1:]])
        if array.dtype.kind == "i" and array.size:
            for value in (-7, 10**12, 2**62):
                other = array.copy()
                other.ravel()[-1] = value
                yield name, other


def test_a_changed_map_is_refused_or_read(state: Arrays) -> None:
    refused = 0
    for name, array in changed(state):
        system = SlamSystem(CAMERA, CONFIG)
        try:
            system.restore({**state, name: array}, FILE)
        except InputError as error:
            assert str(FILE) in str(error)
            refused += 1
    assert refused > 100


def test_a_changed_map_is_refused_or_mapped(
    state: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = {name: array for name, array in state.items() if name.startswith("mapper.world.")}
    for name, array in changed(world):
        found = {**state, name: array}, CAMERA
        monkeypatch.setattr(saved_map, "read_map", lambda path, found=found: found)
        try:
            read_saved_map(tmp_path)
        except InputError as error:
            assert str(tmp_path / "map") in str(error)


def test_keyframes_that_replace_each_other_in_a_circle(state: Arrays) -> None:
    prefix = next(name for name in state if name.endswith("culled_ids")).removesuffix("culled_ids")
    circle = {
        f"{prefix}culled_ids": np.array([90, 91]),
        f"{prefix}heir_ids": np.array([91, 90]),
        f"{prefix}T_heir_culled": np.tile(np.eye(4), (2, 1, 1)),
    }
    with pytest.raises(InputError, match="do not fit together"):
        SlamSystem(CAMERA, CONFIG).restore({**state, **circle}, FILE)


# --- weights -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "labels"),
    [
        ("5", "[]"),
        ("[" * 9999, "[]"),
        ('{"image": 5}', '["background"]'),
        ('{"image": {"short_px": "wide"}}', '["background"]'),
        ('{"image": {"long_px": 1000000000}}', '["background"]'),
        ('{"rpn_convs": 1000000000}', '["background"]'),
        ('{"channels": -1}', '["background"]'),
        ('{"mask_context": NaN}', '["background"]'),
        ('{"backbone": "resnet9"}', '["background"]'),
        ('{"anchors": {"ratios": [' + ",".join("1" * 1000) + "]}}", '["background"]'),
        ('{"classes": 2}', "5"),
        ('{"classes": 2}', "[1, 2]"),
        ('{"classes": 2}', '{"a": 1}'),
        ('{"classes": 2}', "[]"),
    ],
)
def test_the_metadata_of_weights(tmp_path: Path, network: str, labels: str) -> None:
    path = tmp_path / "weights.safetensors"
    save_file({"a": torch.zeros(1)}, path, {"network": network, "labels": labels})
    with pytest.raises(InputError, match=r"weights\.safetensors: ") as caught:
        load_network(path)
    assert len(str(caught.value)) < 480 + len(str(path))


# --- bags ----------------------------------------------------------------------------------------


def replaced(tree: Any, value: Any) -> Iterator[Any]:
    """The tree with each of its values replaced in turn."""
    yield value
    if not isinstance(tree, (dict, list)):
        return
    for key, child in tree.items() if isinstance(tree, dict) else enumerate(tree):
        for other in replaced(child, value):
            copy = tree.copy()
            copy[key] = other
            yield copy


def test_the_metadata_of_a_bag(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", 1)
    path = bag / "metadata.yaml"
    good = json.loads(json.dumps(_plain(path)))
    for value in (5, "text", [1], {"a": 1}, None, float("nan")):
        for content in replaced(good, value):
            path.write_text(json.dumps(content))  # JSON is YAML
            try:
                with open_bag(bag) as opened:
                    format_topics(opened)
            except InputError as error:
                assert str(bag) in str(error)


def _plain(path: Path) -> Any:
    from bmask_slam.graph.files.yaml_file import read_yaml

    return read_yaml(path)
