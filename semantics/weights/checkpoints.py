"""Weight files: read without running code in them, recognised, checked, written."""

from __future__ import annotations

import io
import json
import logging
import pickle
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import Name, parse_json
from bmask_slam.graph.files.reading import check_unpacked, in_short, read_bytes
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.labels import LabelSet, label_set, read_label_set
from bmask_slam.semantics.network.config import (
    RESNET50,
    RESNET50_V2,
    RESNET101,
    ImageConfig,
    NetworkConfig,
)
from bmask_slam.semantics.network.model import ROI_LEVELS, MaskRCNN
from bmask_slam.semantics.weights.checkpoint_names import (
    BATCHES,
    State,
    current_names,
    is_mask_scoring,
)

COCO_CLASSES = 91
"""Of torchvision's published weights, background included."""
CAFFE_IMAGES = ImageConfig(
    mean=(122.7717 / 255, 115.9465 / 255, 102.9801 / 255), std=(1 / 255, 1 / 255, 1 / 255)
)
"""The original Mask Scoring R-CNN subtracts the mean from 0..255 and does not divide."""
CLASSES_KEY = "roi_heads.box_predictor.cls_score.weight"
SHOWN = 4
MAX_WEIGHTS_BYTES = 1 << 32
MAX_ANCHORS, MAX_LAYERS, MAX_WIDTH = 64, 64, 16_384


_UNREADABLE = (
    *(RuntimeError, EOFError, OSError, ValueError, LookupError, TypeError, AttributeError),
    *(AssertionError, ArithmeticError, struct.error, zipfile.BadZipFile),
)
"""What torch raises for files that are not what they seem."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainedNetwork:
    """A network with its weights and the label set of its classes."""

    model: MaskRCNN
    labels: LabelSet


def load_network(path: Path, labels: LabelSet | None = None) -> TrainedNetwork:
    """Load the network of a weights file, in evaluation mode.

    Files of this project (.safetensors) hold the configuration; torchvision's and the original Mask
    Scoring R-CNN's are recognised by the names and shapes of their parameters.

    Raises:
        InputError: an unreadable file, or weights of another network or label set; the message says
            what differs.
    """
    state, metadata = read_state(path)
    own: LabelSet | None
    if "network" in metadata:
        config, own = _described(path, metadata)
    else:
        state, config = current_names(state), recognise(path, state)
        own = _published_labels(config.classes)
    labels = labels or own
    if labels is None or len(labels) != config.classes:
        given = "none is known" if labels is None else f"the label set has {len(labels)}"
        raise InputError(
            f"{path}: has {config.classes} classes with the background, but {given}; "
            "give the label set that it was trained on"
        )
    try:
        with torch.device("meta"):
            model = MaskRCNN(config)
    except ValueError as error:
        raise InputError(f"{path}: no such network ({error}); give other weights") from error
    check_state(path, state, model, _name(config))
    model.load_state_dict(single_precision(state), assign=True)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return TrainedNetwork(model.eval(), labels)


def load_mobilenet(model: MaskRCNN, path: Path) -> None:
    """Load the body of an ImageNet classifier into a light network, without its last layers.

    Raises:
        InputError: the file is not a MobileNetV2 with batch norm folded into its weights.
    """
    state, _ = read_state(path)
    expected = model.backbone.body.state_dict()
    different = sorted(
        k for k, v in expected.items() if k not in state or state[k].shape != v.shape
    )
    if different:
        raise InputError(
            f"{path}: not a folded MobileNetV2; {len(different)} of {len(expected)} parameters are "
            f"missing or of another shape, such as {different[0]}"
        )
    model.backbone.body.load_state_dict({k: state[k] for k in expected})


def save_network(network: TrainedNetwork, path: Path, half: bool = True) -> None:
    """Write weights, configuration and class names; by default in half precision."""
    state = {}
    for name, value in network.model.state_dict().items():
        small = value.half() if half and value.is_floating_point() else value
        state[name] = small.detach().cpu().contiguous()
    metadata = {
        "network": json.dumps(asdict(network.model.config), sort_keys=True),
        "labels": json.dumps(network.labels.names),
    }
    with whole_file(path) as temporary:
        save_file(state, temporary, metadata)


def read_state(path: Path) -> tuple[State, dict[str, str]]:
    """Tensors by name, and the metadata of a safetensors file. No code in the file is run.

    Raises:
        InputError: no such file, a truncated one, or a pickle of anything but tensors.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give weights as .pth or .safetensors")
    if path.suffix == ".safetensors":
        try:
            with safetensors.safe_open(path, "pt") as file:
                metadata = file.metadata() or {}
            return load_file(path), metadata
        except (safetensors.SafetensorError, OSError) as error:
            raise InputError(f"{path}: not a whole safetensors file ({in_short(error)})") from error
    content = read_pickle(path)
    for key in ("model", "state_dict"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not content:
        raise InputError(f"{path}: holds a {type(content).__name__}, not a state_dict")
    other = next((k for k, v in content.items() if not isinstance(v, Tensor)), None)
    if other is not None:
        raise InputError(f"{path}: the entry {other!r} is no tensor; save the state_dict alone")
    return {str(name): value for name, value in content.items()}, {}


def read_pickle(path: Path) -> Any:
    """What PyTorch saved: tensors, numbers and texts in containers. No code in the file is run.

    Raises:
        InputError: no such file, a truncated one, one that unpacks to far more than its size, or a
            pickle of anything else.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as zipped:
                unpacked = sum(info.file_size for info in zipped.infolist())
            check_unpacked(unpacked, path.stat().st_size)
        data = io.BytesIO(read_bytes(path, "get it again", MAX_WEIGHTS_BYTES))
        return torch.load(data, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: holds more than tensors, which is not loaded since it could run code; "
            "save the state_dict alone"
        ) from error
    except _UNREADABLE as error:
        raise InputError(
            f"{path}: truncated or no PyTorch file ({path.stat().st_size} bytes); get it again"
        ) from error


def recognise(path: Path, state: State) -> NetworkConfig:
    """The configuration whose parameter names agree best with a state_dict.

    A file does not say the eps of its batch norm. It is 0 in the original Mask Scoring R-CNN and in
    the network that torchvision makes of its published v1 weights, whatever the file's name. A v1
    network that was trained from scratch counts its batches and has torchvision's default.
    """
    caffe = is_mask_scoring(state)
    counts_batches = any(name.endswith(BATCHES) for name in state)
    state = current_names(state)
    candidates = [RESNET50, RESNET50_V2, RESNET101]
    if caffe:
        candidates = [
            replace(c, stride_in_1x1=True, norm_eps=0.0, image=CAFFE_IMAGES)
            for c in (RESNET50, RESNET101)
        ]
    if CLASSES_KEY in state and state[CLASSES_KEY].ndim == 2:
        candidates = [replace(c, classes=len(state[CLASSES_KEY])) for c in candidates]
    if any(".maskiou_" in name for name in state):
        candidates = [c.with_maskiou() for c in candidates]
    best = min(candidates, key=lambda config: len(_names(config) ^ state.keys()))
    if caffe or counts_batches or best.norm != "frozen":
        return best
    if best.classes == COCO_CLASSES:
        return replace(best, norm_eps=0.0)
    logger.warning(
        "%s: the eps of its batch norm is not known, %g is taken, torchvision's default; a network "
        "that was fine-tuned from torchvision's COCO weights has 0 and gives slightly other masks",
        *(path, best.norm_eps),
    )
    return best


def _names(config: NetworkConfig) -> set[str]:
    with torch.device("meta"):
        return set(MaskRCNN(config).state_dict())


def _name(config: NetworkConfig) -> str:
    return f"a Mask R-CNN with {config.backbone} and {config.classes} classes"


def check_state(path: Path, state: State, model: nn.Module, name: str) -> None:
    """Raise InputError with the differences unless the weights are exactly the model's."""
    expected = model.state_dict()
    missing, extra = sorted(expected.keys() - state.keys()), sorted(state.keys() - expected.keys())
    shaped = [
        f"{k} {tuple(state[k].shape)} instead of {tuple(expected[k].shape)}"
        for k in sorted(expected.keys() & state.keys())
        if state[k].shape != expected[k].shape
    ]
    whole = [
        f"{k} {state[k].dtype}"
        for k in sorted(expected.keys() & state.keys())
        if expected[k].is_floating_point() and not state[k].is_floating_point()
    ]
    kinds = (
        ("missing", missing),
        ("not known", extra),
        ("of another shape", shaped),
        ("no floating-point numbers", whole),
    )
    parts = [
        f"{len(names)} {kind}: {', '.join(names[:SHOWN])}{' ...' if len(names) > SHOWN else ''}"
        for kind, names in kinds
        if names
    ]
    if parts:
        raise InputError(
            f"{path}: not the weights of {name}; {'; '.join(parts)}; give weights of that network"
        )


def single_precision(state: State) -> State:
    """The weights as the networks compute with them; counters stay whole numbers."""
    return {k: v.float() if v.is_floating_point() else v for k, v in state.items()}


def _described(path: Path, metadata: Mapping[str, str]) -> tuple[NetworkConfig, LabelSet]:
    """Configuration and label set from the metadata of a file of this project."""
    cure = "give weights that this version of the program made"
    config = parse_json(metadata["network"], NetworkConfig, f"{path}: its network", cure)
    names = parse_json(metadata.get("labels", ""), list[Name], f"{path}: its labels", cure)
    fault = next((f for f in _faults(asdict(config)) if f), "")
    if len(config.anchors.sizes_px) != ROI_LEVELS + 1:
        fault = f"anchors of {len(config.anchors.sizes_px)} sizes, not {ROI_LEVELS + 1}"
    if fault or not names:
        raise InputError(f"{path}: its network has {fault or 'no labels'}; {cure}")
    return config, label_set(names[1:])


def _faults(values: Mapping[str, Any]) -> Iterator[str]:
    """What no network can have, in words: values that would take all memory or never end."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _faults(value)
        elif isinstance(value, tuple):
            yield from _faults({f"{name}.{k}": item for k, item in enumerate(value)})
            yield f"{len(value)} {name}" if len(value) > MAX_ANCHORS else ""
        elif not isinstance(value, str):
            limit = MAX_LAYERS if name.endswith("_convs") else MAX_WIDTH
            yield "" if 0 <= value <= limit else f"{name} = {value}"


def _published_labels(classes: int) -> LabelSet | None:
    """COCO's label set with this number of classes, background included, if there is one."""
    known = {len(s): s for s in (read_label_set("coco91"), read_label_set("coco"))}
    return known.get(classes)
