"""Downloads from a local server with interruptions, changes and errors."""

from __future__ import annotations

import errno
import hashlib
import http.client
import shutil
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from range_server import Served, serve

from bmask_slam.datasets import web_file
from bmask_slam.datasets.web_file import WebFile, download
from bmask_slam.graph.errors import InputError

CONTENT = bytes(range(256)) * 4000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_file, "FIRST_PAUSE_S", 0.0)


@pytest.fixture
def server() -> Iterator[Served]:
    with serve(Served({"file.tgz": CONTENT})) as served:
        yield served


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_downloaded_completely_with_one_request(server, tmp_path):
    progress: list[tuple[int, int]] = []
    file = WebFile(f"{server.url}/file.tgz", SHA256, len(CONTENT))
    path = tmp_path / "new" / "file.tgz"
    assert download(file, path, lambda *done: progress.append(done)) == SHA256
    assert path.read_bytes() == CONTENT
    assert progress[-1] == (len(CONTENT), len(CONTENT))
    assert download(file, path) == SHA256
    assert len(server.requests) == 1
    assert names(path.parent) == ["file.tgz"]


def test_a_connection_that_ends_early_is_resumed_where_it_ended(server, tmp_path):
    server.cut_after, server.cuts = 300_000, 2
    assert download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f") == SHA256
    assert server.requests == ["", "bytes=300000-", "bytes=600000-"]


@pytest.mark.parametrize(
    "error", [ssl.SSLError(1, "bad record mac"), OSError(errno.EHOSTUNREACH, "No route to host")]
)
def test_an_error_of_the_connection_is_none_of_the_disk(server, tmp_path, monkeypatch, error):
    read, failures = http.client.HTTPResponse.read, [error]

    def failing_once(response: http.client.HTTPResponse, amount: int | None = None) -> bytes:
        if failures:
            raise failures.pop()
        return read(response, amount)

    monkeypatch.setattr(http.client.HTTPResponse, "read", failing_once)
    assert download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f") == SHA256
    assert len(server.requests) == 2


def test_an_interrupted_download_is_resumed_by_the_next_call(server, tmp_path, monkeypatch):
    server.cut_after, server.cuts = 300_000, 1
    monkeypatch.setattr(web_file, "TRIES", 1)
    with pytest.raises(InputError, match="300000 bytes are kept"):
        download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f")
    assert not (tmp_path / "f").exists()
    assert download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f") == SHA256
    assert server.requests == ["", "bytes=300000-"]
    assert names(tmp_path) == ["f"]


def test_a_server_without_ranges_restarts_the_download(server, tmp_path):
    server.ranges, server.cut_after, server.cuts = False, 300_000, 1
    assert download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f") == SHA256
    assert (tmp_path / "f").read_bytes() == CONTENT


def test_parts_of_different_files_are_not_combined(server, tmp_path):
    """The file changes on the server during the download, and its hash is not known."""
    server.cut_after, server.cuts = 300_000, 1

    def change(done: int, total: int) -> None:
        server.files["file.tgz"] = CONTENT[::-1]

    download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f", change)
    assert (tmp_path / "f").read_bytes() == CONTENT[::-1]


def test_a_part_that_is_complete_is_not_received_again(server, tmp_path):
    """It was received whole, but the process was killed before it had its name."""
    (tmp_path / "f.part").write_bytes(CONTENT)
    (tmp_path / "f.part.mark").write_text(f'"{hash(CONTENT)}"')
    received: list[int] = []
    file = WebFile(f"{server.url}/file.tgz", SHA256, len(CONTENT))
    assert download(file, tmp_path / "f", lambda done, _: received.append(done)) == SHA256
    assert received == []
    assert server.requests == [f"bytes={len(CONTENT)}-"]
    assert names(tmp_path) == ["f"]


def test_a_part_longer_than_the_file_is_discarded(server, tmp_path):
    (tmp_path / "f.part").write_bytes(CONTENT * 2)
    (tmp_path / "f.part.mark").write_text(f'"{hash(CONTENT)}"')
    assert download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f") == SHA256


def test_a_wrong_hash_is_rejected_and_the_file_removed(server, tmp_path):
    with pytest.raises(InputError, match=r"SHA-256 begins with .* not 0000"):
        download(WebFile(f"{server.url}/file.tgz", "0" * 64), tmp_path / "f")
    assert names(tmp_path) == []


def test_a_wrong_size_is_rejected_before_downloading(server, tmp_path):
    with pytest.raises(InputError, match=f"{len(CONTENT)} bytes, not 77"):
        download(WebFile(f"{server.url}/file.tgz", size=77), tmp_path / "f")
    assert names(tmp_path) == []


def test_a_broken_file_on_disk_is_downloaded_again(server, tmp_path):
    (tmp_path / "f").write_bytes(CONTENT[:-1])
    download(WebFile(f"{server.url}/file.tgz", SHA256), tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == CONTENT


def test_a_missing_file_is_requested_once(server, tmp_path):
    with pytest.raises(InputError, match=rf"404 Not Found.*put it to {tmp_path}/f$"):
        download(WebFile(f"{server.url}/none"), tmp_path / "f")
    assert len(server.requests) == 1


def test_server_errors_are_retried_a_few_times(server, tmp_path):
    server.status = 503
    with pytest.raises(InputError, match="503"):
        download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f")
    assert len(server.requests) == web_file.TRIES


def test_an_unreachable_server_is_reported_at_once(tmp_path):
    with pytest.raises(InputError, match="refused"):
        download(WebFile("http://127.0.0.1:9/f"), tmp_path / "f")


def test_too_little_disk_space_is_reported_before_downloading(server, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match="free some space"):
        download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f")


def test_a_full_disk_is_not_reported_as_a_connection_error(server, tmp_path, monkeypatch):
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(web_file, "_copy", full)
    with pytest.raises(OSError, match="No space left"):
        download(WebFile(f"{server.url}/file.tgz"), tmp_path / "f")
    assert len(server.requests) == 1, "it must not be tried again"


def test_two_processes_download_once(server, tmp_path):
    file = WebFile(f"{server.url}/file.tgz", SHA256)
    both = [threading.Thread(target=download, args=(file, tmp_path / "f")) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert len(server.requests) == 1
    assert (tmp_path / "f").read_bytes() == CONTENT
