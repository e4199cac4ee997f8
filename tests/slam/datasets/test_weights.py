"""Weights by name: downloaded, checked against the SHA-256 in the file name, and kept."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from range_server import Served, serve

from bmask_slam.datasets.weights import (
    PUBLISHED,
    cache_folder,
    expected_sha256,
    fetch,
    find_weights,
)
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

CONTENT = b"weights" * 1000
NAME = f"net-{hashlib.sha256(CONTENT).hexdigest()[:8]}.pth"


@pytest.fixture
def server() -> Iterator[Served]:
    with serve(Served({NAME: CONTENT, "net-00000000.pth": b"changed"})) as served:
        yield served


def test_downloads_are_checked_and_kept(server: Served, tmp_path: Path) -> None:
    kept = fetch(f"{server.url}/{NAME}", tmp_path / "cache")
    assert kept.read_bytes() == CONTENT
    del server.files[NAME]
    assert fetch(f"{server.url}/{NAME}", tmp_path / "cache") == kept  # no second request
    kept.write_bytes(CONTENT[:99])
    with pytest.raises(InputError, match="cannot be downloaded"):
        fetch(f"{server.url}/{NAME}", tmp_path / "cache")  # broken on disk, gone from the server


def test_a_file_with_another_sha_is_not_kept(server: Served, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"SHA-256 begins with .* not 00000000"):
        fetch(f"{server.url}/net-00000000.pth", tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_published_files_have_https_and_a_sha() -> None:
    for name, url in PUBLISHED.items():
        assert url.startswith("https://")
        assert url.rsplit("/", 1)[1].startswith(name)
        assert len(expected_sha256(url)) == 8


def test_a_name_is_a_path_or_a_published_network(
    server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_weights("a/b.pth") == Path("a/b.pth")
    with pytest.raises(InputError, match="there are: torchvision:maskrcnn_resnet50_fpn_coco"):
        find_weights("torchvision:yolo")
    monkeypatch.setitem(PUBLISHED, "tiny", f"{server.url}/{NAME}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert find_weights("torchvision:tiny") == tmp_path / "bmask-slam" / NAME


def test_a_segmenter_reads_the_weights_that_were_found(
    server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The downloaded file is not a network, which the message must name."""
    monkeypatch.setitem(PUBLISHED, "tiny", f"{server.url}/{NAME}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    options = SegmenterOptions("mask-scoring-rcnn", weights="torchvision:tiny")
    with pytest.raises(InputError, match=rf"{NAME}: .*PyTorch file|{NAME}: holds more"):
        make_segmenter(options, tmp_path, find_weights)
    with pytest.raises(InputError, match="torchvision:tiny: no such file"):
        make_segmenter(options, tmp_path)


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", nobody)
    with pytest.raises(InputError, match="set XDG_CACHE_HOME"):
        cache_folder()
