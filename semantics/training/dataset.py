"""Training images from COCO files: split, mapped to a label set, augmented."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch

from bmask_slam.graph.arrays import Array, Image, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.coco_files import CocoFile, CocoImage, CocoObject
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.instances.instances import mask_box
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.training.targets import Target

MIN_OBJECT_PX = 16
"""Objects with fewer pixels after augmentation are not used."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A training image.

    Attributes:
        image: (H, W, 3) uint8, red first.
        masks: (G, H, W) bool.
        labels: (G,) int64, from 1.
    """

    image: Image
    masks: Mask
    labels: Ints


@dataclass(frozen=True)
class AugmentConfig:
    """How images are augmented.

    Attributes:
        flip: share of mirrored images.
        min_scale, max_scale: range of the random factor on the size.
        paste: share of images with objects of another image pasted in (Ghiasi et al. 2021).
    """

    flip: float = 0.5
    min_scale: float = 0.7
    max_scale: float = 1.3
    paste: float = 0.3


class Dataset:
    """The images of a COCO file that hold at least one object of a label set.

    Classes are matched by name; crowds and objects of other classes are not used.

    Raises:
        InputError: no image has an object of the label set.
    """

    def __init__(self, content: CocoFile, folder: Path, labels: LabelSet) -> None:
        self._folder = folder
        self._number = [labels.number(name) for name in content.labels.names]
        self.images = tuple(i for i in content.images if self._objects(i))
        if not self.images:
            names = ", ".join(content.labels.names[1:6])
            raise InputError(
                f"{folder}: no image has an object of the label set; the file's classes are "
                f"{names} ...; give another --labels"
            )

    def __len__(self) -> int:
        return len(self.images)

    @property
    def portrait(self) -> Mask:
        """Whether each image is higher than wide."""
        return np.array([image.height > image.width for image in self.images])

    @cached_property
    def objects(self) -> Array:
        """The number of objects of each image."""
        return np.array([len(self._objects(image)) for image in self.images], np.float64)

    def load(self, index: int) -> Sample:
        """One image with its objects.

        Raises:
            InputError: the image is missing or broken, or not of the annotated size.
        """
        entry = self.images[index]
        image = read_colour(self._folder / entry.file_name)
        if image.shape[:2] != (entry.height, entry.width):
            raise InputError(
                f"{self._folder / entry.file_name}: {image.shape[1]}x{image.shape[0]} pixels, but "
                f"{entry.width}x{entry.height} in the annotations; give the images that they are of"
            )
        objects = self._objects(entry)
        labels = np.array([self._number[o.label] for o in objects], np.int64)
        return Sample(image, np.stack([o.mask() for o in objects]), labels)

    def _objects(self, image: CocoImage) -> list[CocoObject]:
        return [o for o in image.objects if not o.crowd and self._number[o.label] > 0]


class JoinedDatasets:
    """The concatenation of several data sets."""

    def __init__(self, parts: Sequence[Dataset]) -> None:
        self._parts = parts
        self._ends = np.cumsum([len(part) for part in parts])

    def __len__(self) -> int:
        return int(self._ends[-1])

    @property
    def portrait(self) -> Mask:
        """Whether each image is higher than wide."""
        return np.concatenate([part.portrait for part in self._parts])

    @cached_property
    def objects(self) -> Array:
        """The number of objects of each image."""
        return np.concatenate([part.objects for part in self._parts])

    def load(self, index: int) -> Sample:
        """One image with its objects. Raises InputError."""
        k = int(np.searchsorted(self._ends, index, side="right"))
        return self._parts[k].load(index - int(self._ends[k]) + len(self._parts[k]))


def split(content: CocoFile, share: float, seed: int) -> tuple[CocoFile, CocoFile]:
    """Split a file's images at random into a training part and a validation part.

    Images are drawn in the order of their ids, so that the split depends only on these and the
    seed; the parts keep the file's order. ``share`` is that of the validation part.
    """
    images = sorted(content.images, key=lambda i: i.number)
    order = np.random.default_rng(seed).permutation(len(images))
    held_out = {images[k].number for k in order[: round(share * len(images))].tolist()}
    parts = [
        tuple(i for i in content.images if (i.number in held_out) == second)
        for second in (False, True)
    ]
    training, validation = (
        CocoFile(content.labels, content.category_ids, part, content.problems) for part in parts
    )
    return training, validation


def augmented(
    sample: Sample, other: Callable[[], Sample], config: AugmentConfig, rng: np.random.Generator
) -> Sample:
    """A random augmentation of a sample; ``other`` loads the sample to paste objects from."""
    if rng.random() < config.paste:
        sample = copy_paste(sample, other(), rng)
    if rng.random() < config.flip:
        sample = flipped(sample)
    return scaled(sample, rng.uniform(config.min_scale, config.max_scale))


def flipped(sample: Sample) -> Sample:
    """The mirror image."""
    image = np.ascontiguousarray(sample.image[:, ::-1])
    return Sample(image, np.ascontiguousarray(sample.masks[:, :, ::-1]), sample.labels)


def scaled(sample: Sample, factor: float) -> Sample:
    """The sample scaled about its centre in an image of the same size.

    It is cropped if larger and padded with grey if smaller, so that the size of objects varies
    although the network resizes every image to one size.
    """
    height, width = sample.image.shape[:2]
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    matrix = np.hstack([np.eye(2) * factor, (centre * (1 - factor))[:, None]])
    size = (width, height)
    image = cv2.warpAffine(sample.image, matrix, size, borderValue=(114, 114, 114))
    masks = np.zeros((len(sample.masks), height, width), bool)  # none after some pasting
    for k, mask in enumerate(sample.masks):
        masks[k] = cv2.warpAffine(mask.astype(np.uint8), matrix, size, flags=cv2.INTER_NEAREST)
    return _visible(Sample(np.asarray(image, np.uint8), masks, sample.labels))


def copy_paste(sample: Sample, other: Sample, rng: np.random.Generator) -> Sample:
    """The sample with up to three objects of another one pasted over it; masks are occluded."""
    height, width = sample.image.shape[:2]
    count = min(3, len(other.labels))
    chosen = rng.permutation(len(other.labels))[:count]
    rows, columns = min(height, other.image.shape[0]), min(width, other.image.shape[1])
    pasted = np.zeros((count, height, width), bool)
    pasted[:, :rows, :columns] = other.masks[chosen, :rows, :columns]
    area = np.asarray(pasted.any(axis=0), bool)
    image = sample.image.copy()
    source = other.image[:rows, :columns]
    inside = area[:rows, :columns]
    image[:rows, :columns][inside] = source[inside]
    masks = np.concatenate([sample.masks & ~area, pasted])
    return _visible(Sample(image, masks, np.concatenate([sample.labels, other.labels[chosen]])))


def _visible(sample: Sample) -> Sample:
    """The sample without objects of which too few pixels are visible."""
    visible = sample.masks.sum(axis=(1, 2)) >= MIN_OBJECT_PX
    return Sample(sample.image, sample.masks[visible], sample.labels[visible])


def as_tensors(sample: Sample) -> tuple[torch.Tensor, Target]:
    """The image (3, H, W) in 0..1 and its objects."""
    image = torch.from_numpy(sample.image).permute(2, 0, 1).float() / 255
    boxes = np.array([mask_box(m) for m in sample.masks], np.float32).reshape(-1, 4)
    labels, masks = torch.from_numpy(sample.labels), torch.from_numpy(sample.masks)
    return image, Target(torch.from_numpy(boxes), labels, masks)
