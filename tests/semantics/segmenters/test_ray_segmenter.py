"""A segmenter through Ray: results equal a local one, and a lost worker loses only its image."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.segmenters.ray_connection import connect
from bmask_slam.semantics.segmenters.ray_segmenter import RaySegmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

ray = pytest.importorskip("ray", reason="needs Ray: pip install 'bmask-slam[ray]'")

IMAGE = np.full((48, 64, 3), 100, np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("masks")
    values = np.zeros((48, 64), np.uint8)
    values[5:20, 10:30], values[25:40, 33:60] = 1, 2
    cv2.imwrite(str(path / "a.png"), values)
    return path


@pytest.fixture(scope="module")
def options(folder: Path) -> SegmenterOptions:
    return SegmenterOptions("precomputed", masks=folder, ray="local")


@pytest.fixture(scope="module")
def segmenter(options: SegmenterOptions, folder: Path) -> Iterator[RaySegmenter]:
    connect("local", local_cpus=2)  # for two actors; fewer workers start faster
    found = make_segmenter(options, folder)
    assert isinstance(found, RaySegmenter)
    yield found
    ray.shutdown()


def equal(a: list[Instance], b: list[Instance]) -> bool:
    return [(i.mask.tolist(), i.box.tolist(), i.label, i.mask_score) for i in a] == [
        (i.mask.tolist(), i.box.tolist(), i.label, i.mask_score) for i in b
    ]


def test_a_mask_is_sent_with_one_bit_per_pixel() -> None:
    mask = np.random.default_rng(0).random((37, 51)) > 0.5
    sent = Instance(mask, mask_box(mask), 2, certain(2, 4), 0.75, 0.5)
    data = pickle.dumps(sent, protocol=5)
    assert len(data) < mask.size / 8 + 500
    assert equal([pickle.loads(data)], [sent])
    np.testing.assert_array_equal(pickle.loads(data).distribution, sent.distribution)


def test_the_remote_segmenter_equals_the_local_one(segmenter, options, folder) -> None:
    here = make_segmenter(replace(options, ray=""), folder)
    assert segmenter.labels == here.labels
    found = segmenter.segment(IMAGE, "a.png")
    assert len(found) == 2
    assert equal(found, here.segment(IMAGE, "a.png"))


def test_workers_do_not_import_from_the_current_folder(segmenter) -> None:
    folders = ray.get(
        ray.remote(num_cpus=0)(lambda: [os.path.realpath(p) for p in sys.path]).remote()
    )
    assert os.path.realpath(os.curdir) not in folders


def test_a_remote_input_error_is_raised_locally(segmenter) -> None:
    with pytest.raises(InputError, match=r"b\.png"):
        segmenter.segment(IMAGE, "b.png")
    with pytest.raises(InputError, match="8 bits"):
        segmenter.segment(IMAGE.astype(float), "a.png")


def test_a_killed_worker_loses_only_its_image(segmenter) -> None:
    pid = ray.get(segmenter._actor.__ray_call__.remote(lambda _: os.getpid()))
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(InputError, match="lost"):
        for _ in range(20):  # until the death is known
            segmenter.segment(IMAGE, "a.png")
    assert len(segmenter.segment(IMAGE, "a.png")) == 2


def test_a_worker_that_cannot_start_reports_the_reason(segmenter, options, folder) -> None:
    broken = replace(options, masks=folder / "none.json")
    with pytest.raises(InputError, match=r"none\.json"):
        make_segmenter(broken, folder)


class Silent(RaySegmenter):
    """One whose connection ends without a word, as a socket's may."""

    def _start(self) -> None:
        raise ConnectionResetError


def test_an_error_without_a_text_is_reported_by_its_name() -> None:
    lost = Silent.__new__(Silent)
    lost._ray, lost._actor = ray, None
    with pytest.raises(InputError, match=r"Ray is lost \(ConnectionResetError\)"):
        lost.segment(IMAGE, "a.png")
