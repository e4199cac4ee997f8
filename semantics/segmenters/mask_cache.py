"""Masks of many images on disk: one file an image, made once, and one COCO file of all."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import target_below
from bmask_slam.graph.files.json_file import STRICT, read_json
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.instances.image_files import read_colour, write_image
from bmask_slam.semantics.instances.instances import Instance, as_annotation
from bmask_slam.semantics.instances.overlay import draw, draw_surfaces
from bmask_slam.semantics.instances.surface_files import write_surfaces
from bmask_slam.semantics.instances.surfaces import surfaces_of
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter

logger = logging.getLogger(__name__)

ANNOTATIONS = "annotations.json"
SETTINGS = "settings.json"
SURFACES = "surfaces"
"""The setting that masks of older versions lack; it means something for the light network alone."""


class _Entry(BaseModel):
    """The file of one image."""

    model_config = STRICT
    file_name: str
    height: int
    width: int
    annotations: list[dict[str, Any]]


@dataclass(frozen=True)
class CacheResult:
    """Counts of a run.

    Attributes:
        file: the COCO file of all images.
        images, instances: their numbers in it.
        reused: number of images whose masks were on disk already.
        broken: number of images that could not be read and are not in the file.
    """

    file: Path
    images: int
    instances: int
    reused: int
    broken: int


@dataclass(frozen=True)
class CacheOptions:
    """Where and how masks are written.

    Attributes:
        out: the folder.
        settings: how the masks are made; a folder holds masks of one setting.
        overlays: whether they are also drawn over the images.
    """

    out: Path
    settings: dict[str, str]
    overlays: bool = True


def cache_masks(
    segmenter: Segmenter,
    files: Sequence[tuple[str, Path]],
    options: CacheOptions,
    progress: Callable[[int, int], None],
) -> CacheResult:
    """Segment images (name, file) that are not in the cache, and write one COCO file of all.

    Raises:
        InputError: the folder holds masks made with other settings, two images differ in the
            suffix alone, or the first image cannot be read: most likely none can.
    """
    _check_names(name for name, _ in files)
    with_surfaces = _check_settings(options)
    entries: list[dict[str, Any]] = []
    reused = broken = 0
    for k, (name, path) in enumerate(files):
        cached = target_below(options.out, f"images/{name}").with_suffix(".json")
        if cached.is_file():
            entries.append(read_json(cached, _Entry, "remove it").model_dump())
            reused += 1
        else:
            try:
                image = read_colour(path)
                instances = segmenter.segment(image, name)
            except InputError as error:
                if k == 0:
                    raise
                logger.warning("%s; left out", error)
                broken += 1
            else:
                instances = instances if with_surfaces else list(instances)
                entries.append(_written(image, instances, name, segmenter.labels, options))
                _write_json(cached, entries[-1])
        progress(k + 1, len(files))
    content = _as_coco(entries, segmenter.labels)
    _write_json(options.out / ANNOTATIONS, content)
    count = len(content["annotations"])
    return CacheResult(options.out / ANNOTATIONS, len(entries), count, reused, broken)


def _check_names(names: Iterable[str]) -> None:
    """Raise InputError for two that differ in the suffix alone: they would share files."""
    known: dict[str, str] = {}
    for name in names:
        if (first := known.setdefault(str(Path(name).with_suffix("")), name)) != name:
            raise InputError(f"{first} and {name} differ in the suffix alone; rename one of them")


def _check_settings(options: CacheOptions) -> bool:
    """Whether the folder may hold classes of surfaces: one of an older version has none.

    Raises:
        InputError: it holds something else, or masks made with other settings.
    """
    path = options.out / SETTINGS
    if path.is_file():
        before = read_json(path, dict[str, str], "choose another --out or remove it")
        older = SURFACES in options.settings and SURFACES not in before
        meant = options.settings.get("name") == "light"
        skipped = SURFACES if older or not meant else None
        different = [k for k, v in options.settings.items() if before.get(k) != v and k != skipped]
        if different:
            key = different[0]
            raise InputError(
                f"{options.out}: holds masks made with {key} {before.get(key)}, now it is "
                f"{options.settings[key]}; choose another --out or delete it"
            )
        if older and meant:
            logger.warning("%s: masks of an older version, which have no surfaces", options.out)
        return not older
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        raise InputError(f"{options.out}: is no folder of masks; choose another --out")
    _write_json(path, options.settings)
    return True


def _written(
    image: Image, instances: list[Instance], name: str, labels: LabelSet, options: CacheOptions
) -> dict[str, Any]:
    """The entry of one image; writes its overlay if asked.

    Raises:
        InputError: the folder holds classes of surfaces of another label set.
    """
    seen = surfaces_of(instances)
    if seen is not None:
        write_surfaces(options.out, name, seen)
    if options.overlays:
        below = image if seen is None else draw_surfaces(image, seen)
        picture = draw(below, instances, labels)
        target = target_below(options.out, f"overlays/{name}").with_suffix(".jpg")
        with whole_file(target) as temporary:
            write_image(temporary, picture)
    height, width = image.shape[:2]
    annotations = [as_annotation(i) for i in instances]
    return {"file_name": name, "height": height, "width": width, "annotations": annotations}


def _as_coco(entries: Sequence[dict[str, Any]], labels: LabelSet) -> dict[str, Any]:
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, entry in enumerate(entries, 1):
        image = {key: entry[key] for key in ("file_name", "height", "width")}
        images.append({"id": number, **image})
        for annotation in entry["annotations"]:
            ids = {"id": len(annotations) + 1, "image_id": number}
            annotations.append({**ids, **annotation})
    categories = [{"id": k, "name": name} for k, name in enumerate(labels.names) if k > 0]
    return {"images": images, "annotations": annotations, "categories": categories}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, separators=(",", ":")) + "\n")
