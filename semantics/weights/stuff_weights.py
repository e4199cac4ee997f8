"""Weight files of the head that gives every pixel a class."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save_file

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.labels import LabelSet, label_set
from bmask_slam.semantics.network.yolox.stuff import StuffHead
from bmask_slam.semantics.weights.checkpoints import check_state, read_state, single_precision

KIND = "stuff head for yolox_nano"
"""The first line of the file's metadata, which is one text, so that the same weights give the same
bytes; the classes follow, one a line."""
SHIPPED = ("weights", "stuff.safetensors")
"""The weights that come with the project, in its data folder."""


@dataclass(frozen=True)
class StuffNetwork:
    """The head with its weights. Label k of ``labels`` is its output k - 1."""

    head: StuffHead
    labels: LabelSet


def load_stuff(path: Path) -> StuffNetwork:
    """Load the head of a file, in evaluation mode.

    Raises:
        InputError: an unreadable file, or weights of another network.
    """
    state, about = read_state(path)
    kind, *classes = about.get("network", "").split("\n")
    if kind != KIND or not classes:
        raise InputError(f"{path}: not weights of the head for stuff; give a file that it was in")
    labels = label_set(classes)
    with torch.device("meta"):
        head = StuffHead(len(labels) - 1)
    check_state(path, state, head, "the head for stuff")
    head.load_state_dict(single_precision(state), assign=True)
    head.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return StuffNetwork(head.eval(), labels)


def save_stuff(network: StuffNetwork, path: Path) -> None:
    """Write the weights in half precision."""
    state = {k: v.detach().half().contiguous() for k, v in network.head.state_dict().items()}
    about = {"network": "\n".join((KIND, *network.labels.names[1:]))}
    with whole_file(path) as temporary:
        save_file(state, temporary, about)
