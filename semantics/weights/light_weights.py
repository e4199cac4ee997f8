"""Weight files of the light network: YOLOX-Nano with this project's mask and MaskIoU heads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import safetensors
import torch
from safetensors.torch import save_file

from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.labels import LabelSet, read_label_set
from bmask_slam.semantics.network.yolox.mask_scoring import MaskScoringYolox
from bmask_slam.semantics.network.yolox.network import YoloxNano
from bmask_slam.semantics.weights.checkpoints import check_state, read_state, single_precision

KIND = "yolox_nano with mask scoring"
"""In the file's metadata."""
SHIPPED = ("weights", "light.safetensors")
"""The weights that come with the project, in its data folder."""


@dataclass(frozen=True)
class LightNetwork:
    """The light network with its weights; ``labels`` is the set its classes are looked up in."""

    model: MaskScoringYolox
    labels: LabelSet


def is_light(path: Path) -> bool:
    """Whether a file holds weights of the light network; False for one that cannot be read."""
    if path.suffix != ".safetensors" or not path.is_file():
        return False
    try:
        with safetensors.safe_open(path, "pt") as file:
            return bool((file.metadata() or {}).get("network") == KIND)
    except (safetensors.SafetensorError, OSError):
        return False


def load_light(path: Path, labels: LabelSet | None = None) -> LightNetwork:
    """Load the network of a file, in evaluation mode; ``labels`` are COCO's by default.

    Raises:
        InputError: an unreadable file, or weights of another network.
    """
    state, _ = read_state(path)
    with torch.device("meta"):
        model = MaskScoringYolox()
    check_state(path, state, model, "the light network")
    model.load_state_dict(single_precision(state), assign=True)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return LightNetwork(model.eval(), labels or read_label_set("coco"))


def new_light(detector: YoloxNano | None = None) -> LightNetwork:
    """Random heads on a detector, by default that of the weights that come with the project."""
    model = MaskScoringYolox()
    known = detector or load_light(data_path(*SHIPPED)).model.detector
    model.detector.load_state_dict(known.state_dict())
    return LightNetwork(model, read_label_set("coco"))


def save_light(network: LightNetwork, path: Path) -> None:
    """Write the weights in single precision, which the detector was published in."""
    state = {k: v.detach().cpu().contiguous() for k, v in network.model.state_dict().items()}
    with whole_file(path) as temporary:
        save_file(state, temporary, {"network": KIND})
