"""A network in a process beside the run gives what it gives in the run's own process."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.errors import InputError
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.parallel import segmenter_beside
from bmask_slam.parallel.segmenter_beside import SegmenterBeside, segmenter_of_run
from bmask_slam.semantics.instances.surfaces import surfaces_of
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.system_config import SystemConfig

OPTIONS = SegmenterOptions("light")


@pytest.fixture(scope="module")
def beside() -> Iterator[SegmenterBeside]:
    segmenter = SegmenterBeside(OPTIONS, Path(), Upright("top"))  # else by the images before
    yield segmenter
    segmenter.close()


@pytest.fixture(scope="module")
def images(office: Path) -> list[np.ndarray]:
    paths = sorted((office / "rgb").iterdir())[::5]
    return [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in paths]


def test_masks_and_classes_are_those_of_a_segmenter_here(beside, images) -> None:
    here = make_segmenter(OPTIONS, Path())
    assert beside.labels == here.labels and beside.measured == here.measured == "light"
    for k, image in enumerate(images):
        if k % 2:
            beside.begin(image, str(k))
        found, expected = beside.segment(image, str(k)), here.segment(image, str(k))
        np.testing.assert_array_equal(
            surfaces_of(found).probabilities, surfaces_of(expected).probabilities
        )
        assert [i.label for i in found] == [i.label for i in expected]
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one.mask, other.mask)
            np.testing.assert_array_equal(one.distribution, other.distribution)


def test_an_image_that_was_begun_for_nothing_is_passed_over(beside, images) -> None:
    beside.begin(images[0], "never asked for")
    again = beside.segment(images[1], "b")
    expected = make_segmenter(OPTIONS, Path()).segment(images[1], "b")
    np.testing.assert_array_equal(
        surfaces_of(again).probabilities, surfaces_of(expected).probabilities
    )


def test_several_images_may_be_begun_and_asked_for_in_any_order(beside, images) -> None:
    for k in range(3):
        beside.begin(images[k], f"image {k}")
    here = make_segmenter(OPTIONS, Path())
    for k in (2, 0, 1):
        found, expected = beside.segment(images[k], f"image {k}"), here.segment(images[k], "")
        np.testing.assert_array_equal(
            surfaces_of(found).probabilities, surfaces_of(expected).probabilities
        )


def test_one_that_is_killed_is_started_again_and_finds_the_same(beside, images) -> None:
    expected = beside.segment(images[0], "a")
    beside.begin(images[0], "again")
    os.kill(beside.worker.pid, signal.SIGKILL)
    found = beside.segment(images[0], "again")
    assert beside.worker.crashes == 1
    np.testing.assert_array_equal(
        surfaces_of(found).probabilities, surfaces_of(expected).probabilities
    )


def test_what_cannot_be_segmented_is_refused(beside) -> None:
    with pytest.raises(InputError, match=r"a\.png: an image of shape"):
        beside.segment(np.zeros((4, 4), np.uint8), "a.png")


def test_weights_that_are_missing_are_named_as_by_a_segmenter_here(tmp_path: Path) -> None:
    options = SegmenterOptions("light", weights=str(tmp_path / "none.pth"))
    with pytest.raises(InputError) as here:
        make_segmenter(options, tmp_path)
    with pytest.raises(InputError) as there, segmenter_of_run(options, tmp_path, Upright()):
        pass
    assert "none.pth" in str(here.value) and str(there.value) == str(here.value)


def test_the_shipped_network_is_not_waited_for(images) -> None:
    with segmenter_of_run(OPTIONS, Path(), Upright("top")) as segmenter:
        assert segmenter.worker.labels == ()  # its process has not answered yet
        assert segmenter.labels == make_segmenter(OPTIONS, Path()).labels
        assert segmenter.segment(images[0], "a")
        assert segmenter.worker.labels == segmenter.labels.names


def test_a_network_that_ends_while_it_loads_is_an_error_of_the_first_image(images) -> None:
    with segmenter_of_run(OPTIONS, Path(), Upright("top")) as segmenter:
        os.kill(segmenter.worker.pid, signal.SIGKILL)
        with pytest.raises(InputError, match="the segmenter's process did not start"):
            segmenter.segment(images[0], "a")


def test_a_run_gives_the_same_bytes_with_one_processor(
    office: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where there is one, the network is in the run's own process."""
    config = resolve(SystemConfig, None, ("semantics.segmenter.name=light",))
    for name, processors in (("here", 1), ("beside", 2)):
        monkeypatch.setattr(segmenter_beside, "available_cores", lambda n=processors: n)
        run(RunOptions(office, config, out=tmp_path / name, quiet=True, max_frames=8))
    for name in ("trajectory.txt", "map", "labels.csv", "objects.json"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "beside" / name).read_bytes()
