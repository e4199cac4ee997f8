"""Pictures of dense maps for the documentation.

    python -m benchmarks.mapping.dense_pictures ROOT docs/images

ROOT/kitchen-run is a run of the red kitchen and ROOT/office-run one of the rendered office, both
mapped by ``bmask-slam map --mesh --plan``, the kitchen with the light network's masks in the boxes
of YOLOX-Nano (``--proposals``).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import load_keyframe
from bmask_slam.dense.saved_map import open_run
from bmask_slam.graph.arrays import Image

MAX_WIDTH_PX = 1400
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 85]


def side_by_side(files: list[Path]) -> Image:
    """Pictures of about the same height in a row, on white."""
    images = [np.asarray(cv2.imread(str(f))) for f in files]
    height = max(len(i) for i in images)
    padded = [
        cv2.copyMakeBorder(i, 0, height - len(i), 0, 10, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        for i in images
    ]
    row = np.hstack(padded)
    scale = min(1.0, MAX_WIDTH_PX / row.shape[1])
    return np.asarray(cv2.resize(row, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def coverage(run_folder: Path) -> tuple[float, float]:
    """Share of the keyframes' pixels with depth, of the sensor and fused."""
    run, folder = open_run(run_folder), DenseFolder.open(run_folder)
    done = [k for k in run.keyframes if folder.is_done(k.id)]
    before = [np.isfinite(load_keyframe(run, k)[0].depth_m).mean() for k in done]
    after = [folder.fused(k.id).known.float().mean().item() for k in done]
    return float(np.mean(before)), float(np.mean(after))


def main() -> None:
    """Parse, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    pictures = {
        "dense_kitchen.jpg": ("kitchen", ("view_overview.png", "view_overview_semantic.png")),
        "dense_kitchen_mesh.jpg": ("kitchen", ("view_mesh.png", "view_middle.png")),
        "dense_kitchen_plan.png": ("kitchen", ("plan.png",)),
        "dense_office.jpg": ("office", ("view_middle.png", "view_middle_semantic.png")),
    }
    for name, (room, files) in pictures.items():
        dense = args.root / f"{room}-run" / "dense"
        picture = side_by_side([dense / f for f in files])
        cv2.imwrite(str(args.out / name), picture, JPEG if name.endswith("jpg") else [])
    for room in ("kitchen", "office"):
        folder = args.root / f"{room}-run"
        counts = json.loads((folder / "dense" / "dense.json").read_text())
        before, after = coverage(folder)
        shares = sorted(counts["label_shares"].items(), key=lambda item: -item[1])
        print(
            f"{room}: {counts['keyframes_fused'] + counts['keyframes_reused']} keyframes, ", end=""
        )
        print(f"{counts['points']} points; depth covers {before:.3f} of the images, ", end="")
        print(f"fused {after:.3f}")
        print("  " + ", ".join(f"{label} {100 * share:.1f} %" for label, share in shares[:8]))


if __name__ == "__main__":
    main()
