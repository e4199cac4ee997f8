"""The network's input: images normalised, resized and padded to one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from bmask_slam.semantics.network.config import ImageConfig

MULTIPLE_PX = 32
"""Both sides of a batch are padded to multiples of this, the coarsest stride of the body."""


@dataclass(frozen=True)
class ImageBatch:
    """A batch of prepared images.

    Attributes:
        tensor: (B, 3, H, W), channels last in memory, padded with zeros right and below.
        sizes: (height, width) of each resized image without the padding.
        original_sizes: (height, width) of each image before resizing.
    """

    tensor: Tensor
    sizes: list[tuple[int, int]]
    original_sizes: list[tuple[int, int]]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the padded batch."""
        return (self.tensor.shape[2], self.tensor.shape[3])


def resize_factor(size: tuple[int, int], config: ImageConfig) -> float:
    """Scale of an image of (height, width): short side to its length, unless the long exceeds."""
    return min(config.short_px / min(size), config.long_px / max(size))


def prepare(images: Sequence[Tensor], config: ImageConfig) -> ImageBatch:
    """A batch of images (3, H, W), float32, red green blue in 0..1."""
    mean = images[0].new_tensor(config.mean)[:, None, None]
    std = images[0].new_tensor(config.std)[:, None, None]
    resized = []
    for image in images:
        factor = resize_factor((image.shape[1], image.shape[2]), config)
        size = [max(int(n * factor), 1) for n in image.shape[1:]]
        normal = ((image - mean) / std)[None]
        resized.append(F.interpolate(normal, size, mode="bilinear", align_corners=False)[0])
    sizes = [(r.shape[1], r.shape[2]) for r in resized]
    height, width = (
        -(-max(size[k] for size in sizes) // MULTIPLE_PX) * MULTIPLE_PX for k in (0, 1)
    )
    batch = resized[0].new_zeros(len(resized), 3, height, width)
    batch = batch.to(memory_format=torch.channels_last)
    for k, (image, (h, w)) in enumerate(zip(resized, sizes, strict=True)):
        batch[k, :, :h, :w] = image
    return ImageBatch(batch, sizes, [(i.shape[1], i.shape[2]) for i in images])
