"""Images of cameras that are mounted sideways or upside down."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from repository import shared

from bmask_slam.graph.camera import SIDES
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.upright_images import samples
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.instances.surfaces import (
    Segmented,
    SurfaceClasses,
    surfaces_of,
    up_of,
)
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.semantics.segmenters.upright import (
    MAX_IMAGES,
    SAMPLES,
    SIDE_PX,
    TURNED_IMAGES,
    UPRIGHT_IMAGES,
    Upright,
    UprightSegmenter,
    UpVotes,
    sample,
    spread,
    turned,
)

NAMES = label_set(("cup", "wall"))
SIZE = (44, 61)  # no multiple of a cell


class Bright:
    """Calls the bright rectangle of an image a cup, and tells cells of 8 pixels apart."""

    labels = NAMES

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def segment(self, image: np.ndarray, name: str) -> Segmented:
        self.seen.append(image)
        mask = image[..., 0] > 100
        rows, columns = (-(-n // 8) for n in image.shape[:2])
        across, down = np.meshgrid(np.arange(columns) / columns, np.arange(rows) / rows)
        p = np.stack([across, down], axis=-1).astype(np.float16)
        found = [Instance(mask, mask_box(mask), 1, certain(1, 3), 0.9, 0.8)]
        return Segmented(found, SurfaceClasses(NAMES, p, 8.0, image.shape[:2]))


class Scripted:
    """Finds in an image what a list says, for each side in turn."""

    def __init__(self, found: list[list[float]]) -> None:
        self._found = iter(np.array(found).ravel().tolist())

    def evidence(self, image: np.ndarray) -> float:
        return float(next(self._found))


def picture() -> np.ndarray:
    """An image with a bright rectangle near its lower right corner."""
    image = np.zeros((*SIZE, 3), np.uint8)
    image[30:40, 45:58] = 200
    return image


@pytest.mark.parametrize("side", SIDES)
def test_what_is_found_in_a_turned_image_is_where_it_is_in_the_image(side: str) -> None:
    inner = Bright()
    found = UprightSegmenter(inner, Upright(side)).segment(picture(), "a")
    mask = picture()[..., 0] > 100
    assert np.array_equal(found[0].mask, mask)
    assert found[0].mask.flags["C_CONTIGUOUS"]
    assert found[0].box.tolist() == mask_box(mask).tolist()
    assert up_of(found) == side
    turns = SIDES.index(side)
    assert np.array_equal(inner.seen[0], np.rot90(picture(), turns))


@pytest.mark.parametrize("side", SIDES)
def test_surfaces_of_a_turned_image_are_where_they_are_in_the_image(side: str) -> None:
    turns = SIDES.index(side)
    height, width = SIZE
    found = surfaces_of(UprightSegmenter(Bright(), Upright(side)).segment(picture(), "a"))
    in_turned = surfaces_of(Bright().segment(turned(picture(), turns), "a"))
    assert found is not None
    assert in_turned is not None
    assert found.size == SIZE
    pixels = np.array([[8, 8], [50, 12], [20, 36], [30, 20]])
    for u, v in pixels.tolist():
        there = ((u, v), (v, width - 1 - u), (width - 1 - u, height - 1 - v), (height - 1 - v, u))
        expected = in_turned.at(np.array([there[turns]]))
        assert np.allclose(found.at(np.array([[u, v]])), expected, atol=0.03)


@pytest.mark.parametrize("side", SIDES)
def test_the_side_with_most_found_is_up(side: str) -> None:
    best = SIDES.index(side)
    found = np.full((TURNED_IMAGES, 4), 0.2)
    found[:, best] = 1.0
    votes = UpVotes(Scripted(found.tolist()))
    told = [votes.add(picture()) for _ in range(TURNED_IMAGES if best else UPRIGHT_IMAGES)]
    assert told[:-1] == [""] * (len(told) - 1)
    assert told[-1] == side


@pytest.mark.parametrize("other", [0.6, 1.0], ids=["half-as-much", "as-much"])
def test_without_a_clear_side_images_are_upright(other: float) -> None:
    found = np.tile([other, 0.1, 1.0, 0.1], (MAX_IMAGES, 1))
    votes = UpVotes(Scripted(found.tolist()))
    told = [votes.add(picture()) for _ in range(MAX_IMAGES)]
    assert told == [""] * (MAX_IMAGES - 1) + [SIDES[0]]


def test_samples_settle_the_side_before_the_first_image() -> None:
    found = np.tile([0.1, 0.1, 1.0, 0.1], (TURNED_IMAGES, 1))
    known = Upright(samples=(picture(),) * SAMPLES)
    segmenter = UprightSegmenter(Bright(), known, Scripted(found.tolist()))
    assert up_of(segmenter.segment(picture(), "a")) == "bottom"


def test_samples_that_do_not_tell_leave_images_as_they_are() -> None:
    found = np.ones((SAMPLES, 4))
    known = Upright(samples=(picture(),) * SAMPLES)
    segmenter = UprightSegmenter(Bright(), known, Scripted(found.tolist()))
    assert up_of(segmenter.segment(picture(), "a")) == "top"


def test_without_samples_the_first_images_tell() -> None:
    found = np.tile([0.1, 1.0, 0.1, 0.1], (TURNED_IMAGES, 1))
    segmenter = UprightSegmenter(Bright(), Upright(), Scripted(found.tolist()))
    told = [up_of(segmenter.segment(picture(), "a")) for _ in range(TURNED_IMAGES + 2)]
    assert told == [""] * (TURNED_IMAGES - 1) + ["right"] * 3


def test_samples_are_small_and_of_the_whole_recording() -> None:
    numbers = spread(300)
    assert len(numbers) == SAMPLES
    assert {0, 299} <= set(numbers)
    assert sorted(spread(5)) == [0, 1, 2, 3, 4]
    assert spread(0) == []
    assert sample(np.zeros((480, 640, 3), np.uint8)).shape == (240, SIDE_PX, 3)
    assert sample(picture()).shape == picture().shape


def test_broken_images_are_no_samples() -> None:
    def read(number: int) -> np.ndarray:
        if number == 0:
            raise InputError("broken")
        return picture()

    assert len(samples(read, 5)) == 4


def test_only_networks_get_turned_images(tmp_path: Path) -> None:
    none = make_segmenter(SegmenterOptions("none"), tmp_path, upright=Upright("left"))
    assert isinstance(none, NoSegmenter)


@pytest.mark.parametrize("side", SIDES)
def test_the_network_finds_the_side_and_the_same_things(side: str) -> None:
    """Of photographs of rooms, the images of a camera that is mounted so."""
    files = sorted(shared("nyuv2/images").glob("*.jpg"))[::71]
    turns = -SIDES.index(side) % 4
    images = [turned(read_colour(file), turns) for file in files[:SAMPLES]]
    known = Upright(samples=samples(lambda k: images[k], len(images)))
    options = SegmenterOptions(min_score=0.3)
    found = make_segmenter(options, Path(), upright=known).segment(images[0], "a")
    expected = make_segmenter(options, Path()).segment(read_colour(files[0]), "a")
    assert up_of(found) == side
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        assert one.label == other.label
        assert np.array_equal(one.mask, turned(other.mask, turns))
