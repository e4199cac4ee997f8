"""``bmask-slam train`` on a few real photographs, and transfer to another label set."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from repository import shared

from bmask_slam.cli import main
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.semantics.labels import label_set, read_label_set
from bmask_slam.semantics.network.config import LIGHT
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.training import run
from bmask_slam.semantics.training.run import transferred
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork, load_network
from bmask_slam.semantics.weights.light_weights import SHIPPED, load_light


@pytest.fixture
def few(tmp_path: Path) -> Path:
    """The first four photographs of the excerpt that show a person."""
    content = json.loads(shared("coco_excerpt/instances.json").read_text())
    people = {a["image_id"] for a in content["annotations"] if a["category_id"] == 1}
    chosen = sorted(people)[:4]
    content["images"] = [i for i in content["images"] if i["id"] in chosen]
    content["annotations"] = [a for a in content["annotations"] if a["image_id"] in chosen]
    (tmp_path / "few.json").write_text(json.dumps(content))
    return tmp_path / "few.json"


def test_new_heads_of_the_light_network_are_trained(
    few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = str(shared("coco_excerpt/images"))
    command = ["train", "--data", str(few), "--images", images, "--quiet"]
    command += ["--steps", "1", "--batch", "1", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    weights = Path(capsys.readouterr().out.strip())
    new, shipped = (load_light(path).model.state_dict() for path in (weights, data_path(*SHIPPED)))
    same = {name for name, value in new.items() if torch.equal(value, shipped[name])}
    assert same == {name for name in new if name.startswith("detector.")}
    assert (tmp_path / "out" / "losses.png").stat().st_size > 1000


def test_a_network_on_mobilenet_is_trained_and_resumed(
    few: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small = replace(LIGHT, image=replace(LIGHT.image, short_px=120, long_px=200))
    monkeypatch.setattr(run, "LIGHT", small)
    images = str(shared("coco_excerpt/images"))
    command = ["train", "--data", str(few), "--images", images, "--labels", "paper", "--quiet"]
    command += [
        "--steps",
        "1",
        "--batch",
        "1",
        "--rois",
        "objects",
        "--only",
        "masks",
        "--freeze",
        "backbone.body",
    ]
    body = str(shared("weights/mobilenet_v2_imagenet_folded.pth"))
    out = tmp_path / "first"
    assert main([*command, "--backbone", body, "--out", str(out)]) == 0
    weights = Path(capsys.readouterr().out.strip())
    assert weights == out / "weights.safetensors"
    assert weights.stat().st_size < 25e6
    network = load_network(weights)
    assert network.labels == read_label_set("paper")
    assert (out / "losses.png").stat().st_size > 1000
    again = [*command, "--weights", str(weights), "--only", "maskiou", "--out", str(tmp_path / "b")]
    assert main(again) == 0
    second = load_network(tmp_path / "b" / "weights.safetensors")
    kept = "roi_heads.mask_head.0.0.weight"
    assert torch.equal(second.model.state_dict()[kept], network.model.state_dict()[kept])


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--labels", "paper"], "--labels paper: the light network has COCO's classes"),
        (["--held-out", "1.5"], "--held-out 1.5"),
        (["--steps", "0"], "steps and batch must be at least 1"),
        (["--weights", "none.pth"], "none.pth: no such file"),
    ],
)
def test_incompatible_options_are_rejected(
    few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], words: str
) -> None:
    images = str(shared("coco_excerpt/images"))
    out = tmp_path / "out"
    command = ["train", "--data", str(few), "--images", images, "--out", str(out), "--quiet"]
    assert main([*command, *extra]) == 1
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_transfer_keeps_the_weights_of_common_classes() -> None:
    torch.manual_seed(0)
    config = replace(LIGHT, classes=4, class_agnostic=False)
    old = TrainedNetwork(MaskRCNN(config), label_set(["person", "boat", "cup"]))
    new = transferred(old, label_set(["cup", "drone", "person"]))
    before, after = old.model.state_dict(), new.model.state_dict()
    assert new.model.config.classes == 4
    layers = {"box_predictor.cls_score": 1, "box_predictor.bbox_pred": 4}
    layers |= {"mask_predictor.mask_fcn_logits": 1, "maskiou_head.maskiou": 1}
    for layer, each in layers.items():
        for end in ("weight", "bias"):
            was = before[f"roi_heads.{layer}.{end}"].unflatten(0, (4, each))
            now = after[f"roi_heads.{layer}.{end}"].unflatten(0, (4, each))
            assert torch.equal(now[[0, 1, 3]], was[[0, 3, 1]])
            assert end == "bias" or not torch.equal(now[2], was[2])
    assert torch.equal(after["rpn.head.cls_logits.weight"], before["rpn.head.cls_logits.weight"])
