"""Right images of a rectified stereo pair beside a sequence: right.txt, with camera.yaml's bf."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.images import read_rgb
from bmask_slam.sequences.lists import read_list
from bmask_slam.sequences.sequence import Sequence

logger = logging.getLogger(__name__)

RIGHT_LIST = "right.txt"


@dataclass(frozen=True, eq=False)
class RightImages:
    """Rectified right images: a point at u in the left one is at u - bf / z, in the same row.

    Attributes:
        path: the list.
        files: right images by the index of the frame whose colour image is the left one.
        camera: camera of both images, with the bf of the pair.
    """

    path: Path
    files: dict[int, Path]
    camera: Camera

    def load(self, index: int) -> Image:
        """The right image (H, W, 3) of a frame, red first.

        Raises:
            InputError: none is listed, it cannot be read, or it is of another size than the left.
        """
        if index not in self.files:
            raise InputError(f"{self.path}: no right image near frame {index}; list it")
        return read_rgb(self.files[index], self.camera)


def read_right_images(sequence: Sequence, camera: Camera) -> RightImages:
    """The right images of a sequence, paired with its colour images by stamp as depth is.

    The baseline is taken from ``stereo_bf`` in the sequence's own camera.yaml, where it is
    required: a run's camera always has a value, but usually the default of the noise model.

    Raises:
        InputError: no right.txt or a broken one, no stereo_bf, a camera with distortion, or no two
            stamps within the limit.
    """
    path, limit_s = sequence.folder / RIGHT_LIST, sequence.config.max_time_difference_s
    if not path.is_file():
        raise InputError(
            f"{path}: no such list; stereo needs rectified right images in lines 'timestamp file'; "
            "else choose --depth-source motion or sensor"
        )
    if any(camera.distortion):
        raise InputError(
            f"{path}: the run's camera has distortion {list(camera.distortion)}, but rectified "
            "images have none; run the sequence with a camera.yaml whose distortion is 0"
        )
    camera = replace(camera, stereo_bf_px_m=_stereo_bf(sequence.folder / "camera.yaml", camera))
    right = read_list(path)
    i, j = associate_stamps(sequence.timestamps_s, right.timestamps_s, limit_s)
    if not len(i):
        raise InputError(
            f"{path}: no right image within {limit_s:g} s of a colour image (colour begins at "
            f"{sequence.timestamps_s[0]:.6f} s, right at {right.timestamps_s[0]:.6f} s); "
            "bring both lists to the same clock"
        )
    logger.info("%s: %d pairs, baseline %.4f m", path, len(i), camera.baseline_m)
    files = {int(frame): right.files[k] for frame, k in zip(i, j, strict=True)}
    return RightImages(path, files, camera)


def _stereo_bf(path: Path, used: Camera) -> float:
    """The stereo_bf that is written in a camera.yaml, of images at the size in which they are used.

    Raises:
        InputError: it has none.
    """
    cure = "stereo needs its stereo_bf, fx times the pair's baseline in metres"
    if not path.is_file():
        raise InputError(f"{path}: no such file; {cure}")
    camera = read_camera(path)
    if "stereo_bf" not in read_yaml(path):
        raise InputError(f"{path}: stereo_bf is missing; {cure}")
    return camera.stereo_bf_px_m / used.reduced_by
