"""Augmentation of images with a class for every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Image
from bmask_slam.semantics.network.yolox.network import PAD_VALUE

IGNORED = 255
"""The value of pixels without a class."""


@dataclass(frozen=True)
class Augmentation:
    """How images are changed.

    Attributes:
        size: (height, width) of the piece that is taken; multiples of 32.
        scales: smallest and largest factor on the size.
        turn_deg: standard deviation of the rotation.
        flip: share of mirrored images.
        light: standard deviation of the logarithms of gamma, contrast and the channels' gains.
        grey: share of images without colour.
        blur: share of blurred images.
        noise: largest standard deviation of added noise.
    """

    size: tuple[int, int] = (416, 512)
    scales: tuple[float, float] = (0.75, 1.7)
    turn_deg: float = 4.0
    flip: float = 0.5
    light: float = 0.12
    grey: float = 0.05
    blur: float = 0.2
    noise: float = 8.0


def augmented(
    image: Image, labels: Bytes, config: Augmentation, rng: np.random.Generator
) -> tuple[Image, Bytes]:
    """A piece of a turned, scaled, mirrored image (H, W, 3) with its labels (H, W)."""
    matrix = _placement((image.shape[0], image.shape[1]), config, rng)
    piece, classes = placed(image, labels, matrix, config.size)
    return _recoloured(piece, config, rng), classes


def placed(
    image: Image, labels: Bytes, matrix: Array, size: tuple[int, int]
) -> tuple[Image, Bytes]:
    """An image and its labels moved by an affine map (2, 3) into those of a size (H, W)."""
    outside, nothing, shape = (PAD_VALUE,) * 3, (IGNORED,), size[::-1]
    piece = cv2.warpAffine(image, matrix, shape, flags=cv2.INTER_LINEAR, borderValue=outside)
    classes = cv2.warpAffine(labels, matrix, shape, flags=cv2.INTER_NEAREST, borderValue=nothing)
    return np.asarray(piece, np.uint8), np.asarray(classes, np.uint8)


def _placement(shape: tuple[int, int], config: Augmentation, rng: np.random.Generator) -> Array:
    """The affine map (2, 3) of the image's pixels (u, v, 1) to those of the piece."""
    low, high = np.log(config.scales)
    scale = float(np.exp(rng.uniform(low, high)))
    angle = np.deg2rad(rng.normal(0, config.turn_deg))
    mirror = -1.0 if rng.random() < config.flip else 1.0
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]]) @ np.diag([mirror, 1.0])
    wanted, here = np.array(config.size[::-1], float), np.array(shape[::-1], float)
    spare = np.maximum(here - wanted / scale, 0)
    centre = 0.5 * (here - 1) + rng.uniform(-0.5, 0.5, 2) * spare
    return np.column_stack([turn, 0.5 * (wanted - 1) - turn @ centre])


def _recoloured(image: Image, config: Augmentation, rng: np.random.Generator) -> Image:
    gamma, contrast = np.exp(rng.normal(0, config.light, 2))
    gains = np.exp(rng.normal(0, 0.5 * config.light, 3))
    saturation = 0.0 if rng.random() < config.grey else np.exp(rng.normal(0, 2 * config.light))
    light = rng.normal(0, config.light)
    x = (image.astype(np.float32) / 255) ** np.float32(gamma)
    grey = x.mean(axis=2, keepdims=True)
    x = (grey + saturation * (x - grey)) * gains.astype(np.float32)
    x = (x - 0.5) * contrast + 0.5 + light
    if rng.random() < config.blur:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.5, 1.8))
    x = x * 255 + rng.uniform(0, config.noise) * rng.standard_normal(x.shape, np.float32)
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)
