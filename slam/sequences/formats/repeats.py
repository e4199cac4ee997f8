"""Images that are the one before under another stamp: a driver or recorder that repeats them.

No sensor gives the same bytes twice. A recorder that asks for the latest image more often than
there is one, or a driver that hangs, writes old images with new stamps: then the camera seems to
stand and jump. Such images are left out. Only a simulated camera at rest really gives the same
image for long, and moves on from it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from filecmp import cmp
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.arrays import Floats, Image, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.lists import ImageList
from bmask_slam.sequences.recording import Recording

MIN_SHARE, MIN_TIMES = 0.2, 5
"""A recorder repeats images if so large a share of a list repeats the one before, and so many
times; single ones stay, and are counted."""
LONG = 6
"""So many repetitions in a row are a hung driver or a simulated camera at rest."""
JUMP = 2.0
"""A driver hung where its next image differs so much more than that one from the next."""
SMALL, BLUR_PX, LEAST_CHANGE = (160, 120), 1.0, 0.3
"""How images are compared: size, blur, and the least change in grey levels."""


def without_repeats(recording: Recording) -> Recording:
    """The recording without images that repeat the one before, where these are many or a hang."""
    if recording.exists is not Path.is_file:  # not a file for each image
        return recording
    rgb = _kept("colour", recording.rgb, recording.colour)
    return replace(
        recording, rgb=rgb, depth=_kept("depth", recording.depth, recording.stored_depth)
    )


def _kept(kind: str, images: ImageList, decode: Callable[[Path], Image]) -> ImageList:
    """The images of a list that are their own, with a warning if others were left out."""
    same = _repeats(images.files)
    single, out = np.zeros((2, len(same)), bool)
    times, texts = 0, list[str]()
    for start, stop in _stretches(same):
        if stop - start < LONG:
            single[start:stop] = True
            times += 1
        elif _moved_on(images.files, same, stop, decode):
            out[start:stop] = True
            at_s = images.timestamps_s[start - 1]
            texts.append(
                f"{stop - start} {kind} images behind {at_s:.6f} s repeat that one, and the view "
                "jumps then: the driver hung; they are left out"
            )
    if times >= MIN_TIMES and np.count_nonzero(single) > MIN_SHARE * len(same):
        out |= single
        texts.append(
            f"{np.count_nonzero(single)} of {len(same)} {kind} images repeat the one before with "
            "another stamp; they are left out: record each image once, with the camera's stamp"
        )
    if not texts:
        return replace(images, copies=int(np.count_nonzero(same)))
    files = tuple(file for file, is_out in zip(images.files, out, strict=True) if not is_out)
    warnings = (*images.warnings, *texts)
    return replace(images, timestamps_s=images.timestamps_s[~out], files=files, warnings=warnings)


def _repeats(files: tuple[Path, ...]) -> Mask:
    """(N,) whether each file has the bytes of the one before. Files that are not there have not."""
    same, before = np.zeros(len(files), bool), -1
    for k, file in enumerate(files):
        size = -1
        with suppress(OSError):
            size = file.stat().st_size
            if size == before:
                same[k] = file == files[k - 1] or cmp(file, files[k - 1], shallow=False)
        before = size
    return same


def _stretches(chosen: Mask) -> list[tuple[int, int]]:
    """Start and stop of each stretch of chosen ones in a row."""
    steps = np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8))
    return list(zip(*(np.flatnonzero(steps == step).tolist() for step in (1, -1)), strict=True))


def _moved_on(
    files: tuple[Path, ...], same: Mask, behind: int, decode: Callable[[Path], Image]
) -> bool:
    """Whether the view jumped while the images before ``behind`` were the same, as (N,) says."""
    others = behind + np.flatnonzero(~same[behind:])[:2]
    if len(others) < 2:
        return False
    try:
        before, first, second = (_small(decode(files[k])) for k in (behind - 1, *others))
    except InputError:
        return False
    if before.std() < LEAST_CHANGE:  # a covered lens, or no depth
        return False
    usual = max(float(np.abs(second - first).mean()), LEAST_CHANGE)
    return bool(np.abs(first - before).mean() > JUMP * usual)


def _small(image: Image) -> Floats:
    """A small grey copy of colour or depth, less its mean, so that changing light is nothing."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey.astype(np.float32), SMALL, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), BLUR_PX)
    return np.asarray(small - small.mean(), np.float32)
