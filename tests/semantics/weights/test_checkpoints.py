"""Weight files: which are read, and the errors for the others."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.labels import label_set, read_label_set
from bmask_slam.semantics.network.config import RESNET50, RESNET50_V2, NetworkConfig
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.weights.checkpoints import (
    TrainedNetwork,
    load_network,
    read_state,
    save_network,
)

State = dict[str, Tensor]


def blank_state(config: NetworkConfig) -> State:
    """Weights that take no room in a file: one number seen through strides of zero."""
    with torch.device("meta"):
        state = MaskRCNN(config).state_dict()
    return {k: torch.tensor(0.5).expand(v.shape) for k, v in state.items()}


def saved(path: Path, state: object) -> Path:
    torch.save(state, path)
    return path


def published_names(state: State) -> State:
    """The names in torchvision's published v1 file."""
    old = {}
    for name, value in state.items():
        before = re.sub(r"(_blocks\.\d)\.0\.", r"\1.", name)
        before = before.replace("rpn.head.conv.0.0.", "rpn.head.conv.")
        layer = re.match(r"roi_heads\.mask_head\.(\d)\.0\.(\w+)", before)
        if layer:
            before = f"roi_heads.mask_head.mask_fcn{int(layer[1]) + 1}.{layer[2]}"
        old[before] = value
    return old


def test_the_published_names_of_torchvision(tmp_path: Path) -> None:
    state = published_names(blank_state(RESNET50))
    assert "backbone.fpn.inner_blocks.0.weight" in state
    assert "roi_heads.mask_head.mask_fcn4.bias" in state
    network = load_network(saved(tmp_path / "maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth", state))
    assert network.model.config == replace(RESNET50, norm_eps=0.0)
    assert network.labels.names[1] == "person"
    assert network.labels.names[90] == "toothbrush"
    assert network.model.state_dict()["roi_heads.mask_head.3.0.bias"].tolist() == [0.5] * 256
    again = load_network(saved(tmp_path / "renamed.pth", {"model": state}))
    assert again.model.config == network.model.config


def test_version_one_from_scratch_counts_its_batches_and_keeps_the_default_eps(
    tmp_path: Path,
) -> None:
    state = blank_state(RESNET50)
    counted = {
        name.replace("running_var", "num_batches_tracked"): torch.tensor(7)
        for name in state
        if name.endswith("running_var")
    }
    assert len(counted) == 53
    network = load_network(saved(tmp_path / "maskrcnn_resnet50_fpn_coco-0.pth", state | counted))
    assert network.model.config == RESNET50


def test_an_eps_that_is_not_known_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = saved(tmp_path / "w.pth", blank_state(replace(RESNET50, classes=24)))
    network = load_network(path, read_label_set("paper"))
    assert network.model.config.norm_eps == RESNET50.norm_eps
    assert "w.pth: the eps of its batch norm is not known" in caplog.text


def test_version_two_is_recognised(tmp_path: Path) -> None:
    network = load_network(saved(tmp_path / "w.pth", blank_state(RESNET50_V2)))
    assert network.model.config == RESNET50_V2


def mask_scoring_state() -> State:
    """The names of a checkpoint of the original program, written down from its source."""
    body = blank_state(replace(RESNET50, classes=81).with_maskiou())
    state = {}
    for name, value in body.items():
        if name.startswith("backbone.body."):
            new = name if ".layer" in name else name.replace("body.", "body.stem.")
            state[f"module.{new}"] = value
    shapes = {
        **{f"backbone.fpn.fpn_inner{k}": (256, 256 << (k - 1), 1, 1) for k in range(1, 5)},
        **{f"backbone.fpn.fpn_layer{k}": (256, 256, 3, 3) for k in range(1, 5)},
        "rpn.head.conv": (256, 256, 3, 3),
        "rpn.head.cls_logits": (3, 256, 1, 1),
        "rpn.head.bbox_pred": (12, 256, 1, 1),
        "roi_heads.box.feature_extractor.fc6": (1024, 256 * 49),
        "roi_heads.box.feature_extractor.fc7": (1024, 1024),
        "roi_heads.box.predictor.cls_score": (81, 1024),
        "roi_heads.box.predictor.bbox_pred": (324, 1024),
        **{f"roi_heads.mask.feature_extractor.mask_fcn{k}": (256, 256, 3, 3) for k in range(1, 5)},
        "roi_heads.mask.predictor.conv5_mask": (256, 256, 2, 2),
        "roi_heads.mask.predictor.mask_fcn_logits": (81, 256, 1, 1),
        "roi_heads.maskiou.feature_extractor.maskiou_fcn1": (256, 257, 3, 3),
        **{f"roi_heads.maskiou.feature_extractor.maskiou_fcn{k}": (256, 256, 3, 3)
           for k in range(2, 5)},
        "roi_heads.maskiou.feature_extractor.maskiou_fc1": (1024, 256 * 49),
        "roi_heads.maskiou.feature_extractor.maskiou_fc2": (1024, 1024),
        "roi_heads.maskiou.predictor.maskiou": (81, 1024),
    }  # fmt: skip
    for name, shape in shapes.items():
        outputs = shape[1] if name.endswith("conv5_mask") else shape[0]
        state[f"module.{name}.weight"] = torch.tensor(0.5).expand(shape)
        state[f"module.{name}.bias"] = torch.tensor(0.5).expand(outputs)
    state["module.rpn.anchor_generator.cell_anchors.0"] = torch.zeros(3, 4)
    return state


def test_the_original_mask_scoring_checkpoints(tmp_path: Path) -> None:
    state = mask_scoring_state()
    bgr = torch.arange(3.0)[None, :, None, None].expand(64, 3, 7, 7)
    state["module.backbone.body.stem.conv1.weight"] = bgr
    network = load_network(saved(tmp_path / "ms.pth", {"model": state, "iteration": 90000}))
    config = network.model.config
    assert config.stride_in_1x1
    assert config.norm_eps == 0
    assert config.maskiou_channels == 256
    assert len(network.labels) == 81
    first = network.model.state_dict()["backbone.body.conv1.weight"]
    assert first[0, :, 0, 0].tolist() == [2, 1, 0]  # ours is red, green, blue
    mean_255 = [round(255 * m, 4) for m in config.image.mean]
    assert mean_255 == [122.7717, 115.9465, 102.9801]


def change(key: str | None = None, **changes: Tensor) -> Callable[[State], State]:
    return lambda s: {k: v for k, v in {**s, **changes}.items() if k != key}


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (change("rpn.head.bbox_pred.bias"), ["1 missing", "rpn.head.bbox_pred.bias"]),
        (change(surplus=torch.zeros(1)), ["1 not known", "surplus"]),
        (
            change(**{"roi_heads.box_head.fc7.bias": torch.zeros(512)}),
            ["roi_heads.box_head.fc7.bias (512,) instead of (1024,)"],
        ),
        (
            change(**{"rpn.head.bbox_pred.bias": torch.zeros(12, dtype=torch.int8)}),
            ["1 no floating-point numbers: rpn.head.bbox_pred.bias torch.int8"],
        ),
        (
            lambda s: {k: v for k, v in s.items() if "layer4" not in k},
            ["resnet50", "layer4", "..."],
        ),
    ],
)
def test_weights_that_differ_are_refused(
    tmp_path: Path, edit: Callable[[State], State], words: list[str]
) -> None:
    path = saved(tmp_path / "w.pth", edit(blank_state(RESNET50)))
    with pytest.raises(InputError) as error:
        load_network(path)
    for word in ["w.pth", *words]:
        assert word in str(error.value)


def test_another_label_count_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "w.pth", blank_state(RESNET50))
    with pytest.raises(InputError, match=r"w\.pth: has 91 classes .* label set has 24"):
        load_network(path, read_label_set("paper"))
    other = saved(tmp_path / "v.pth", blank_state(replace(RESNET50, classes=7)))
    with pytest.raises(InputError, match="has 7 classes"):
        load_network(other)


class Surprise:
    def __reduce__(self) -> tuple:
        return (print, ("this must never run",))


def test_files_that_are_no_state_dict_are_refused(tmp_path: Path, capsys) -> None:
    good = saved(tmp_path / "good.pth", {"a": torch.zeros(100)})
    cut = tmp_path / "cut.pth"
    cut.write_bytes(good.read_bytes()[:300])
    text = tmp_path / "text.pth"
    text.write_text("no weights here")
    half = tmp_path / "half.safetensors"
    half.write_bytes(b"\x10\x00\x00\x00\x00\x00\x00\x00{}")
    cases = {
        cut: "truncated or no PyTorch file",
        text: r"no PyTorch file|more than tensors",
        saved(tmp_path / "code.pth", Surprise()): "more than tensors",
        saved(tmp_path / "list.pth", [1, 2]): "holds a list, not a state_dict",
        saved(tmp_path / "odd.pth", {"a": 3}): "'a' is no tensor",
        half: "not a whole safetensors file",
    }
    for path, words in cases.items():
        with pytest.raises(InputError, match=words) as error:
            load_network(path)
        assert path.name in str(error.value)
    assert "never run" not in capsys.readouterr().out
    with pytest.raises(InputError, match="no such file"):
        load_network(tmp_path / "none.pth")


def test_our_files_describe_their_network(tmp_path: Path) -> None:
    config = NetworkConfig(
        classes=3, backbone="mobilenet_v2", norm="none", channels=16, box_hidden=8,
        mask_channels=8, maskiou_channels=8, maskiou_hidden=8,
    )  # fmt: skip
    network = TrainedNetwork(MaskRCNN(config).eval(), label_set(["cup", "mouse"]))
    save_network(network, tmp_path / "own.safetensors")
    again = load_network(tmp_path / "own.safetensors")
    assert again.model.config == config
    assert again.labels.names == ("background", "cup", "mouse")
    for name, value in network.model.state_dict().items():
        assert torch.equal(again.model.state_dict()[name], value.half().float())


def test_a_file_from_before_anchors_were_described(tmp_path: Path) -> None:
    config = NetworkConfig(
        classes=3, backbone="mobilenet_v2", norm="none", channels=8, box_hidden=8, mask_channels=8
    )
    network = TrainedNetwork(MaskRCNN(config).eval(), label_set(["cup", "mouse"]))
    save_network(network, tmp_path / "new.safetensors")
    state, metadata = read_state(tmp_path / "new.safetensors")
    described = json.loads(metadata["network"])
    del described["anchors"]
    save_file(state, tmp_path / "old.safetensors", {**metadata, "network": json.dumps(described)})
    assert load_network(tmp_path / "old.safetensors").model.config == config


def test_a_network_with_anchors_for_other_levels_is_refused(tmp_path: Path) -> None:
    """Weights of the same shapes, for which no level would be left over at the first image."""
    config = NetworkConfig(
        classes=3, backbone="mobilenet_v2", norm="none", channels=8, box_hidden=8, mask_channels=8
    )
    config = replace(config, anchors=replace(config.anchors, sizes_px=(32, 64, 128)))
    network = TrainedNetwork(MaskRCNN(config).eval(), label_set(["cup", "mouse"]))
    save_network(network, tmp_path / "three.safetensors")
    with pytest.raises(InputError, match=r"three\.safetensors: .*anchors of 3 sizes, not 5"):
        load_network(tmp_path / "three.safetensors")
