"""Every stage, and the whole network, against what torchvision computed (make_golden.py)."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from random_weights import picture, random_boxes, random_state

from bmask_slam.semantics.network import boxes as box_ops
from bmask_slam.semantics.network.anchors import make_anchors
from bmask_slam.semantics.network.config import (
    RESNET50,
    RESNET50_V2,
    RESNET101,
    AnchorConfig,
    DetectionConfig,
    ImageConfig,
    NetworkConfig,
    ProposalConfig,
)
from bmask_slam.semantics.network.images import prepare
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.network.nms import grouped_nms, nms
from bmask_slam.semantics.network.roi_align import assign_levels, feature_table, roi_align
from bmask_slam.semantics.segmenters.network_segmenter import paste

TOLERANCE = 1e-4
GOLDEN: Mapping[str, NDArray] = dict(np.load(Path(__file__).parent / "golden.npz"))
SMALL = {
    "image": ImageConfig(96, 120),
    "proposals": ProposalConfig(after_nms=100),
    "detections": DetectionConfig(max_count=30),
}
VARIANTS = {"resnet50": RESNET50, "resnet101": RESNET101, "resnet50_v2": RESNET50_V2}


def assert_golden(name: str, found: torch.Tensor, tolerance: float = TOLERANCE) -> None:
    """Equal to ``tolerance`` in absolute numbers: pixels, probabilities, activations."""
    expected = GOLDEN[name]
    assert found.shape == expected.shape
    np.testing.assert_allclose(found.numpy(), expected, atol=tolerance, rtol=0)


class Components:
    """The inputs of make_golden.component_results, drawn in the same order."""

    def __init__(self) -> None:
        rng = np.random.default_rng(5)
        self.boxes = torch.from_numpy(random_boxes(rng, 300, (160, 224)))
        self.others = torch.from_numpy(random_boxes(rng, 300, (160, 224)))
        self.offsets = torch.from_numpy(rng.normal(0, 3, (300, 8)).astype(np.float32))
        self.scores = torch.from_numpy(rng.permutation(300).astype(np.float32))
        self.groups = torch.from_numpy(rng.integers(0, 4, 300))
        self.large = torch.from_numpy(random_boxes(rng, 400, (800, 1088)))
        self.levels = [
            torch.from_numpy(rng.normal(0, 1, (2, 5, 200 >> k, 272 >> k)).astype(np.float32))
            for k in range(4)
        ]
        self.masks = torch.from_numpy(rng.uniform(0, 1, (6, 1, 28, 28)).astype(np.float32))
        self.at = torch.from_numpy(random_boxes(rng, 6, (60, 80)))


@pytest.fixture(scope="module")
def given() -> Components:
    return Components()


def test_anchors_of_a_rounded_up_coarsest_level() -> None:
    grids = [(40, 56), (20, 28), (10, 14), (5, 7), (3, 4)]
    anchors = make_anchors([torch.zeros(1, 1, *grid) for grid in grids], (160, 224), AnchorConfig())
    assert [len(a) for a in anchors] == [3 * h * w for h, w in grids]
    assert_golden("component/anchors", torch.cat(anchors)[::3].float())


def test_more_anchors_of_half_the_size_follow_those_of_a_cell() -> None:
    levels = [torch.zeros(1, 1, 4 >> k, 8 >> k) for k in range(2)]
    config = AnchorConfig((32, 64), half_ratios=(1.0, 4.0))
    usual = make_anchors(levels, (16, 32), replace(config, half_ratios=()))
    found = make_anchors(levels, (16, 32), config)
    for level, size_px in enumerate(config.sizes_px):
        cells = found[level].unflatten(0, (-1, config.count))
        assert torch.equal(cells[:, :3].flatten(0, 1), usual[level])
        x1, y1, x2, y2 = cells[:, 3:].unbind(-1)
        assert torch.equal((x1 + x2)[:, 0], (usual[level][1::3, 0] + usual[level][1::3, 2]))
        assert (x2 - x1).unique(dim=0).tolist() == [[size_px / 2, size_px / 4]]
        assert (y2 - y1).unique(dim=0).tolist() == [[size_px / 2, size_px]]


def test_overlap_of_boxes_one_by_one() -> None:
    rng = np.random.default_rng(3)
    a, b = (torch.from_numpy(random_boxes(rng, n, (40, 60))) for n in (7, 11))
    found = box_ops.iou(a, b)
    for i, j in np.ndindex(7, 11):
        width = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
        height = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
        both = max(float(width), 0.0) * max(float(height), 0.0)
        either = float(box_ops.area(a)[i] + box_ops.area(b)[j]) - both
        assert float(found[i, j]) == pytest.approx(both / either, abs=1e-6)


def test_box_coding(given: Components) -> None:
    encoded = box_ops.encode(given.boxes, given.others, box_ops.BOX_WEIGHTS)
    assert_golden("component/encoded", encoded)
    decoded = box_ops.decode(given.offsets.reshape(300, 2, 4), given.others, box_ops.BOX_WEIGHTS)
    assert_golden("component/decoded", decoded.flatten(1))
    back = box_ops.decode(encoded[:, None], given.others, box_ops.BOX_WEIGHTS)[:, 0]
    small = (encoded[:, 2:].abs() / 5 < box_ops.MAX_LOG_SCALE).all(dim=1)
    torch.testing.assert_close(back[small], given.boxes[small], atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("max_iou", [0.2, 0.5, 0.7])
def test_nms(given: Components, max_iou: float) -> None:
    assert_golden(f"component/nms{max_iou}", nms(given.boxes, given.scores, max_iou), 0)
    grouped = grouped_nms(given.boxes, given.scores, given.groups, max_iou)
    assert_golden(f"component/batched_nms{max_iou}", grouped, 0)


def test_a_chain_of_suppressions_starts_at_the_best_box() -> None:
    x = torch.arange(40.0) * 4
    boxes = torch.stack([x, torch.zeros(40), x + 10, torch.full((40,), 10.0)], dim=1)
    kept = nms(boxes, torch.arange(40.0, 0, -1), 0.4)  # each overlaps its neighbours by 6 / 14
    assert kept.tolist() == list(range(0, 40, 2))
    assert len(nms(torch.zeros(0, 4), torch.zeros(0), 0.5)) == 0


def test_level_assignment(given: Components) -> None:
    levels = assign_levels(given.large, 2, 4)
    assert set(levels.tolist()) == {0, 1, 2, 3}
    assert_golden("component/level_of_box", levels, 0)


@pytest.mark.parametrize("bins", [7, 14])
def test_roi_align(given: Components, bins: int) -> None:
    table = feature_table(given.levels, 800)
    pooled = roi_align(table, [given.large[:150], given.large[150:]], bins)
    assert_golden(f"component/roi_align{bins}", pooled[::bins])


def test_roi_align_of_a_linear_ramp_is_the_ramp_and_has_gradients() -> None:
    v, u = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    ramp = torch.stack([u, v])[None].requires_grad_()
    table = feature_table([ramp], 160)
    box = torch.tensor([[20.0, 40.0, 76.0, 96.0]])  # cells 5..19 and 10..24: bins of 2 cells
    pooled = roi_align(table, [box], 7)[0]
    centres = torch.arange(7) * 2 + 1.0
    torch.testing.assert_close(pooled[0], (5 + centres).expand(7, 7))
    torch.testing.assert_close(pooled[1], (10 + centres)[:, None].expand(7, 7))
    pooled[0].sum().backward()
    assert ramp.grad is not None
    assert float(ramp.grad[0, 0].sum()) == pytest.approx(49)
    assert float(ramp.grad[0, 1].abs().sum()) == 0


def test_pasted_masks(given: Components) -> None:
    assert_golden("component/pasted", paste(given.masks[:, 0], given.at, (60, 80)))
    assert paste(given.masks[:0, 0], given.at[:0], (60, 80)).shape == (0, 60, 80)


def test_images_are_resized_and_padded() -> None:
    pair = [torch.from_numpy(picture(48, 64, 2)), torch.from_numpy(picture(30, 70, 3))]
    batch = prepare(pair, ImageConfig(80, 120))
    assert np.array_equal(batch.sizes, GOLDEN["component/transformed_sizes"])
    assert batch.original_sizes == [(48, 64), (30, 70)]
    assert_golden("component/transformed", batch.tensor)


def random_network(config: NetworkConfig) -> MaskRCNN:
    with torch.device("meta"):
        model = MaskRCNN(config)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    state = {k: torch.from_numpy(v) for k, v in random_state(shapes, seed=1).items()}
    model.load_state_dict(state, assign=True)
    return model.eval()


@pytest.mark.parametrize("name", list(VARIANTS))
def test_names_and_shapes_of_parameters(name: str) -> None:
    with torch.device("meta"):
        state = MaskRCNN(VARIANTS[name]).state_dict()
    names = sorted(f"{key} {tuple(value.shape)}" for key, value in state.items())
    assert names == GOLDEN[f"{name}/names"].tolist()


@pytest.fixture(scope="module", params=["resnet50", "resnet50_v2"])
def named(request: pytest.FixtureRequest) -> tuple[str, MaskRCNN]:
    """A network with random weights, made once for both tests of it."""
    return request.param, random_network(replace(VARIANTS[request.param], **SMALL))


def test_the_whole_network(named: tuple[str, MaskRCNN]) -> None:
    """In float64, so that rounding does not exchange nearly equal scores or overlaps."""
    name, model = named[0], copy.deepcopy(named[1]).double()
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # faster
    images = [torch.from_numpy(picture(96, 128, 0)), torch.from_numpy(picture(120, 90, 1))]
    images = [image.double() for image in images]
    recorded: dict[str, list] = {}
    for key, module in (("levels", model.backbone), ("proposals", model.rpn),
                        ("box", model.roi_heads.box_predictor)):  # fmt: skip
        module.register_forward_hook(lambda _m, _i, out, key=key: recorded.update({key: out}))
    with torch.inference_mode():
        results = model(images)
    for i, level in enumerate(recorded["levels"]):
        assert_golden(f"{name}/level{i}", level[:, ::128])
    for b, (result, image) in enumerate(zip(results, images, strict=True)):
        assert_golden(f"{name}/proposals{b}", recorded["proposals"][b][::5])
        assert len(result.found.labels) == 30
        assert_golden(f"{name}/labels{b}", result.found.labels, 0)
        assert_golden(f"{name}/boxes{b}", result.found.boxes)
        assert_golden(f"{name}/scores{b}", result.found.scores)
        size = (image.shape[1], image.shape[2])
        pasted = paste(result.masks[:3], result.found.boxes[:3], size)
        assert_golden(f"{name}/pasted{b}", pasted)
        own = result.found.distributions.gather(1, result.found.labels[:, None])[:, 0]
        torch.testing.assert_close(own, result.found.scores)
    assert_golden(f"{name}/box_logits", recorded["box"][0][::40])


def test_the_whole_network_at_inference(named: tuple[str, MaskRCNN]) -> None:
    """In float32, with which boxes differ by less than 1e-4 px."""
    name, model = named
    images = [torch.from_numpy(picture(96, 128, 0)), torch.from_numpy(picture(120, 90, 1))]
    with torch.inference_mode():
        results = model(images)
    for b, (result, image) in enumerate(zip(results, images, strict=True)):
        assert_golden(f"{name}/labels{b}", result.found.labels, 0)
        assert_golden(f"{name}/boxes{b}", result.found.boxes)
        assert_golden(f"{name}/scores{b}", result.found.scores)
        size = (image.shape[1], image.shape[2])
        assert_golden(f"{name}/pasted{b}", paste(result.masks[:3], result.found.boxes[:3], size))
