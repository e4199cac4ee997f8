"""Train the light network's weights that come with the project (data/weights/light.safetensors).

    python benchmarks/train_light.py --out runs/light [--steps 2400] [--seed 0]
    python benchmarks/train_light.py --out runs/bench/light-1 --seed 1 --photographs --steps 1500

Learns from the COCO excerpt, without the share that is held out for testing, and from rooms that
it renders to ``--rooms`` first. Goes on from its last checkpoint if it was stopped. --weights
starts from a network that was trained before. --photographs: masks alone, from the excerpt alone,
for use with another detector's boxes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from semantics.training.run import Source, TrainingRun, run_training  # noqa: E402
from slam.cli import main as slam  # noqa: E402
from slam.progress import console_log, counting_bar  # noqa: E402

DATA = ROOT.parent / "shared" / "data"
HELD_OUT = 0.28
ROOMS = range(32)
VIEWS = ("--fps", "0.5", "--people", "2", "--quiet")
COCO_TIMES = 2
"""The photographs are seen so many times as often, which makes them half of all images."""


def rooms(folder: Path) -> list[Source]:
    """Sixteen views of each room, rendered where they are not there yet."""
    for seed in ROOMS:
        if not (folder / str(seed) / "annotations.json").is_file():
            slam(["render", "room", "--seed", str(seed), *VIEWS, "--out", str(folder / str(seed))])
    return [Source(folder / str(k) / "annotations.json", folder / str(k)) for k in ROOMS]


def main() -> None:
    """Render, train."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rooms", type=Path, default=ROOT / "runs" / "bench" / "rooms")
    parser.add_argument("--weights", help="to start from, instead of ImageNet's MobileNetV2")
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0, help="of split, batches and augmentation")
    parser.add_argument("--photographs", action="store_true")
    arguments = parser.parse_args()
    excerpt = DATA / "coco_excerpt"
    coco = Source(excerpt / "instances.json", excerpt / "images", HELD_OUT)
    data = [coco] if arguments.photographs else [coco] * COCO_TIMES + rooms(arguments.rooms)
    settings = {
        "steps": arguments.steps,
        "rate": arguments.rate,
        "seed": arguments.seed,
        "batch": 4,
        "rois": "objects",
        "only": "masks" if arguments.photographs else "",
    }
    run = TrainingRun(
        tuple(data),
        arguments.out,
        arguments.weights,
        None if arguments.weights else DATA / "weights" / "mobilenet_v2_imagenet_folded.pth",
        "coco" if arguments.photographs else "coco_paper",
        ("backbone.body",),
        settings,
    )
    with console_log(), counting_bar(False) as progress:
        print(run_training(run, progress))


if __name__ == "__main__":
    main()
