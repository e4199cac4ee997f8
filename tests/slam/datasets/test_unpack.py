"""Archives are unpacked, and unsafe ones rejected with the reason."""

from __future__ import annotations

import io
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from bmask_slam.datasets.unpack import unpack
from bmask_slam.graph.errors import InputError

FILES = {"seq/rgb.txt": b"0.1 rgb/0.png\n", "seq/rgb/0.png": b"\x89PNG" * 1000}


def tar_of(path: Path, *members: tarfile.TarInfo, files: dict[str, bytes] = FILES) -> Path:
    with tarfile.open(path, "w:gz") as tar:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size, info.mode = len(content), 0o6777
            tar.addfile(info, io.BytesIO(content))
        for member in members:
            tar.addfile(member)
    return path


def zip_of(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def member(name: str, kind: bytes, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


@pytest.mark.parametrize("make", [tar_of, zip_of], ids=["tar", "zip"])
def test_files_are_unpacked_unchanged(make, tmp_path):
    archive = make(tmp_path / "a", files=FILES)
    progress: list[tuple[int, int]] = []
    unpack(archive, tmp_path / "out", lambda *done: progress.append(done))
    for name, content in FILES.items():
        assert (tmp_path / "out" / name).read_bytes() == content
        assert stat.S_IMODE((tmp_path / "out" / name).stat().st_mode) & 0o6111 == 0
    assert 0 < progress[-1][0] <= progress[-1][1]


@pytest.mark.parametrize(
    "name", ["/etc/evil", "../evil", "seq/../../evil", "C:/evil", "seq\\..\\evil"]
)
@pytest.mark.parametrize("make", [tar_of, zip_of], ids=["tar", "zip"])
def test_no_file_is_written_outside_the_folder(make, name, tmp_path):
    archive = make(tmp_path / "a", files={name: b"evil"})
    with pytest.raises(InputError, match="leads out of its folder"):
        unpack(archive, tmp_path / "out" / "deep")
    assert not list(tmp_path.rglob("*evil*"))


@pytest.mark.parametrize(
    "bad",
    [
        member("seq/link", tarfile.SYMTYPE, "/etc/passwd"),
        member("seq/link", tarfile.SYMTYPE, "rgb.txt"),
        member("seq/hard", tarfile.LNKTYPE, "../../outside"),
        member("seq/hard", tarfile.LNKTYPE, "seq/rgb.txt"),
        member("seq/device", tarfile.CHRTYPE),
        member("seq/pipe", tarfile.FIFOTYPE),
    ],
    ids=lambda info: f"{info.name}-{info.linkname}".replace("/", "_"),
)
def test_links_and_devices_are_refused(bad, tmp_path):
    with pytest.raises(InputError, match="a link or device"):
        unpack(tar_of(tmp_path / "a", bad), tmp_path / "out")
    assert not (tmp_path / "out" / bad.name).exists()


def test_a_link_in_a_zip_is_refused(tmp_path):
    info = zipfile.ZipInfo("seq/link")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a", "w") as archive:
        archive.writestr(info, "/etc/passwd")
    with pytest.raises(InputError, match="a link or device"):
        unpack(tmp_path / "a", tmp_path / "out")


def test_a_repeated_name_is_rejected(tmp_path):
    again = tarfile.TarInfo("seq/rgb.txt")
    with pytest.raises(InputError, match="twice"):
        unpack(tar_of(tmp_path / "a", again), tmp_path / "out")


@pytest.mark.parametrize("make", [tar_of, zip_of], ids=["tar", "zip"])
@pytest.mark.parametrize("below", ["a", "a/b"])
def test_a_file_below_a_file_is_refused(make, below, tmp_path):
    archive = make(tmp_path / "x", files={"a": b"file", f"{below}/c": b"below"})
    with pytest.raises(InputError, match=r"x: holds a file and a folder of one name"):
        unpack(archive, tmp_path / "out")


@pytest.mark.parametrize("keep", [0, 10, 60])
def test_a_broken_archive_is_named(keep, tmp_path):
    content = tar_of(tmp_path / "a").read_bytes()
    (tmp_path / "a").write_bytes(content[:keep])
    with pytest.raises(InputError, match="download again"):
        unpack(tmp_path / "a", tmp_path / "out")


def test_a_zip_with_a_changed_byte_is_refused(tmp_path):
    archive = zip_of(tmp_path / "a", {"x": bytes(range(256)) * 40})
    content = bytearray(archive.read_bytes())
    content[60] ^= 255
    archive.write_bytes(content)
    with pytest.raises(InputError, match="download again"):
        unpack(archive, tmp_path / "out")
