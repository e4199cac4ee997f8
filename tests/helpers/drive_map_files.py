"""Readers of maps to drive on, as nav2's map_server and OctoMap read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from bmask_slam.mapping.products.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


def load_nav2(path: Path) -> OccupancyGrid:
    """As map_server: trinary, row 0 of the image on top, origin the lower left corner."""
    said = YAML(typ="safe").load(path)
    magic, size, top, data = (path.parent / said["image"]).read_bytes().split(b"\n", 3)
    assert (magic, top, said["mode"], said["negate"]) == (b"P5", b"255", "trinary", 0)
    width, height = map(int, size.split())
    image = np.frombuffer(data, np.uint8).reshape(height, width)[::-1]
    share = (255 - image.astype(float)) / 255
    cells = np.full(image.shape, UNKNOWN, np.int8)
    cells[share > said["occupied_thresh"]] = OCCUPIED
    cells[share < said["free_thresh"]] = FREE
    x, y, yaw = said["origin"]
    assert yaw == 0
    return OccupancyGrid(said["resolution"], np.array([x, y]), cells)


def load_octomap(path: Path) -> tuple[int, float, dict[tuple[int, int, int], bool]]:
    """Size, resolution and the voxels of a binary tree, by a recursion over its nodes."""
    head, data = path.read_bytes().split(b"\ndata\n", 1)
    lines = head.decode().splitlines()
    assert lines[0] == "# Octomap OcTree binary file"
    said = dict(line.split(maxsplit=1) for line in lines if not line.startswith("#"))
    voxels: dict[tuple[int, int, int], bool] = {}
    at, nodes = 0, 1

    def read(depth: int, corner: np.ndarray) -> None:
        nonlocal at, nodes
        bits = data[at] | data[at + 1] << 8
        at += 2
        edge = 1 << (16 - depth - 1)
        for child in range(8):
            kind = bits >> 2 * child & 3
            begin = corner + edge * np.array([child & 1, child >> 1 & 1, child >> 2 & 1])
            nodes += kind > 0
            if kind == 3:
                read(depth + 1, begin)
            elif kind:
                for cell in np.ndindex(edge, edge, edge):
                    voxels[tuple((begin + cell - (1 << 15)).tolist())] = kind == 2

    read(0, np.zeros(3, int))
    assert at == len(data)
    assert nodes == int(said["size"])
    return nodes, float(said["res"]), voxels
