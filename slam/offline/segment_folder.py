"""Segmenting the colour images of a sequence or a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bmask_slam.datasets.weights import find_weights
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.segmenters.mask_cache import CacheOptions, CacheResult, cache_masks
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.sequences.lists import image_name, read_associations, read_list

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def segment_folder(
    source: Path,
    out: Path,
    options: SegmenterOptions,
    overlays: bool,
    progress: Callable[[int, int], None],
) -> CacheResult:
    """Segment every colour image of a sequence in TUM layout, or every image of a folder.

    Raises:
        InputError: no images, or as `make_segmenter` and `cache_masks`.
    """
    files = colour_images(source)
    segmenter = make_segmenter(options, source, find_weights)
    settings = {**options.described(), "source": str(source.resolve())}
    return cache_masks(segmenter, files, CacheOptions(out, settings, overlays), progress)


def colour_images(source: Path) -> list[tuple[str, Path]]:
    """Name relative to ``source`` and path of each colour image, ordered by stamp or name.

    Raises:
        InputError: there are no images.
    """
    if (source / "rgb.txt").is_file():
        files = list(read_list(source / "rgb.txt").files)
    elif (source / "associations.txt").is_file():
        files = list(read_associations(source / "associations.txt")[0].files)
    elif source.is_dir():
        files = sorted(p for p in source.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    else:
        raise InputError(f"{source}: no such folder; give a sequence or a folder of images")
    if not files:
        raise InputError(f"{source}: no image in it; give a sequence or a folder of png or jpg")
    return [(image_name(path, source), path) for path in files]
