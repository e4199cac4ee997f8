"""The light segmenter, with random heads on the published detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from repository import shared
from safetensors.torch import save_file

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.network.boxes import iou
from bmask_slam.semantics.network.yolox.network import Features
from bmask_slam.semantics.segmenters.light_segmenter import LightSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import (
    SegmenterOptions,
    labels_of,
    make_segmenter,
)
from bmask_slam.semantics.weights.checkpoints import read_state
from bmask_slam.semantics.weights.light_weights import (
    LightNetwork,
    is_light,
    load_light,
    new_light,
    save_light,
)
from bmask_slam.semantics.weights.stuff_weights import SHIPPED, load_stuff, save_stuff
from bmask_slam.semantics.weights.yolox_onnx import load_onnx

PHOTOGRAPHS = "coco_excerpt/images"


@pytest.fixture(scope="module")
def network() -> LightNetwork:
    torch.manual_seed(0)
    made = new_light(load_onnx(shared("weights/yolox_nano.onnx")))
    torch.nn.init.constant_(made.model.mask.logits.bias, 1.0)  # so that masks are not empty
    made.model.eval()
    return made


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    return read_colour(sorted(shared(PHOTOGRAPHS).iterdir())[0])


def test_instances_lie_in_the_image_best_first(
    network: LightNetwork, photograph: np.ndarray
) -> None:
    found = LightSegmenter(network, 0.3).segment(photograph, "a.jpg")
    assert len(found) > 1
    assert all(i.mask.shape == photograph.shape[:2] and i.mask.any() for i in found)
    scores = [i.mask_score for i in found]
    assert scores == sorted(scores, reverse=True)
    assert all(0.3 <= i.class_score <= 1 and i.mask_score <= i.class_score for i in found)
    assert all(i.distribution.sum() == pytest.approx(1) for i in found)


def test_a_view_with_negative_strides_is_an_image(
    network: LightNetwork, photograph: np.ndarray
) -> None:
    segmenter, mirrored = LightSegmenter(network, 0.3), photograph[:, ::-1]
    found, same = (segmenter.segment(i, "a.jpg") for i in (mirrored, mirrored.copy()))
    assert [i.mask_score for i in found] == [i.mask_score for i in same] != []


def test_a_larger_image_has_the_same_boxes_at_its_scale(
    network: LightNetwork, photograph: np.ndarray
) -> None:
    segmenter = LightSegmenter(network, 0.4)
    large = photograph.repeat(2, axis=0).repeat(2, axis=1)
    once, twice = (
        torch.from_numpy(np.stack([i.box for i in segmenter.segment(image, "a.jpg")]))
        for image in (photograph, large)
    )
    assert len(twice) > 1
    assert (iou(once, twice / 2).amax(dim=0) > 0.9).all()


def test_it_runs_in_one_thread_and_leaves_their_number_as_it_was(
    network: LightNetwork, photograph: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = torch.get_num_threads()
    features, within = network.model.detector.features, []

    def watched(images: torch.Tensor) -> Features:
        within.append(torch.get_num_threads())
        return features(images)

    monkeypatch.setattr(network.model.detector, "features", watched)
    torch.set_num_threads(2)
    try:
        LightSegmenter(network).segment(photograph, "a.jpg")
        assert within == [1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_a_saved_network_is_found_by_its_file(
    network: LightNetwork, photograph: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "heads.safetensors"
    save_light(network, path)
    assert is_light(path)
    labels = tmp_path / "mine.txt"
    labels.write_text("drone\nchair\ndining table\nbowl\n")
    options = SegmenterOptions("light", str(path), labels=str(labels), min_score=0.3)
    segmenter = make_segmenter(options, tmp_path)
    assert segmenter.labels.names[1:] == ("drone", "chair", "dining table", "bowl")
    assert labels_of(options, tmp_path) == segmenter.labels
    assert labels_of(SegmenterOptions(), tmp_path) == load_light(path).labels
    expected = LightSegmenter(LightNetwork(network.model, segmenter.labels), 0.3)
    pairs = zip(
        segmenter.segment(photograph, "a.jpg"), expected.segment(photograph, "a.jpg"), strict=True
    )
    for one, other in pairs:
        assert one.label == other.label
        np.testing.assert_array_equal(one.mask, other.mask)


def test_other_files_are_not_of_this_network(tmp_path: Path, network: LightNetwork) -> None:
    assert not is_light(tmp_path / "none.safetensors")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"no weights")
    assert not is_light(broken)
    other = LightNetwork(torch.nn.Linear(2, 2), label_set(("cup",)))  # type: ignore[arg-type]
    save_light(other, tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="not the weights of the light network"):
        load_light(tmp_path / "other.safetensors")


def test_weights_of_half_precision_are_used_in_single(
    network: LightNetwork, photograph: np.ndarray, tmp_path: Path
) -> None:
    save_light(network, tmp_path / "single.safetensors")
    state, about = read_state(tmp_path / "single.safetensors")
    halves = {name: value.half() for name, value in state.items()}
    save_file(halves, tmp_path / "half.safetensors", about)
    found = LightSegmenter(load_light(tmp_path / "half.safetensors"), 0.3)
    assert len(found.segment(photograph, "a.jpg")) > 1


def test_the_classes_of_pixels_lie_where_the_pixels_are(
    network: LightNetwork, photograph: np.ndarray, tmp_path: Path
) -> None:
    """A part of the image, at twice the size, has the classes of the whole at the same places."""
    stuff = load_stuff(data_path(*SHIPPED))
    assert len(stuff.labels) == 40
    segmenter = LightSegmenter(network, stuff=stuff)
    height, width = photograph.shape[:2]
    seen = segmenter.segment(photograph, "a.jpg").surfaces
    large = photograph.repeat(2, axis=0).repeat(2, axis=1)
    twice = segmenter.segment(large, "a.jpg").surfaces
    assert seen is not None
    assert twice is not None
    assert seen.size == (height, width)
    assert twice.cell_px == 2 * seen.cell_px
    grid = np.stack(np.meshgrid(np.arange(0, width, 9), np.arange(0, height, 9)), -1).reshape(-1, 2)
    once, again = seen.at(grid.astype(float)), twice.at(2 * grid + 0.5)
    beside = twice.at(2 * grid + 0.5 + 2 * seen.cell_px)
    np.testing.assert_allclose(once.sum(axis=1), 1, atol=0.01)
    assert np.abs(once - again).max(axis=1).mean() < 0.5 * np.abs(once - beside).max(axis=1).mean()
    assert LightSegmenter(network).segment(photograph, "a.jpg").surfaces is None
    save_stuff(stuff, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == data_path(*SHIPPED).read_bytes()
    save_light(network, tmp_path / "light.safetensors")
    with pytest.raises(InputError, match="not weights of the head for stuff"):
        load_stuff(tmp_path / "light.safetensors")
