"""Files of a rendered sequence, in TUM layout."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import whole_folder, writing
from bmask_slam.graph.geometry import quaternion_from_rotation
from bmask_slam.semantics.instances.image_files import write_image

_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside ``out``, renamed to ``out`` when the block ends without an error.

    Raises:
        InputError: ``out`` is a file, holds something, has no name, or cannot be written.
    """
    if not out.name:  # of the working directory, which would be another one afterwards
        raise InputError(f"{out}: has no name; choose a new folder as --out")
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: the folder is not empty; choose another --out or delete it")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, not a folder; choose another --out")
    with ExitStack() as stack:
        with writing(out, "choose another --out"):
            out.parent.mkdir(parents=True, exist_ok=True)
            temporary = stack.enter_context(whole_folder(out))
        yield temporary


def write_png(path: Path, picture: NDArray[Any]) -> None:
    """Write 8-bit RGB (H, W, 3) or 16-bit grey (H, W); missing folders are made."""
    path.parent.mkdir(exist_ok=True)
    write_image(path, picture, _FAST_PNG)


def stored_depth(depth_m: NDArray[np.floating], scale: float) -> NDArray[np.uint16]:
    """Depth as the TUM benchmark stores it: round(scale * metres), 0 where missing."""
    values = np.round(np.nan_to_num(depth_m, nan=0.0) * scale)
    return np.where(values > 65535, 0, values).astype(np.uint16)


def write_lists(folder: Path, stamps: list[str], poses: Array) -> None:
    """Write rgb.txt, depth.txt and groundtruth.txt for T_world_camera (N, 4, 4)."""
    for kind in ("rgb", "depth"):
        lines = [f"# {kind} images, rendered", "# timestamp filename"]
        lines += [f"{stamp} {kind}/{stamp}.png" for stamp in stamps]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    lines = ["# ground truth of the camera, exact: T_world_camera, world z up, metres",
             "# timestamp tx ty tz qx qy qz qw"]  # fmt: skip
    quaternions = quaternion_from_rotation(poses[:, :3, :3])
    for stamp, t, q in zip(stamps, poses[:, :3, 3], quaternions, strict=True):
        lines.append(" ".join([stamp, *(f"{x:.9f}" for x in (*t, *q))]))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write compact JSON with sorted keys, so that equal content gives equal bytes."""
    path.write_text(json.dumps(content, sort_keys=True, separators=(",", ":")) + "\n")
