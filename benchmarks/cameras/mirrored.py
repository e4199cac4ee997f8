"""More inputs from a recording: mirrored, backward and upside down, or backward and turned.

    python -m benchmarks.cameras.mirrored SEQUENCE OUT CHANGE

Each is a recording that a camera could have made: where it is turned upside down it is also played
backward, so that rows are still read out from the top. Other landmarks are found in it, in another
order. The camera and the truth are changed with it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.yaml_file import format_yaml, parse_yaml, read_yaml
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.sequences.cameras import format_camera, read_camera
from bmask_slam.sequences.lists import image_name, read_lists

JPEG_QUALITY = 97


@dataclass(frozen=True)
class Change:
    """Left and right change places, or above and below; the latter is played backward."""

    left_right: bool
    upside_down: bool

    def image(self, image: Image) -> Image:
        """An image (H, W, ...), flipped."""
        flips = self.upside_down, self.left_right
        rows, columns = (slice(None, None, -1 if flip else 1) for flip in flips)
        return np.ascontiguousarray(image[rows, columns])

    def camera(self, camera: Camera) -> Camera:
        """The camera of the changed images. The bend of depth must be none."""
        assert not any(camera.depth_distortion), "the bend of depth is not changed"
        k1, k2, p1, p2, k3 = camera.distortion
        if self.left_right:
            camera, p2 = replace(camera, cx=camera.width - 1 - camera.cx), -p2
        if self.upside_down:
            camera, p1 = replace(camera, cy=camera.height - 1 - camera.cy), -p1
            camera = replace(camera, depth_time_offset_s=-camera.depth_time_offset_s)
        return replace(camera, distortion=(k1, k2, p1, p2, k3))

    def stamps(self, stamps_s: Array, ends_s: tuple[float, float]) -> Array:
        """Stamps (N,) of a recording between two times, in the same order."""
        return ends_s[0] + ends_s[1] - stamps_s if self.upside_down else stamps_s

    def trajectory(self, trajectory: Trajectory, ends_s: tuple[float, float]) -> Trajectory:
        """The changed camera's: T' = F T F with the flip F of its axes."""
        flip = np.diag([-1.0 if self.left_right else 1.0, -1.0 if self.upside_down else 1.0, 1, 1])
        stamps_s = self.stamps(trajectory.timestamps_s, ends_s)
        order = np.argsort(stamps_s)
        return Trajectory(stamps_s[order], (flip @ trajectory.poses_world_camera @ flip)[order])


CHANGES = {
    "mirrored": Change(left_right=True, upside_down=False),
    "backward": Change(left_right=False, upside_down=True),
    "turned": Change(left_right=True, upside_down=True),
}


def write_changed(source: Path, out: Path, change: Change) -> None:
    """Write the changed recording of a TUM folder with a groundtruth.txt."""
    lists = read_lists(source)
    ends_s = float(lists[0].timestamps_s[0]), float(lists[0].timestamps_s[-1])
    for name, images in zip(("rgb.txt", "depth.txt"), lists, strict=True):
        write_images(images.files, source, out, change.image)
        stamps_s = change.stamps(images.timestamps_s, ends_s)
        rows = sorted(zip(stamps_s.tolist(), images.files, strict=True))
        text = "".join(f"{stamp:.6f} {image_name(file, source)}\n" for stamp, file in rows)
        (out / name).write_text(text, encoding="utf-8")
    camera = change.camera(read_camera(source / "camera.yaml"))
    known = read_yaml(source / "camera.yaml")  # what is not known must not be said
    text = parse_yaml(format_camera(camera), "camera.yaml")
    kept = {key: value for key, value in text.items() if key in {*known, "distortion"}}
    (out / "camera.yaml").write_text(format_yaml(kept), encoding="utf-8")
    truth = change.trajectory(read_tum(source / "groundtruth.txt"), ends_s)
    write_tum(out / "groundtruth.txt", truth)


def write_images(
    files: Sequence[Path], source: Path, out: Path, change: Callable[[Image], Image]
) -> None:
    """Write images of a recording, changed, under their own names below another folder."""

    def write(file: Path) -> None:
        to = out / image_name(file, source)
        to.parent.mkdir(parents=True, exist_ok=True)
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert image is not None, f"{file}: no image"
        is_png = to.suffix.lower() == ".png"
        options = [] if is_png else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        cv2.imwrite(str(to), change(image), options)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, files))


def main() -> None:
    """Write one of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("change", choices=CHANGES)
    given = parser.parse_args()
    write_changed(given.sequence, given.out, CHANGES[given.change])


if __name__ == "__main__":
    main()
