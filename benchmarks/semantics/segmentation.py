"""What the segmentation network reaches: on photographs, in time and memory.

    python -m benchmarks.semantics.segmentation photographs [--weights F]
    python -m benchmarks.semantics.segmentation cost

Photographs: those of the COCO excerpt that neither the detector nor the heads have seen
(photographs.py). "IoU corr." is of predicted and true IoU of the masks in boxes that overlap an
object of their class by half; "where good" of those masks alone that overlap it by half themselves.
"False" are boxes a photograph, at the default score, that overlap no object of their class by half,
or one that a better box has found. Cost: each in a process of its own. The light network on a
photograph; the others on a 640x480 image with two threads, random weights that take every proposal
for an object, so that there are as many instances as the network gives at most.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.semantics.photographs import IMAGES, held_out
from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.runtime.memory import peak_rss_mb
from bmask_slam.semantics.instances.coco_files import CocoImage
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.segmenters.evaluation import SegmentationResult, evaluate_segmenter
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

SIZE = (480, 640)
REPEATS = 15
MATCH_IOU = 0.5
FEW = 20


class Watched:
    """A segmenter, and the numbers of true and false boxes at the default score."""

    def __init__(self, segmenter: Segmenter, images: Sequence[CocoImage]) -> None:
        self.labels = segmenter.labels
        self._segmenter = segmenter
        self._images = {image.file_name: image for image in images}
        self.right = self.false = 0

    def segment(self, image: Image, name: str) -> list[Instance]:
        """The instances of the segmenter."""
        found = self._segmenter.segment(image, name)
        sure = [i for i in found if i.class_score >= SegmenterOptions.min_score]
        right = _right(sorted(sure, key=lambda i: -i.class_score), self._images[name])
        self.right += right
        self.false += len(sure) - right
        return found


def _right(found: Sequence[Instance], image: CocoImage) -> int:
    """How many boxes, best first, overlap an object of their class that no better one overlaps."""
    free = list(image.objects)
    right = 0
    for i in found:
        overlaps = [_iou(i.box, o.box) if o.label == i.label else 0.0 for o in free]
        best = int(np.argmax(overlaps)) if overlaps else -1
        if best >= 0 and overlaps[best] >= MATCH_IOU:
            right += 1
            if not free[best].crowd:
                del free[best]
    return right


def _iou(a: Sequence[float] | Array | Floats, b: Sequence[float] | Array) -> float:
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    both = float(np.prod(np.clip(high - low, 0, None)))
    return both / (_area(a) + _area(b) - both)


def _area(box: Sequence[float] | Array | Floats) -> float:
    return float((box[2] - box[0]) * (box[3] - box[1]))


def photographs(weights: Path | None, plot: Path | None) -> None:
    """COCO's figures on the photographs held out."""
    truth = held_out()
    given = None if weights is None else str(weights)
    options = SegmenterOptions("light", weights=given, min_score=0.0)
    watched = Watched(make_segmenter(options, IMAGES), truth.images)
    result: SegmentationResult = evaluate_segmenter(watched, truth, IMAGES, lambda *_: None)
    boxes, masks, rescored = result.curves
    print(
        f"{'images':>6} {'box AP':>7} {'mask AP':>9} {'x MaskIoU':>11} {'gain':>6} {'AP50':>7} "
        f"{'IoU corr.':>9} {'where good':>10} {'right':>6} {'false':>6}"
    )
    print(
        f"{result.images:6d} {boxes.ap:7.3f} {masks.ap:9.3f} {rescored.ap:11.3f} "
        f"{100 * (rescored.ap - masks.ap):+6.2f} {masks.ap50:7.3f} {result.iou_correlation:9.3f} "
        f"{result.iou_correlation_of_good:10.3f} {watched.right / result.images:6.2f} "
        f"{watched.false / result.images:6.2f}"
    )
    rows = reliability(result.iou_pairs)
    print(f"\n{'predicted IoU':>13} {'true':>6} {'masks':>6}")
    for predicted, true, count in rows.tolist():
        print(f"{predicted:13.2f} {true:6.2f} {count:6.0f}")
    if plot:
        draw_reliability(rows, plot)


def reliability(pairs: Array) -> Array:
    """Rows (B, 3) of tenths of predicted IoU: mean predicted and true IoU, number of masks."""
    tenth = np.clip((10 * pairs[:, 0]).astype(int), 0, 9)
    bins = [pairs[tenth == k] for k in range(10)]
    return np.array([(*b.mean(axis=0), len(b)) for b in bins if len(b) >= FEW]).reshape(-1, 3)


def draw_reliability(rows: Array, path: Path) -> None:
    """True over predicted mask IoU; the areas of dots are the numbers of masks."""
    figure = Figure(figsize=(4, 4))
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", linewidth=1)
    axes.scatter(rows[:, 0], rows[:, 1], 400 * rows[:, 2] / rows[:, 2].max())
    axes.set(xlabel="predicted mask IoU", ylabel="true mask IoU (mean)", xlim=(0, 1), ylim=(0, 1))
    figure.savefig(path, dpi=100, bbox_inches="tight")


def cost() -> None:
    """Median time and peak memory of each network, each in a process of its own."""
    print(f"{'':18} {'ms an image':>12} {'of a core':>12} {'peak memory':>12}")
    for name in ("light", "resnet50", "resnet50_v2"):
        module = ["-m", "benchmarks.semantics.segmentation"]
        command = [sys.executable, *module, "one", "--network", name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(done.stdout.rstrip(), flush=True)


def one(name: str) -> None:
    """Time and memory of one network in this process."""
    run = _light() if name == "light" else _random(name)
    times = []
    for _ in range(REPEATS + 2):
        before = time.perf_counter(), time.process_time()
        run()
        times.append((time.perf_counter() - before[0], time.process_time() - before[1]))
    wall_ms, cpu_ms = 1000 * np.median(times[2:], axis=0)
    print(f"{name:18} {wall_ms:12.0f} {cpu_ms:12.0f} {peak_rss_mb():9.0f} MB")


def _light() -> Callable[[], object]:
    """The light network at the default score on a photograph in which it finds five objects."""
    segmenter = make_segmenter(SegmenterOptions("light"), Path())
    for path in sorted(IMAGES.iterdir()):
        image = read_colour(path)
        if image.shape[:2] == SIZE and len(segmenter.segment(image, path.name)) == 5:
            break
    return lambda: segmenter.segment(image, path.name)


def _random(name: str) -> Callable[[], object]:
    import torch  # noqa: PLC0415

    from bmask_slam.semantics.network import config  # noqa: PLC0415
    from bmask_slam.semantics.network.model import MaskRCNN  # noqa: PLC0415

    torch.set_num_threads(2)
    torch.manual_seed(0)
    model = MaskRCNN(getattr(config, name.upper())).eval()
    model.roi_heads.box_predictor.cls_score.bias.data[1] += 3
    image = torch.rand(3, *SIZE)
    return torch.inference_mode()(lambda: model([image]))


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("photographs", "cost", "one"))
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--plot", type=Path, help="true over predicted IoU, of the photographs")
    parser.add_argument("--network", default="light")
    arguments = parser.parse_args()
    if arguments.part == "photographs":
        photographs(arguments.weights, arguments.plot)
    elif arguments.part == "cost":
        cost()
    else:
        one(arguments.network)


if __name__ == "__main__":
    main()
