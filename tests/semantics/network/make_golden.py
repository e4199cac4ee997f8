"""Writes golden.npz: what torchvision computes, for test_parity.py. Not part of the tests' run.

    python3 -m venv ref && ref/bin/pip install torch==2.15.0 torchvision==0.29.2
    PYTHONPATH=tests/helpers ref/bin/python tests/semantics/network/make_golden.py \
        tests/semantics/network/golden.npz

Weights and inputs come from seeds (random_weights.py), so only results are stored.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
import torchvision
from random_weights import picture, random_boxes, random_state
from torchvision.models.detection import maskrcnn_resnet50_fpn_v2
from torchvision.models.detection._utils import BoxCoder
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.mask_rcnn import MaskRCNN
from torchvision.models.detection.roi_heads import paste_masks_in_image
from torchvision.models.detection.transform import GeneralizedRCNNTransform
from torchvision.ops import MultiScaleRoIAlign, batched_nms, nms
from torchvision.ops.misc import FrozenBatchNorm2d
from torchvision.ops.poolers import LevelMapper

SIZES = {
    "min_size": 96,
    "max_size": 120,
    "rpn_post_nms_top_n_test": 100,
    "box_detections_per_img": 30,
}
CLASSES = 91
Arrays = dict[str, np.ndarray]


def networks() -> dict[str, MaskRCNN]:
    """torchvision's two models, and the first with ResNet-101; with random weights."""
    made = {}
    for name in ("resnet50", "resnet101"):
        body = resnet_fpn_backbone(backbone_name=name, weights=None, norm_layer=FrozenBatchNorm2d)
        made[name] = MaskRCNN(body, CLASSES, **SIZES)
    made["resnet50_v2"] = maskrcnn_resnet50_fpn_v2(
        weights=None, weights_backbone=None, num_classes=CLASSES, **SIZES
    )
    for model in made.values():
        shapes = {k: tuple(v.shape) for k, v in model.state_dict().items()}
        state = random_state(shapes, seed=1)
        model.load_state_dict({k: torch.from_numpy(v) for k, v in state.items()})
        model.eval().double()
    return made


def parameter_names(model: MaskRCNN) -> np.ndarray:
    """Every entry of the state_dict as "name shape", sorted."""
    return np.array(sorted(f"{k} {tuple(v.shape)}" for k, v in model.state_dict().items()))


def network_results(name: str, model: MaskRCNN) -> Arrays:
    """Intermediate and final results for two images of different shape."""
    images = [torch.from_numpy(picture(96, 128, 0)), torch.from_numpy(picture(120, 90, 1))]
    images = [image.double() for image in images]
    recorded: dict[str, list] = {"levels": [], "rpn": [], "box": [], "masks": []}
    hooks = (
        (model.backbone, "levels"), (model.rpn.head, "rpn"), (model.roi_heads.box_predictor, "box"),
        (model.roi_heads.mask_predictor, "masks"),
    )  # fmt: skip
    for module, key in hooks:
        module.register_forward_hook(lambda _m, _i, out, key=key: recorded[key].append(out))
    proposals: list = []
    model.rpn.register_forward_hook(lambda _m, _i, out: proposals.extend(out[0]))
    results = model(images)
    out: Arrays = {}
    for i, level in enumerate(recorded["levels"][0].values()):
        out[f"level{i}"] = level[:, ::128].numpy()
    out["box_logits"] = recorded["box"][0][0][::40].numpy()
    for b, result in enumerate(results):
        out[f"proposals{b}"] = proposals[b][::5].numpy()
        for key in ("boxes", "labels", "scores"):
            out[f"{key}{b}"] = result[key].numpy()
        out[f"pasted{b}"] = result["masks"][:3, 0].numpy()
        classes = len(set(result["labels"].tolist()))
        print(f"{name}, image {b}: {len(result['scores'])} detections of {classes} classes")
    return {f"{name}/{key}": _stored(value) for key, value in out.items()}


def _stored(array: np.ndarray) -> np.ndarray:
    """As float32; the networks run in float64, so that rounding does not affect comparisons."""
    return array.astype(np.float32) if array.dtype == np.float64 else array


def component_results() -> Arrays:
    """Each stage alone, on inputs that test_parity.py draws from the same seeds."""
    rng = np.random.default_rng(5)
    out: Arrays = {}
    generator = AnchorGenerator(((32,), (64,), (128,), (256,), (512,)), ((0.5, 1.0, 2.0),) * 5)
    grids = [(40, 56), (20, 28), (10, 14), (5, 7), (3, 4)]
    features = [torch.zeros(1, 1, *grid) for grid in grids]
    images = ImageList(torch.zeros(1, 3, 160, 224), [(160, 224)])
    out["anchors"] = generator(images, features)[0][::3].numpy()

    boxes = torch.from_numpy(random_boxes(rng, 300, (160, 224)))
    others = torch.from_numpy(random_boxes(rng, 300, (160, 224)))
    coder = BoxCoder((10.0, 10.0, 5.0, 5.0))
    out["encoded"] = coder.encode_single(boxes, others).numpy()
    offsets = torch.from_numpy(rng.normal(0, 3, (300, 8)).astype(np.float32))
    out["decoded"] = coder.decode_single(offsets, others).numpy()

    scores = torch.from_numpy(rng.permutation(300).astype(np.float32))
    groups = torch.from_numpy(rng.integers(0, 4, 300))
    for iou in (0.2, 0.5, 0.7):
        out[f"nms{iou}"] = nms(boxes, scores, iou).numpy()
        out[f"batched_nms{iou}"] = batched_nms(boxes, scores, groups, iou).numpy()

    large = torch.from_numpy(random_boxes(rng, 400, (800, 1088)))
    out["level_of_box"] = LevelMapper(2, 5)([large]).numpy()
    levels = {}
    for k in range(4):
        drawn = rng.normal(0, 1, (2, 5, 200 >> k, 272 >> k))
        levels[str(k)] = torch.from_numpy(drawn.astype(np.float32))
    halves = [large[:150], large[150:400]]
    for bins in (7, 14):
        align = MultiScaleRoIAlign(list(levels), bins, 2)
        pooled = align(levels, halves, [(800, 1066), (790, 1088)])
        out[f"roi_align{bins}"] = pooled[::bins].numpy()

    masks = torch.from_numpy(rng.uniform(0, 1, (6, 1, 28, 28)).astype(np.float32))
    at = torch.from_numpy(random_boxes(rng, 6, (60, 80)))
    out["pasted"] = paste_masks_in_image(masks, at, (60, 80)).numpy()[:, 0]
    transform = GeneralizedRCNNTransform(80, 120, [0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    transform.eval()
    pair = [torch.from_numpy(picture(48, 64, 2)), torch.from_numpy(picture(30, 70, 3))]
    batch, _ = transform(pair)
    out["transformed"] = batch.tensors.numpy()
    out["transformed_sizes"] = np.array(batch.image_sizes)
    return {f"component/{key}": value for key, value in out.items()}


def main() -> None:
    """Write the file that the command line names."""
    with torch.inference_mode():
        arrays = component_results()
        for name, model in networks().items():
            arrays[f"{name}/names"] = parameter_names(model)
            if name != "resnet101":
                arrays |= network_results(name, model)
    arrays["versions"] = np.array([torch.__version__, torchvision.__version__])
    np.savez_compressed(Path(sys.argv[1]), **arrays)


if __name__ == "__main__":
    main()
