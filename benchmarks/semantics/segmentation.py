"""What the segmentation network reaches: on photographs, in rendered rooms, in time and memory.

    python -m benchmarks.semantics.segmentation photographs --weights runs/bench/light-{}
    python -m benchmarks.semantics.segmentation rooms --rooms runs/bench/rooms
    python -m benchmarks.semantics.segmentation cost

Photographs: the part of ../shared/data/coco_excerpt that no training saw (`--held-out 0.28 --seed
0`), boxes from YOLOX-Nano at 416 and at 640 pixels; by the project's own weights, and by three
networks that went on from them on the excerpt's photographs alone, first the masks, then the
MaskIoU head in the detector's boxes ({} in ``--weights`` stands for the seed). Rooms: seeds that no
training saw, the network's own boxes. Cost: a 640x480 image in a process of its own, two threads,
random weights that take every proposal for an object, so that there are as many instances as the
network gives at most. "IoU corr." is of predicted and true IoU of the masks in boxes that overlap
an object of their class by half; "where good" of those masks alone that overlap it by half
themselves.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.paths import ROOT, SHARED
from bmask_slam.semantics.instances.coco_files import CocoFile, read_coco
from bmask_slam.semantics.segmenters.evaluation import SegmentationResult, evaluate_segmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.semantics.training.dataset import split

DATA = SHARED
HELD_OUT = 0.28
SPLIT_SEED = 0
SEEDS = (0, 1, 2)
ROOMS = (900, 901, 902, 903, 904)
SIZE = (480, 640)
REPEATS = 15


def evaluated(options: SegmenterOptions, truth: CocoFile, images: Path) -> SegmentationResult:
    """The figures of a segmenter that drops nothing for its score."""
    return evaluate_segmenter(make_segmenter(options, images), truth, images, lambda *_: None)


def line(name: str, result: SegmentationResult) -> str:
    """A row of the table."""
    boxes, masks, rescored = result.curves
    return (
        f"{name:12} {result.images:6d} {boxes.ap:7.3f} {masks.ap:9.3f} "
        f"{rescored.ap:11.3f} {100 * (rescored.ap - masks.ap):+6.2f} {masks.ap50:7.3f} "
        f"{result.iou_correlation:9.3f} {result.iou_correlation_of_good:10.3f}"
    )


HEADER = (
    f"{'':12} {'images':>6} {'box AP':>7} {'mask AP':>9} {'x MaskIoU':>11} {'gain':>6} "
    f"{'AP50':>7} {'IoU corr.':>9} {'where good':>10}"
)


def photographs(weights: str) -> None:
    """COCO's figures on the photographs held out: the project's network, and one a seed."""
    excerpt = DATA / "coco_excerpt"
    proposals = DATA / "weights" / "yolox_nano.onnx"
    _, truth = split(read_coco(excerpt / "instances.json"), HELD_OUT, SPLIT_SEED)
    print(HEADER)
    gains, aps = [], []
    for seed in (None, *SEEDS):
        folder = Path(weights.format(seed))
        file = None if seed is None else folder / "weights.safetensors"
        if file is not None and not file.is_file():
            print(f"seed {seed}: {folder} is not trained; see benchmarks/semantics/train_light.py")
            continue
        given = None if file is None else str(file)
        options = SegmenterOptions("light", weights=given, proposals=proposals, min_score=0.0)
        result = evaluated(options, truth, excerpt / "images")
        print(line("shipped" if seed is None else f"seed {seed}", result), flush=True)
        if seed is not None:
            gains.append(100 * (result.curves[2].ap - result.curves[1].ap))
            aps.append(result.curves[2].ap)
    if aps:
        print(f"mean of seeds: x MaskIoU {np.mean(aps):.3f}, gain {np.mean(gains):+.2f} points")


def rooms(folder: Path) -> None:
    """The same in rooms that no training saw, by the network alone."""
    print(HEADER)
    ap50s = []
    for seed in ROOMS:
        room = folder / str(seed)
        truth = read_coco(room / "annotations.json")
        result = evaluated(SegmenterOptions("light", min_score=0.0), truth, room)
        print(line(f"room {seed}", result), flush=True)
        ap50s.append(result.curves[1].ap50)
    print(f"mean of rooms: AP50 {np.mean(ap50s):.3f}")


def cost() -> None:
    """Median time and peak memory of each network, each in a process of its own."""
    print(f"{'':18} {'ms an image':>12} {'peak memory':>12}")
    for name in ("light", "resnet50", "resnet50_v2"):
        module = ["-m", "benchmarks.semantics.segmentation"]
        command = [sys.executable, *module, "one", "--network", name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(done.stdout.rstrip(), flush=True)


def one(name: str) -> None:
    """Time and memory of one network in this process."""
    import torch  # noqa: PLC0415

    from bmask_slam.semantics.network import config  # noqa: PLC0415
    from bmask_slam.semantics.network.model import MaskRCNN  # noqa: PLC0415

    torch.set_num_threads(2)
    torch.manual_seed(0)
    model = MaskRCNN(getattr(config, name.upper())).eval()
    model.roi_heads.box_predictor.cls_score.bias.data[1] += 3
    image = torch.rand(3, *SIZE)
    times_s = []
    with torch.inference_mode():
        for _ in range(REPEATS + 2):
            begin_s = time.perf_counter()
            model([image])
            times_s.append(time.perf_counter() - begin_s)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{name:18} {1000 * np.median(times_s[2:]):12.0f} {peak_mb:9.0f} MB")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("photographs", "rooms", "cost", "one"))
    parser.add_argument("--weights", default="runs/bench/light-{}")
    parser.add_argument("--rooms", type=Path, default=ROOT / "runs" / "bench" / "rooms")
    parser.add_argument("--network", default="light")
    arguments = parser.parse_args()
    if arguments.part == "photographs":
        photographs(arguments.weights)
    elif arguments.part == "rooms":
        rooms(arguments.rooms)
    elif arguments.part == "cost":
        cost()
    else:
        one(arguments.network)


if __name__ == "__main__":
    main()
