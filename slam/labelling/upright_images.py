"""Which side of a recording's images is up, or the images that tell it."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Many

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.semantics.segmenters.upright import Upright, sample, spread
from bmask_slam.sequences.sequence import Sequence


def upright_of(
    options: SegmenterOptions, sequence: Sequence, indices: Many[int] | None = None
) -> Upright:
    """The side that its camera says; else samples of its frames, or of those at ``indices``.

    No image is read for a segmenter that is no network.
    """
    if sequence.camera.up or not options.is_network:
        return Upright(sequence.camera.up)
    frames = range(len(sequence)) if indices is None else indices
    return Upright(samples=samples(lambda k: sequence.rgb(frames[k]), len(frames)))


def samples(read: Callable[[int], Image], count: int) -> tuple[Image, ...]:
    """Small images, spread over so many; broken ones are left out."""
    found = []
    for number in spread(count):
        try:
            found.append(sample(read(number)))
        except InputError:
            continue
    return tuple(found)
