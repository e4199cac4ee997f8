"""Segmenters: cached masks, label images, the table of names and the network."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance, as_annotation, certain, mask_box
from bmask_slam.semantics.instances.overlay import draw
from bmask_slam.semantics.instances.surfaces import Segmented, SurfaceClasses, surfaces_of
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.config import DetectionConfig, ImageConfig, NetworkConfig
from bmask_slam.semantics.network.model import Detections, MaskRCNN
from bmask_slam.semantics.segmenters.mask_cache import ANNOTATIONS, CacheOptions, cache_masks
from bmask_slam.semantics.segmenters.network_segmenter import (
    NetworkSegmenter,
    as_instances,
    segment_both_ways,
)
from bmask_slam.semantics.segmenters.segmenter import (
    CocoSegmenter,
    LabelImageSegmenter,
    NoSegmenter,
    Segmenter,
    check_image,
)
from bmask_slam.semantics.segmenters.segmenter_table import NAMES, SegmenterOptions, make_segmenter
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork, save_network

LABELS = label_set(["cup", "mouse"])
TINY = NetworkConfig(
    classes=3, backbone="mobilenet_v2", norm="none", channels=16, box_hidden=8, mask_channels=8,
    maskiou_channels=8, maskiou_hidden=8, image=ImageConfig(96, 128),
    detections=DetectionConfig(min_score=0.0, max_count=20),
)  # fmt: skip


def rectangle(x: int, y: int, w: int, h: int, size: tuple[int, int] = (40, 60)) -> np.ndarray:
    mask = np.zeros(size, bool)
    mask[y : y + h, x : x + w] = True
    return mask


class Drawer:
    """Two instances in every image."""

    labels = LABELS

    def __init__(self) -> None:
        self.calls = 0

    def segment(self, image: Image, name: str) -> list[Instance]:
        check_image(image, name)
        self.calls += 1
        masks = [rectangle(5, 6, 20, 10), rectangle(30, 20, 8, 8)]
        return [
            Instance(masks[0], mask_box(masks[0]), 1, certain(1, 3, 0.9), 0.9, 0.63),
            Instance(masks[1], mask_box(masks[1]), 2, certain(2, 3, 0.6), 0.6, 0.5),
        ]


@pytest.fixture
def images(tmp_path: Path) -> list[tuple[str, Path]]:
    """Three images in a folder."""
    files = []
    for k in range(3):
        path = tmp_path / "rgb" / f"{k}.25.png"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((40, 60, 3), 50 * k, np.uint8))
        files.append((f"rgb/{path.name}", path))
    return files


def quiet(done: int, total: int) -> None:
    assert 0 < done <= total


def test_cached_masks_are_read_back(tmp_path: Path, images: list) -> None:
    out = tmp_path / "masks"
    drawer = Drawer()
    result = cache_masks(drawer, images, CacheOptions(out, {"name": "x"}), quiet)
    assert (result.images, result.instances, result.reused, result.broken) == (3, 6, 0, 0)
    overlay = cv2.imread(str(out / "overlays/rgb/0.25.jpg"))
    assert overlay[10, 15].max() > 60  # inside a mask of a black image
    assert overlay[35, 5].max() < 20
    again = CocoSegmenter(out / ANNOTATIONS)
    assert again.labels == LABELS
    image = np.zeros((40, 60, 3), np.uint8)
    for found, given in zip(again.segment(image, "rgb/1.25.png"), drawer.segment(image, ""),
                            strict=True):  # fmt: skip
        assert np.array_equal(found.mask, given.mask)
        assert found.box.tolist() == given.box.tolist()
        assert (found.label, found.class_score, found.mask_score) == pytest.approx(
            (given.label, given.class_score, given.mask_score)
        )
        assert found.distribution == pytest.approx(given.distribution, abs=1e-5)
    with pytest.raises(InputError, match=r"has no image rgb/9\.png"):
        again.segment(image, "rgb/9.png")
    with pytest.raises(InputError, match="60x40 pixels there, but 30x40 here"):
        again.segment(image[:, :30], "rgb/1.25.png")


@pytest.mark.parametrize("kind", ["coco", "label images"])
def test_masks_of_the_recorded_images_fit_reduced_ones(
    kind: str, tmp_path: Path, images: list
) -> None:
    whole, half = np.zeros((40, 60, 3), np.uint8), np.zeros((20, 30, 3), np.uint8)
    segmenter: Segmenter
    if kind == "coco":
        out = tmp_path / "masks"
        cache_masks(Drawer(), images, CacheOptions(out, {"name": "x"}), quiet)
        segmenter = CocoSegmenter(out / ANNOTATIONS)
    else:
        values = np.where(rectangle(10, 4, 20, 12), 1001, 0).astype(np.uint16)
        (tmp_path / "labels").mkdir()
        cv2.imwrite(str(tmp_path / "labels/1.25.png"), values)
        segmenter = LabelImageSegmenter(tmp_path / "labels", LABELS)
    found, reduced = (segmenter.segment(image, "rgb/1.25.png") for image in (whole, half))
    assert len(found) == len(reduced) > 0
    for one, other in zip(found, reduced, strict=True):
        assert other.mask.shape == (20, 30)
        assert other.mask.sum() == pytest.approx(one.mask.sum() / 4, rel=0.1)
        assert other.box == pytest.approx(one.box / 2, abs=1)


class Painter(Drawer):
    """Tells classes of all pixels too."""

    def segment(self, image: Image, name: str) -> list[Instance]:
        p = np.broadcast_to(np.array([0.7, 0.3], np.float16), (4, 6, 2))
        seen = SurfaceClasses(label_set(("wall", "floor")), p, 10.0, (40, 60))
        return Segmented(super().segment(image, name), seen)


def test_cached_classes_of_pixels_are_read_back(tmp_path: Path, images: list) -> None:
    """A folder of masks has them if the segmenter told them."""
    out, image = tmp_path / "masks", np.zeros((40, 60, 3), np.uint8)
    cache_masks(Painter(), images, CacheOptions(out, {"name": "x"}), quiet)
    found = CocoSegmenter(out / ANNOTATIONS).segment(image, "rgb/1.25.png")
    assert len(found) == 2
    seen = surfaces_of(found)
    assert seen is not None
    assert seen.labels.names == ("background", "wall", "floor")
    assert seen.at(np.array([[30.0, 20.0]])) == pytest.approx(np.array([[0.7, 0.3]]), abs=0.01)


def test_masks_of_older_versions_stay_usable(
    tmp_path: Path, images: list, caplog: pytest.LogCaptureFixture
) -> None:
    """Their settings do not name surfaces, which mean something for the light network alone."""
    options = CacheOptions(tmp_path / "light", {"name": "light"}, overlays=False)
    cache_masks(Drawer(), images[:2], options, quiet)
    now = replace(options, settings={"name": "light", "surfaces": "True"})
    assert cache_masks(Painter(), images, now, quiet).reused == 2
    assert sum("no surfaces" in line for line in caplog.messages) == 1
    assert not (options.out / "surfaces").exists()
    fresh = replace(now, out=tmp_path / "fresh")
    cache_masks(Painter(), images, fresh, quiet)
    without = {"name": "light", "surfaces": "False"}
    with pytest.raises(InputError, match="made with surfaces True, now it is False"):
        cache_masks(Drawer(), images, replace(fresh, settings=without), quiet)
    truth = replace(options, out=tmp_path / "truth", settings={"name": "truth"})
    for settings in (truth.settings, {"name": "truth", "surfaces": "True"}):
        cache_masks(Drawer(), images, replace(truth, settings=settings), quiet)
    assert len(caplog.messages) == 1


def test_a_folder_of_other_surface_classes_is_refused(tmp_path: Path, images: list) -> None:
    options = CacheOptions(tmp_path / "masks", {"name": "x"}, overlays=False)
    cache_masks(Drawer(), images[:1], options, quiet)
    names = options.out / "surfaces" / "classes.txt"
    names.parent.mkdir()
    names.write_text("floor\nwall\n")
    with pytest.raises(InputError, match=r"classes\.txt: other classes"):
        cache_masks(Painter(), images, options, quiet)


def test_images_that_differ_in_the_suffix_alone_are_refused(tmp_path: Path, images: list) -> None:
    name, path = images[0]
    other = f"{name.rpartition('.')[0]}.jpg"
    with pytest.raises(InputError, match=f"{name} and {other} differ in the suffix alone"):
        options = CacheOptions(tmp_path / "masks", {"name": "x"})
        cache_masks(Drawer(), [*images, (other, path)], options, quiet)
    assert not (tmp_path / "masks").exists()


def test_images_without_a_suffix_have_files_of_their_own(tmp_path: Path, images: list) -> None:
    named = [(f"day.1/{number}", path) for number, (_, path) in enumerate(images)]
    options = CacheOptions(tmp_path / "masks", {"name": "x"})
    assert cache_masks(Drawer(), named, options, quiet).images == len(named) > 1
    again = CocoSegmenter(tmp_path / "masks" / ANNOTATIONS)
    assert len(again.segment(np.zeros((40, 60, 3), np.uint8), "day.1/0")) == 2


def test_cached_images_are_not_segmented_again(tmp_path: Path, images: list) -> None:
    options = CacheOptions(tmp_path / "masks", {"name": "x"}, overlays=False)
    drawer = Drawer()
    cache_masks(drawer, images[:2], options, quiet)
    before = (tmp_path / "masks" / ANNOTATIONS).read_bytes()
    result = cache_masks(drawer, images, options, quiet)
    assert drawer.calls == 3
    assert result.reused == 2
    cache_masks(drawer, images[:2], options, quiet)
    assert (tmp_path / "masks" / ANNOTATIONS).read_bytes() == before
    with pytest.raises(InputError, match="made with name x, now it is y"):
        cache_masks(drawer, images, replace(options, settings={"name": "y"}), quiet)
    with pytest.raises(InputError, match="no folder of masks"):
        cache_masks(drawer, images, replace(options, out=tmp_path / "rgb"), quiet)


def test_a_broken_image_is_skipped_except_the_first(tmp_path: Path, images: list) -> None:
    images[1][1].write_bytes(b"\x89PNG cut")
    options = CacheOptions(tmp_path / "masks", {}, overlays=False)
    result = cache_masks(Drawer(), images, options, quiet)
    assert (result.images, result.broken) == (2, 1)
    images[0][1].write_bytes(b"")
    with pytest.raises(InputError, match="0 bytes"):
        cache_masks(Drawer(), images, replace(options, out=tmp_path / "other"), quiet)


def test_label_images_of_any_tool(tmp_path: Path) -> None:
    values = np.zeros((40, 60), np.uint16)
    values[2:6, 3:9] = 2  # every mouse in one
    values[10:20, 10:20], values[10:20, 30:40] = 1001, 1002  # two cups
    cv2.imwrite(str(tmp_path / "a.png"), values)
    image = np.zeros((40, 60, 3), np.uint8)
    found = LabelImageSegmenter(tmp_path, LABELS).segment(image, "rgb/a.jpg")
    assert [i.label for i in found] == [2, 1, 1]
    assert found[0].box.tolist() == [3, 2, 9, 6]
    assert found[1].mask.sum() == found[2].mask.sum() == 100
    assert found[0].distribution.tolist() == [0, 0, 1]
    values[0, 0] = 7
    cv2.imwrite(str(tmp_path / "a.png"), values)
    with pytest.raises(InputError, match="value 7 means label 7, but the label set ends at 2"):
        LabelImageSegmenter(tmp_path, LABELS).segment(image, "a.png")
    with pytest.raises(InputError, match="no such image"):
        LabelImageSegmenter(tmp_path, LABELS).segment(image, "b.png")


@pytest.mark.parametrize("bits", [2, 8])
def test_the_indices_of_a_label_image_with_a_palette_are_its_values(
    tmp_path: Path, bits: int
) -> None:
    """Tools that write Pascal VOC's format colour their labels so."""
    values = np.zeros((40, 60), np.uint8)
    values[2:6, 3:9], values[10:20, 10:20] = 2, 1
    picture = PIL.Image.fromarray(values, mode="P")
    picture.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0])
    picture.save(tmp_path / "a.png", bits=bits)
    found = LabelImageSegmenter(tmp_path, LABELS).segment(np.zeros((40, 60, 3), np.uint8), "a.png")
    assert [(i.label, int(i.mask.sum())) for i in found] == [(1, 100), (2, 24)]


def test_a_label_image_of_a_thousand_objects_takes_no_gigabytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "bmask_slam.semantics.segmenters.segmenter"
    monkeypatch.setattr(f"{module}.MAX_MASK_BYTES", 4 * 40 * 60)
    values = np.arange(40 * 60).reshape(40, 60) % 6
    cv2.imwrite(str(tmp_path / "a.png"), values.astype(np.uint8))
    with pytest.raises(InputError, match=r"a\.png: 5 different values, masks of more than"):
        LabelImageSegmenter(tmp_path, LABELS).segment(np.zeros((40, 60, 3), np.uint8), "a.png")


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 5), np.uint8),
        np.zeros((4, 5, 1), np.uint8),
        np.zeros((0, 5, 3), np.uint8),
        np.zeros((4, 5, 3), np.float32),
    ],
)
def test_other_than_colour_images_are_rejected(image: np.ndarray) -> None:
    torch.manual_seed(0)
    network = NetworkSegmenter(TrainedNetwork(MaskRCNN(TINY).eval(), LABELS), device="cpu")
    segmenters: list[Segmenter] = [NoSegmenter(), network]
    for segmenter in segmenters:
        with pytest.raises(InputError, match=r"x\.png: an image of shape"):
            segmenter.segment(image, "x.png")


def test_the_network_finds_instances_and_nothing_above_an_impossible_score() -> None:
    torch.manual_seed(0)
    network = TrainedNetwork(MaskRCNN(TINY).eval(), LABELS)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (60, 80, 3), np.uint8)
    found = NetworkSegmenter(network, 0.0, device="cpu").segment(image, "a")
    assert len(found) > 0
    for instance in found:
        assert instance.mask.shape == (60, 80)
        assert instance.mask.any()
        assert instance.distribution.sum() == pytest.approx(1, abs=1e-5)
        assert instance.distribution[instance.label] == pytest.approx(instance.class_score)
        assert 0 <= instance.mask_score <= instance.class_score
    scores = [i.mask_score for i in found]
    assert scores == sorted(scores, reverse=True)
    strict = NetworkSegmenter(network, 1.1, device="cpu")
    assert strict.segment(np.zeros((1, 1, 3), np.uint8), "one pixel") == []


def test_a_mirrored_view_of_an_array_and_a_line_of_pixels_are_images() -> None:
    """numpy gives the first negative strides, as to red, green, blue from OpenCV's images."""
    torch.manual_seed(0)
    network = NetworkSegmenter(TrainedNetwork(MaskRCNN(TINY).eval(), LABELS), 0.0, device="cpu")
    image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    found, same = (network.segment(i, "a") for i in (image[..., ::-1], image[..., ::-1].copy()))
    assert len(found) > 0
    for one, other in zip(found, same, strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
    network.segment(np.zeros((1, 4000, 3), np.uint8), "line")


def test_an_image_without_any_detection_gives_an_empty_list() -> None:
    torch.manual_seed(0)
    impossible = replace(TINY, detections=DetectionConfig(min_score=1.1))
    network = NetworkSegmenter(TrainedNetwork(MaskRCNN(impossible).eval(), LABELS), device="cpu")
    assert network.segment(np.zeros((60, 80, 3), np.uint8), "black") == []


def test_a_mask_of_an_enlarged_box_reaches_beyond_the_box() -> None:
    torch.manual_seed(0)
    config = replace(TINY, class_agnostic=True, mask_context=1.5)
    model = MaskRCNN(config).eval()
    with torch.no_grad():
        model.roi_heads.mask_predictor.mask_fcn_logits.bias.fill_(50.0)  # everything is object
    box = torch.tensor([[30.0, 20.0, 50.0, 40.0]])
    given = ClassifiedBoxes(box, torch.tensor([2]), torch.tensor([0.9]), torch.full((1, 3), 1 / 3))
    with torch.inference_mode():
        found = model.segment([torch.zeros(3, 60, 80)], [given])[0]
    torch.testing.assert_close(found.found.boxes, box)
    torch.testing.assert_close(found.mask_boxes, torch.tensor([[25.0, 15.0, 55.0, 45.0]]))
    rows, columns = np.nonzero(as_instances(found, (60, 80), 0.0)[0].mask)
    assert (columns.min(), rows.min()) == pytest.approx((25, 15), abs=1)
    assert (columns.max(), rows.max()) == pytest.approx((55, 45), abs=1)


def test_masks_of_a_mirrored_scene_are_the_mirrored_masks() -> None:
    torch.manual_seed(0)
    model = MaskRCNN(replace(TINY, class_agnostic=True)).eval()
    image = torch.rand(3, 64, 96)
    box = torch.tensor([[10.0, 8.0, 50.0, 60.0]])
    given = ClassifiedBoxes(box, torch.tensor([2]), torch.tensor([0.9]), torch.full((1, 3), 1 / 3))
    other = replace(given, boxes=torch.tensor([[46.0, 8.0, 86.0, 60.0]]))
    with torch.inference_mode():
        alone = model.segment([image], [given])[0]
        found = segment_both_ways(model, image, given)
        turned = segment_both_ways(model, image.flip(2), other)
    torch.testing.assert_close(found.found.boxes, box)
    torch.testing.assert_close(turned.masks, found.masks.flip(2))
    torch.testing.assert_close(turned.mask_ious, found.mask_ious)
    assert not torch.allclose(alone.masks, found.masks)


@pytest.mark.parametrize("channels", [0, 4])
def test_mask_ious_are_predicted_and_expected(channels: int) -> None:
    torch.manual_seed(0)
    config = replace(TINY, class_agnostic=True, maskiou_channels=channels)
    model = MaskRCNN(config).eval()
    with torch.no_grad():
        model.roi_heads.mask_predictor.mask_fcn_logits.weight.zero_()
        model.roi_heads.mask_predictor.mask_fcn_logits.bias.fill_(math.log(4.0))  # 0.8 everywhere
        if model.roi_heads.maskiou_head is not None:
            model.roi_heads.maskiou_head.maskiou.weight.zero_()
            model.roi_heads.maskiou_head.maskiou.bias.fill_(0.3)
    box = torch.tensor([[10.0, 8.0, 50.0, 60.0]])
    given = ClassifiedBoxes(box, torch.tensor([2]), torch.tensor([0.9]), torch.full((1, 3), 1 / 3))
    with torch.inference_mode():
        found = segment_both_ways(model, torch.rand(3, 64, 96), given)
    assert float(found.mask_ious) == pytest.approx(0.55 if channels else 1.0)


def test_mask_scores_reorder_detections_and_empty_masks_are_dropped() -> None:
    boxes = torch.tensor([[2.0, 2.0, 20.0, 20.0], [5.0, 5.0, 30.0, 30.0], [1.0, 1.0, 9.0, 9.0]])
    masks = torch.stack([torch.full((28, 28), p) for p in (0.9, 0.9, 0.1)])
    found = ClassifiedBoxes(
        boxes, torch.tensor([1, 2, 1]), torch.tensor([0.9, 0.8, 0.7]), torch.full((3, 3), 1 / 3)
    )
    detections = Detections(found, masks, boxes, torch.tensor([0.5, 0.9, 1.0]))
    instances = as_instances(detections, (40, 40), 0.0)
    assert [i.label for i in instances] == [2, 1]
    assert [i.mask_score for i in instances] == pytest.approx([0.72, 0.45])
    assert instances[1].class_score == pytest.approx(0.9)


def test_annotations_hold_both_scores_and_drawing_changes_only_its_copy() -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    instance = Drawer().segment(image, "a")[0]
    annotation = as_annotation(instance)
    assert annotation["bbox"] == [5, 6, 20, 10]
    assert annotation["area"] == 200
    assert (annotation["score"], annotation["class_score"]) == (0.63, 0.9)
    assert draw(image, [instance], LABELS).any()
    assert not image.any()


def test_the_table_of_names(tmp_path: Path) -> None:
    torch.manual_seed(0)
    save_network(TrainedNetwork(MaskRCNN(TINY).eval(), LABELS), tmp_path / "w.safetensors")
    weights = str(tmp_path / "w.safetensors")
    light = make_segmenter(SegmenterOptions("light", weights), tmp_path)
    assert light.labels == LABELS
    with pytest.raises(InputError, match="a mobilenet_v2 network, which is not"):
        make_segmenter(SegmenterOptions("mask-scoring-rcnn", weights), tmp_path)
    assert isinstance(make_segmenter(SegmenterOptions("none"), tmp_path), NoSegmenter)
    for name, words in {
        "mask-scoring-rcnn": "--weights",
        "precomputed": "--masks",
        "truth": r"annotations\.json: no such file",
        "yolact": f"there are: {', '.join(NAMES)}",
    }.items():
        with pytest.raises(InputError, match=words):
            make_segmenter(SegmenterOptions(name), tmp_path)
    folder = make_segmenter(SegmenterOptions("precomputed", masks=tmp_path), tmp_path)
    assert isinstance(folder, LabelImageSegmenter)
    assert len(folder.labels) == 81


@pytest.mark.parametrize("min_score", [50.0, -0.1, math.nan])
def test_a_limit_that_is_no_score_is_refused(tmp_path: Path, min_score: float) -> None:
    with pytest.raises(InputError, match=f"min_score {min_score:g}: a class score is 0 to 1"):
        make_segmenter(SegmenterOptions(min_score=min_score), tmp_path)
