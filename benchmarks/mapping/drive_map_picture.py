"""The picture of a map to drive on in docs/mapping.md, from a run with a dense map.

    bmask-slam run SEQUENCE --segmenter none --calibrate off --out RUN && bmask-slam map RUN
    python -m benchmarks.mapping.drive_map_picture RUN --out docs/images/drive_map_kitchen.png

What nav2 gets, a few pixels a cell: obstacles black, free floor white, unknown grey; with the
camera's path and a bar of one metre.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from bmask_slam.dense.drive_map import DriveMapOptions, export_drive_map
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.geometry import transform
from bmask_slam.mapping.products.occupancy_files import GREY
from bmask_slam.run_folder.reader import Run

CELL_PX, BAR_PX = 5, 30
RED, BLACK = (40, 40, 220), (0, 0, 0)


def picture(cells: Image, path_m: Array, resolution_m: float) -> Image:
    """Grey cells (H, W), enlarged, with a path (N, 2) in metres from the lower left corner."""
    path = path_m / resolution_m
    low = np.minimum(np.floor(path.min(axis=0)).astype(int) - 1, 0)
    high = np.maximum(np.ceil(path.max(axis=0)).astype(int) + 1, cells.shape[::-1])
    (right, top), (left, bottom) = high - cells.shape[::-1], -low
    cells = np.pad(cells, ((top, bottom), (left, right)), constant_values=GREY)
    large = np.kron(cells, np.ones((CELL_PX, CELL_PX), np.uint8))
    image = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
    pixels = (path - low) * CELL_PX
    pixels[:, 1] = len(image) - pixels[:, 1]
    line = np.rint(pixels).astype(np.int32)
    cv2.polylines(image, [line], False, RED, 2, cv2.LINE_AA)
    image = cv2.copyMakeBorder(image, 0, BAR_PX, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
    y, length = len(image) - BAR_PX // 2, round(CELL_PX / resolution_m)
    cv2.rectangle(image, (10, y - 3), (10 + length, y + 3), BLACK, -1)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, "1 m", (20 + length, y + 6), font, 0.6, BLACK, 1, cv2.LINE_AA)
    return np.asarray(image)


def main() -> None:
    """Parse, export, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        options = DriveMapOptions()
        made, text = export_drive_map(arguments.run, "nav2", Path(folder) / "map.yaml", options)
        yaml, pgm = made
        said, cells = read_yaml(yaml), np.asarray(cv2.imread(str(pgm), cv2.IMREAD_GRAYSCALE))
    T_map_world = np.array(said["bmask_slam_T_map_world"])
    positions_map = transform(T_map_world, Run(arguments.run).trajectory.positions_world)
    path_m = positions_map[:, :2] - np.array(said["origin"][:2])
    cv2.imwrite(str(arguments.out), picture(cells, path_m, options.resolution_m))
    print(text)


if __name__ == "__main__":
    main()
