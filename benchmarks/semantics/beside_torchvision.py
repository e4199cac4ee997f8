"""Our Mask R-CNN compared with torchvision's: the same weights, image and torch, alternately.

    python -m benchmarks.semantics.beside_torchvision [--environment runs/bench/torchvision]

torchvision does not go with the project's torch for CPUs, so both networks run in an environment of
their own, made where it is missing (a download of 5.4 GB). A 640x480 image, enlarged by both as
torchvision does, two threads; random weights that take every proposal for an object, so that both
find as many instances as they give at most. Calls alternate; memory is that of processes of their
own, where both networks are made and one runs. "apart" is the largest difference of boxes (px),
scores and masks.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.paths import ROOT
from bmask_slam.runtime.memory import peak_rss_mb

MODULE = "benchmarks.semantics.beside_torchvision"
PACKAGES = ("torch==2.15.0", "torchvision==0.29.2", "numpy")
NAMES = ("resnet50", "resnet50_v2")
CLASSES = 91
SIZE = (480, 640)
REPEATS = 9
Detected = dict[str, Any]
"""Boxes (px), scores and masks, as tensors."""


def environment(folder: Path) -> Path:
    """The environment's Python; the environment is made where it is missing."""
    python = folder.absolute() / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *PACKAGES], check=True)
    own = ["--no-deps", "--editable", str(ROOT)]
    subprocess.run([python, "-m", "pip", "install", "-q", *own], check=True)
    return python


def make(name: str) -> dict[str, Callable[[], Detected]]:
    """Both networks with the same weights, as functions that detect and paste the masks."""
    import torch  # noqa: PLC0415

    from bmask_slam.semantics.network import config  # noqa: PLC0415
    from bmask_slam.semantics.network.model import MaskRCNN  # noqa: PLC0415
    from bmask_slam.semantics.segmenters.network_segmenter import paste  # noqa: PLC0415

    torch.set_num_threads(2)
    torch.manual_seed(0)
    network = of_torchvision(name).eval()
    network.roi_heads.box_predictor.cls_score.bias.data[1] += 3
    same = MaskRCNN(getattr(config, name.upper())).eval()
    same.load_state_dict(network.state_dict())
    image = torch.rand(3, *SIZE)

    def ours() -> Detected:
        found = same([image])[0]
        masks = paste(found.masks, found.mask_boxes, SIZE)
        return {"boxes": found.found.boxes, "scores": found.found.scores, "masks": masks}

    def theirs() -> Detected:
        found = network([image])[0]
        return {"boxes": found["boxes"], "scores": found["scores"], "masks": found["masks"][:, 0]}

    return {"ours": ours, "torchvision": theirs}


def of_torchvision(name: str) -> Any:
    """Its network with random weights and, as when its published weights are loaded, its norms."""
    from torchvision.models import detection  # noqa: PLC0415
    from torchvision.models.detection.backbone_utils import resnet_fpn_backbone  # noqa: PLC0415
    from torchvision.ops.misc import FrozenBatchNorm2d  # noqa: PLC0415

    if name == "resnet50_v2":
        return detection.maskrcnn_resnet50_fpn_v2(weights=None, weights_backbone=None)
    body = resnet_fpn_backbone(backbone_name=name, weights=None, norm_layer=FrozenBatchNorm2d)
    return detection.MaskRCNN(body, CLASSES)


def compare(name: str) -> None:
    """Alternate between both; a row for each, and the ratio."""
    import numpy as np  # noqa: PLC0415
    import torch  # noqa: PLC0415

    networks = make(name)
    times_ms: dict[str, list[float]] = {owner: [] for owner in networks}
    with torch.inference_mode():
        found = {owner: detect() for owner, detect in networks.items()}
        for _ in range(REPEATS):
            for owner, detect in networks.items():
                begin_s = time.perf_counter()
                detect()
                times_ms[owner].append(1e3 * (time.perf_counter() - begin_s))
    ratio = np.median(np.divide(times_ms["ours"], times_ms["torchvision"]))
    for owner, times in times_ms.items():
        command = [sys.executable, "-m", MODULE, "--inside", f"{name} {owner}"]
        peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        print(f"{name:12} {owner:12} {np.median(times):6.0f} ms {peak:>6} MB", flush=True)
    print(f"{name:12} ratio of times {ratio:.2f}; apart: {difference(found)}", flush=True)


def difference(found: dict[str, Detected]) -> str:
    """How far each detection is from the nearest one, in each kind of value.

    Not by rank: scores that differ by rounding alone change places.
    """
    ours, theirs = found.values()
    counts = {owner: len(values["scores"]) for owner, values in found.items()}
    if len(set(counts.values())) > 1:
        return f"instances {counts}"
    nearest = (ours["boxes"][:, None] - theirs["boxes"]).abs().amax(-1).argmin(1)
    apart = {key: float((ours[key] - theirs[key][nearest]).abs().max()) for key in ours}
    text = ", ".join(f"{key} {value:.0e}" for key, value in apart.items())
    return f"{text} of {counts['ours']} instances"


def peak_mb(name: str, owner: str) -> None:
    """Peak memory of this process in MB (1e6 bytes), in which one of them runs twice."""
    import torch  # noqa: PLC0415

    detect = make(name)[owner]
    with torch.inference_mode():
        detect()
        detect()
    print(f"{peak_rss_mb():.0f}")


def main() -> None:
    """Compare, in the other environment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--environment", type=Path, default=Path("runs/bench/torchvision"))
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside is None:
        python = environment(arguments.environment)
        for name in NAMES:
            subprocess.run([python, "-m", MODULE, "--inside", name], cwd=ROOT, check=True)
    elif " " in arguments.inside:
        peak_mb(*arguments.inside.split())
    else:
        compare(arguments.inside)


if __name__ == "__main__":
    main()
