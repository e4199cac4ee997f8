"""Training data and the loop: augmentation keeps masks on their pixels, runs resume exactly."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from repository import shared

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.coco_files import CocoFile, read_coco
from bmask_slam.semantics.instances.instances import Instance, as_annotation, certain, mask_box
from bmask_slam.semantics.labels import label_set, read_label_set
from bmask_slam.semantics.network.config import ImageConfig, NetworkConfig
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.training.dataset import (
    AugmentConfig,
    Dataset,
    JoinedDatasets,
    Sample,
    as_tensors,
    augmented,
    copy_paste,
    flipped,
    scaled,
    split,
)
from bmask_slam.semantics.training.loop import (
    CURVES,
    STATE,
    Only,
    TrainingConfig,
    cut_curves,
    draw_batch,
    train,
    trainable,
)
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork, load_mobilenet, load_network

LABELS = label_set(["cup", "mouse"])
TINY = NetworkConfig(
    classes=3, backbone="mobilenet_v2", norm="none", channels=8, box_hidden=8, mask_channels=8,
    maskiou_channels=8, maskiou_hidden=8, image=ImageConfig(64, 96),
)  # fmt: skip
CONFIG = TrainingConfig(
    steps=4, batch=1, save_every=2, rois="objects", only="masks", rate=1e-3, warm_up=1
)


def painted(seed: int) -> Sample:
    """Objects whose pixels have the red value 10 * (k + 1) + 100, on black."""
    rng = np.random.default_rng(seed)
    image = np.zeros((60, 80, 3), np.uint8)
    masks = np.zeros((2, 60, 80), bool)
    for k in range(2):
        x, y = rng.integers(5, 20) + 35 * k, rng.integers(5, 30)
        masks[k, y : y + 20, x : x + 16] = True
        image[masks[k], 0] = 110 + 10 * k
    return Sample(image, masks, np.array([1, 2]))


def colours(sample: Sample) -> list[int]:
    """The median red of each object."""
    return [int(np.median(sample.image[m, 0])) for m in sample.masks]


def test_augmentation_moves_masks_with_their_objects() -> None:
    sample, other = painted(0), painted(1)
    other.image[other.masks.any(0), 0] += 100
    mirrored = flipped(sample)
    assert np.array_equal(flipped(mirrored).image, sample.image)
    assert colours(mirrored) == [110, 120]
    assert mirrored.masks[0].sum() == 320
    for factor in (0.7, 1.2):
        found = scaled(sample, factor)
        assert colours(found) == [110, 120]
        assert found.masks[0].sum() == pytest.approx(320 * factor**2, rel=0.15)
    pasted = copy_paste(sample, other, np.random.default_rng(0))
    assert set(colours(pasted)[-2:]) == {210, 220}
    assert not (pasted.masks[:-2].any(0) & pasted.masks[-2:].any(0)).any()
    image, target = as_tensors(pasted)
    assert image.shape == (3, 60, 80)
    assert float(image.max()) <= 1
    for box, mask in zip(target.boxes, target.masks, strict=True):
        assert box.tolist() == mask_box(mask.numpy()).tolist()


def test_an_image_whose_objects_were_all_too_small_stays_without() -> None:
    sample = painted(0)
    nothing = Sample(sample.image, sample.masks[:0], sample.labels[:0])
    found = scaled(nothing, 1.3)
    assert found.masks.shape == (0, 60, 80) and len(found.labels) == 0


def test_curves_are_cut_where_a_training_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "losses.csv"
    cut_curves(path, 0)
    assert path.read_text() == "step,loss,value\n"
    path.write_text("step,loss,value\n0,box,1\n1,box,2\n2,box,3\n")
    cut_curves(path, 2)
    assert path.read_text() == "step,loss,value\n0,box,1\n1,box,2\n"


def test_augmentation_repeats_from_its_seed() -> None:
    first, second = (
        augmented(painted(0), partial(painted, 1), AugmentConfig(), np.random.default_rng(5))
        for _ in range(2)
    )
    assert np.array_equal(first.image, second.image)
    assert np.array_equal(first.masks, second.masks)


@pytest.fixture
def data(tmp_path: Path) -> tuple[CocoFile, Path]:
    """Three painted images as a COCO file; the categories have other ids and one more name."""
    folder = tmp_path / "images"
    folder.mkdir()
    images, annotations = [], []
    for k in range(3):
        sample = painted(k)
        cv2.imwrite(str(folder / f"{k}.png"), sample.image[..., ::-1])
        images.append({"id": k, "file_name": f"{k}.png", "height": 60, "width": 80})
        for mask, number in zip(sample.masks, (11, 12), strict=True):
            made = as_annotation(Instance(mask, mask_box(mask), 1, certain(1, 3), 1.0, 1.0))
            annotations.append({**made, "category_id": number, "image_id": k})
    names = [{"id": 11, "name": "mouse"}, {"id": 12, "name": "boat"}]
    content = {"images": images, "annotations": annotations, "categories": names}
    (tmp_path / "coco.json").write_text(json.dumps(content))
    return read_coco(tmp_path / "coco.json"), folder


def test_classes_are_matched_by_name(data: tuple[CocoFile, Path]) -> None:
    dataset = Dataset(*data, LABELS)
    sample = dataset.load(1)
    assert sample.labels.tolist() == [2]  # the mouse; boats are not in the label set
    assert colours(sample) == [110]
    with pytest.raises(InputError, match="no image has an object of the label set"):
        Dataset(*data, label_set(["drone"]))
    (data[1] / "1.png").unlink()
    with pytest.raises(InputError, match=r"1\.png: no such image"):
        dataset.load(1)
    cv2.imwrite(str(data[1] / "1.png"), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(InputError, match="9x9 pixels, but 80x60 in the annotations"):
        dataset.load(1)


def test_the_split_of_the_real_excerpt_separates_images() -> None:
    content = read_coco(shared("coco_excerpt/instances.json"))
    training, validation = split(content, 0.28, seed=0)
    assert (len(training.images), len(validation.images)) == (256, 99)
    assert not {i.number for i in training.images} & {i.number for i in validation.images}
    assert split(content, 0.28, seed=0)[1] == validation
    assert split(content, 0.28, seed=1)[1] != validation
    paper = Dataset(training, shared("coco_excerpt/images"), read_label_set("paper"))
    assert 0 < len(paper) < 256


def network(seed: int = 0) -> TrainedNetwork:
    torch.manual_seed(seed)
    return TrainedNetwork(MaskRCNN(TINY), LABELS)


def quiet(done: int, total: int) -> None:
    assert 0 < done <= total


def test_a_resumed_training_equals_an_uninterrupted_one(
    data: tuple[CocoFile, Path], tmp_path: Path
) -> None:
    dataset = Dataset(*data, LABELS)
    whole = load_network(train(network(), dataset, tmp_path / "a", CONFIG, quiet))

    def stop(done: int, _total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(network(), dataset, tmp_path / "b", CONFIG, stop)
    resumed = load_network(train(network(7), dataset, tmp_path / "b", CONFIG, quiet))
    for name, value in whole.model.state_dict().items():
        torch.testing.assert_close(resumed.model.state_dict()[name], value)
    assert (tmp_path / "b" / CURVES).read_text() == (tmp_path / "a" / CURVES).read_text()
    rows = list(csv.DictReader((tmp_path / "a" / CURVES).open()))
    assert {row["loss"] for row in rows} == {"mask", "dice", "maskiou"}
    assert [int(row["step"]) for row in rows if row["loss"] == "mask"] == [0, 1, 2, 3]
    with pytest.raises(InputError, match=r"a training with rate 0\.001, now it is 0\.5"):
        train(network(), dataset, tmp_path / "a", replace(CONFIG, rate=0.5), quiet)
    assert (tmp_path / "a" / STATE).is_file()


def test_only_trainable_parameters_change(data: tuple[CocoFile, Path], tmp_path: Path) -> None:
    dataset = Dataset(*data, LABELS)
    start = network()
    before = {k: v.clone() for k, v in start.model.state_dict().items()}
    train(start, dataset, tmp_path / "o", replace(CONFIG, only="maskiou", steps=2), quiet)
    changed = {k for k, v in start.model.state_dict().items() if not torch.equal(v, before[k])}
    assert changed
    assert all(".maskiou_head." in name for name in changed)
    frozen = replace(CONFIG, freeze=("backbone.body", "rpn"))
    free = trainable(start.model, frozen)
    named = {n for n, p in start.model.named_parameters() if p.requires_grad}
    assert len(free) == len(named)
    assert not any(n.startswith(("backbone.body", "rpn")) for n in named)
    with pytest.raises(InputError, match="--freeze neck: no parameter begins with it"):
        trainable(start.model, replace(CONFIG, freeze=("neck",)))


def test_the_body_of_an_imagenet_classifier(tmp_path: Path) -> None:
    model = network().model
    load_mobilenet(model, shared("weights/mobilenet_v2_imagenet_folded.pth"))
    file = torch.load(shared("weights/mobilenet_v2_imagenet_folded.pth"), weights_only=True)
    state = model.state_dict()
    name = "features.17.conv.2.1.weight"
    assert torch.equal(state[f"backbone.body.{name}"], file[name])
    torch.save({"features.0.1.weight": torch.zeros(3)}, tmp_path / "w.pth")
    with pytest.raises(InputError, match="not a folded MobileNetV2"):
        load_mobilenet(model, tmp_path / "w.pth")


def test_joined_data_sets_follow_each_other(data: tuple[CocoFile, Path]) -> None:
    content, folder = data
    one = Dataset(content, folder, LABELS)
    first = Dataset(replace(content, images=content.images[:1]), folder, LABELS)
    joined = JoinedDatasets([first, one])
    assert len(joined) == len(one) + 1
    pairs = [(0, one.load(0)), *((k + 1, one.load(k)) for k in range(len(one)))]
    for k, sample in pairs:
        assert np.array_equal(joined.load(k).masks, sample.masks)
        assert np.array_equal(joined.load(k).image, sample.image)


@pytest.mark.parametrize("crowd", [0.0, 1.0])
def test_images_with_many_objects_are_drawn_more_often(
    data: tuple[CocoFile, Path], crowd: float
) -> None:
    dataset = Dataset(*data, LABELS)
    dataset.objects = np.where(np.arange(len(dataset)) == 1, 6.0, 2.0)
    config = replace(CONFIG, batch=2, crowd=crowd)
    rng = np.random.default_rng(0)
    drawn = [k for _ in range(300) for k in draw_batch(dataset, rng, config)]
    share = np.bincount(drawn, minlength=len(dataset)) / len(drawn)
    chance = dataset.objects**crowd
    np.testing.assert_allclose(share, chance / chance.sum(), atol=0.08)


@pytest.mark.parametrize("only", ["", "boxes", "masks", "maskiou"])
def test_each_stage_changes_only_its_parameters(only: Only) -> None:
    model = MaskRCNN(TINY)
    trainable(model, replace(CONFIG, only=only, freeze=("backbone.body",)))
    learning = {n for n, p in model.named_parameters() if p.requires_grad}
    assert not any(n.startswith("backbone.body") for n in learning)
    assert ("roi_heads.maskiou_head.maskiou.weight" in learning) == (only != "boxes")
    masks, boxes = only in ("", "masks"), only in ("", "boxes")
    assert ("roi_heads.mask_predictor.conv5_mask.weight" in learning) == masks
    assert ("backbone.fpn.layer_blocks.0.0.weight" in learning) == masks
    assert ("roi_heads.box_predictor.cls_score.weight" in learning) == boxes
    assert ("rpn.head.cls_logits.weight" in learning) == boxes
