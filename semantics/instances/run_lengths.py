"""COCO's run lengths of masks, plain and compressed; those of files are checked."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Ints, Mask


def run_lengths(mask: Mask) -> list[int]:
    """COCO's uncompressed run lengths: columns one after the other, zeros first."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.r_[changes, flat.size]
    starts = np.r_[0, changes]
    counts = (ends - starts).tolist()
    return [0, *counts] if flat[0] else counts


def checked_lengths(counts: str | list[int], given: list[int], size: list[int]) -> Ints:
    """The run lengths (N,) of a mask of ``size`` (H, W), from compressed or plain ones.

    Raises:
        ValueError: a mask of another size, or lengths that do not add up to its pixels.
    """
    if given != size:
        raise ValueError(f"a mask of size {given} in {size}")
    lengths = decoded_lengths(counts) if isinstance(counts, str) else np.array(counts, np.int64)
    pixels = size[0] * size[1]
    each_fits = lengths.min(initial=0) >= 0 and lengths.max(initial=0) <= pixels  # nor can it wrap
    if not each_fits or lengths.sum() != pixels:
        raise ValueError(f"run lengths that do not add up to {pixels} pixels")
    return lengths


def decoded_lengths(text: str) -> Ints:
    """The run lengths (N,) in COCO's compressed text; they may not make sense, but are finite.

    A number takes one to seven characters with five bits each, the lowest first; from the fourth
    number on it is the difference to the number two places before.

    Raises:
        ValueError: other characters, a number that does not end, or one of more than 35 bits.
    """
    codes: Ints = np.frombuffer(text.encode("utf-8"), np.uint8).astype(np.int64) - 48
    if len(codes) == 0 or codes.min() < 0 or codes.max() > 63 or codes[-1] & 32:
        raise ValueError("run lengths that are no compressed numbers")
    ends = np.flatnonzero((codes & 32) == 0)
    first = np.concatenate(([0], ends[:-1] + 1))
    if (ends - first).max() > 6:
        raise ValueError("run lengths that are no compressed numbers")
    place = np.arange(len(codes)) - np.repeat(first, ends - first + 1)
    values = np.add.reduceat((codes & 31) << (5 * place), first)
    negative = (codes[ends] & 16) > 0
    values -= np.where(negative, 1 << (5 * (ends - first + 1)), 0)
    tail = values[1:]  # of the first number nothing is subtracted
    for start in (0, 1):
        tail[start::2] = np.cumsum(tail[start::2])
    return values
