"""From a published archive to a folder that a run can read; the catalogue."""

from __future__ import annotations

import hashlib
import io
import tarfile
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from range_server import Served, serve

from bmask_slam.cli import main
from bmask_slam.comparison.experiment.experiment_file import read_experiment
from bmask_slam.datasets import web_file
from bmask_slam.datasets.catalogue import Recording, find, read_catalogue
from bmask_slam.datasets.obtain import RECEIVED, SUMS, obtain, read_sums
from bmask_slam.datasets.unpack import unpack
from bmask_slam.evaluation.reference import BONN
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.sequences.sequence import open_sequence

CAMERA = {"width": 640, "height": 480, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5,
          "depth_scale": 5000}  # fmt: skip
TUM = {
    "rgb.txt": b"1.00 rgb/0.png\n1.03 rgb/1.png\n",
    "depth.txt": b"1.00 depth/0.png\n1.03 depth/1.png\n",
    "groundtruth.txt": b"1.00 0 0 0 0 0 0 1\n1.03 0 0 0.1 0 0 0 1\n",
}
ICL = {
    "associations.txt": b"0 depth/0.png 0 rgb/0.png\n1 depth/1.png 1 rgb/1.png\n",
    "livingRoom0.gt.freiburg": b"1 0 0 -2.25 0 0 0 1\n2 0.1 0.2 -2.2 0.1 0 0 0.99498744\n",
}


def images() -> dict[str, bytes]:
    rgb, depth = np.zeros((480, 640, 3), np.uint8), np.full((480, 640), 5000, np.uint16)
    made = {"rgb": cv2.imencode(".png", rgb)[1], "depth": cv2.imencode(".png", depth)[1]}
    return {f"{kind}/{k}.png": made[kind].tobytes() for kind in made for k in range(2)}


def as_tar(files: dict[str, bytes], top: str) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, content in files.items():
            info = tarfile.TarInfo(f"{top}{name}")
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return out.getvalue()


def as_zip(files: dict[str, bytes], top: str) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"{top}{name}", content)
    return out.getvalue()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setattr(web_file, "FIRST_PAUSE_S", 0.0)
    tum = as_tar(TUM | images(), "rgbd_dataset_freiburg1_tiny/")
    files = {
        "tiny.tgz": tum,
        "bonn.zip": as_zip(TUM | images(), "rgbd_bonn_tiny/"),
        "icl.tar.gz": as_tar(ICL | images(), "./"),
        "none.tgz": as_tar({"readme": b"nothing"}, "x/"),
    }
    with serve(Served(files)) as served:
        yield served


def test_a_tum_archive_becomes_a_sequence(server, tmp_path):
    recording = Recording("tum/freiburg1_tiny", f"{server.url}/tiny.tgz")
    folder = obtain(recording, tmp_path)
    assert folder == tmp_path / "tum" / "freiburg1_tiny"
    sequence = open_sequence(folder)
    assert len(list(sequence.frames(prefetch=0))) == 2
    assert sequence.camera.fx == pytest.approx(517.306408), "TUM's own, by the folder's name"
    assert sorted(path.name for path in folder.parent.iterdir()) == ["freiburg1_tiny"]
    assert obtain(recording, tmp_path) == folder
    assert len(server.requests) == 1


def test_nothing_is_unpacked_through_a_link(server, tmp_path):
    """Nor is what a killed download left behind kept, under a name that could be guessed."""
    (tmp_path / "tum" / ".freiburg1_tiny.unpacking-killed").mkdir(parents=True)
    victim = tmp_path / "victim"
    victim.mkdir()
    for name in (".freiburg1_tiny.unpacking", ".freiburg1_tiny.unpacking-a"):
        (tmp_path / "tum" / name).symlink_to(victim)
    folder = obtain(Recording("tum/freiburg1_tiny", f"{server.url}/tiny.tgz"), tmp_path)
    assert (folder / "rgb.txt").is_file() and not folder.is_symlink()
    assert not list(victim.iterdir())
    assert (folder.stat().st_mode & 0o777) == (victim.stat().st_mode & 0o777)
    names = sorted(path.name for path in folder.parent.iterdir())
    assert names == [".freiburg1_tiny.unpacking", "freiburg1_tiny"]


def test_of_two_that_obtain_a_recording_one_unpacks(server, tmp_path, monkeypatch):
    """The other would take its half unpacked folder for one of a killed process."""
    unpacked = []

    def slow(*arguments: Any) -> None:
        unpacked.append(arguments)
        time.sleep(0.3)
        unpack(*arguments)

    monkeypatch.setattr("bmask_slam.datasets.obtain.unpack", slow)
    recording = Recording("tum/freiburg1_tiny", f"{server.url}/tiny.tgz")
    with ThreadPoolExecutor(2) as pool:
        one, other = (pool.submit(obtain, recording, tmp_path) for _ in range(2))
    assert one.result() == other.result() == tmp_path / "tum" / "freiburg1_tiny"
    assert len(unpacked) == len(server.requests) == 1


def test_the_first_hash_is_kept_and_a_later_file_must_agree(server, tmp_path, caplog):
    recording = Recording("tum/freiburg1_tiny", f"{server.url}/tiny.tgz")
    folder = obtain(recording, tmp_path, keep_archive=True)
    received = hashlib.sha256(server.files["tiny.tgz"]).hexdigest()
    assert read_sums(tmp_path / SUMS) == {"tiny.tgz": received}
    assert (
        f"no SHA-256 is known to check it by; received {len(server.files['tiny.tgz'])} bytes"
        in (caplog.text)
    )
    assert received in caplog.text
    size, kept = len(server.files["tiny.tgz"]), (folder / RECEIVED).read_text()
    assert kept == (
        f"url     {server.url}/tiny.tgz\nbytes   {size}\n"
        f"sha256  {received} (not known to the catalogue)\n"
    )
    folder.rename(tmp_path / "moved")
    (tmp_path / "tum" / "tiny.tgz").unlink()
    server.files["tiny.tgz"] = as_tar(TUM, "other/")
    with pytest.raises(InputError, match="SHA-256 begins with"):
        obtain(recording, tmp_path)
    assert not folder.exists()


def test_a_bonn_archive_gets_its_camera(server, tmp_path):
    recording = Recording("bonn/tiny", f"{server.url}/bonn.zip", camera=CAMERA)
    assert open_sequence(obtain(recording, tmp_path)).camera.fx == 50.0
    assert read_catalogue()["bonn/crowd"].layout == "bonn"


def test_a_bonn_archives_poses_become_the_cameras(server, tmp_path):
    recording = Recording("bonn/tiny", f"{server.url}/bonn.zip", layout="bonn", camera=CAMERA)
    folder = obtain(recording, tmp_path)
    expected = BONN.camera_of(read_tum(folder / "groundtruth.txt")).poses_world_camera
    truth = open_sequence(folder).groundtruth
    np.testing.assert_allclose(truth.poses_world_camera, expected, atol=1e-12)


def test_an_icl_archive_is_brought_to_tum_layout(server, tmp_path):
    """A point's image row with fy < 0 must be kept in the mirrored world with fy > 0."""
    recording = Recording(
        "icl-nuim/tiny", f"{server.url}/icl.tar.gz", layout="icl-nuim", camera=CAMERA
    )
    folder = obtain(recording, tmp_path)
    sequence = open_sequence(folder)
    truth = read_tum(folder / "groundtruth.txt")
    np.testing.assert_allclose(
        [f.timestamp_s for f in sequence.frames(prefetch=0)], [0, 1 / 30], atol=1e-6
    )
    np.testing.assert_allclose(truth.timestamps_s, [0, 1 / 30], atol=1e-6)
    published = read_tum(folder / "livingRoom0.gt.freiburg").poses_world_camera[1]
    point = np.array([0.3, 0.4, 2.0, 1.0])
    x, y, z, _ = np.linalg.inv(published) @ point
    mirrored = point * [1, -1, 1, 1]
    u, v, w, _ = np.linalg.inv(truth.poses_world_camera[1]) @ mirrored
    fx, fy = CAMERA["fx"], CAMERA["fy"]
    np.testing.assert_allclose([fx * u / w, fy * v / w], [fx * x / z, -fy * y / z], atol=1e-6)
    assert np.linalg.det(truth.poses_world_camera[1][:3, :3]) == pytest.approx(1)


def test_an_archive_without_lists_leaves_only_the_archive(server, tmp_path):
    with pytest.raises(InputError, match=r"holds no rgb\.txt"):
        obtain(Recording("x/none", f"{server.url}/none.tgz"), tmp_path)
    assert [path.name for path in (tmp_path / "x").iterdir()] == ["none.tgz"]


def write_catalogue(path: Path, url: str, size: int) -> Path:
    lines = ("tum:", "  title: Tiny", f"  archive: {url}/{{name}}.tgz",
             f"  sequences: {{tiny: {{size: {size}}}}}")  # fmt: skip
    path.write_text("\n".join(lines))
    return path


def test_the_command_prints_the_sequence_folder(server, tmp_path, capsys):
    catalogue = write_catalogue(tmp_path / "c.yaml", server.url, len(server.files["tiny.tgz"]))
    words = ["download", "tum/tiny", "--to", str(tmp_path / "to"), "--catalogue", str(catalogue)]
    assert main(words) == 0
    out = capsys.readouterr()
    assert f"Sequence {tmp_path}/to/tum/tiny" in out.out
    assert main(["download", "tum/tin", "--catalogue", str(catalogue)]) == 1
    assert "did you mean tum/tiny?" in capsys.readouterr().err
    assert main(["download"]) == 1


@pytest.mark.parametrize("key", ["../../victim", "..", "a\\0b"])
def test_a_catalogue_names_nothing_outside_its_folder(key, tmp_path):
    catalogue = tmp_path / "c.yaml"
    catalogue.write_text(f'tum: {{archive: "https://x/a.tgz", sequences: {{"{key}": {{}}}}}}')
    with pytest.raises(InputError, match=r"leads out of the folder|is no file name|no web addr"):
        read_catalogue(catalogue)


def test_the_shipped_catalogue_is_sound(capsys):
    catalogue = read_catalogue()
    for recording in catalogue.values():
        assert recording.url.startswith("https://")
        assert recording.url.endswith((".tgz", ".zip", ".tar.gz"))
        assert len(recording.sha256) in (0, 64)
        assert "{" not in recording.url
    assert find(catalogue, "tum/freiburg1_xyz").url == (
        "https://cvg.cit.tum.de/rgbd/dataset/freiburg1/rgbd_dataset_freiburg1_xyz.tgz"
    )
    assert main(["download", "--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(catalogue)


def test_sequences_of_shipped_experiments_are_in_the_catalogue():
    catalogue = read_catalogue()
    files = sorted(data_path("experiments").glob("*.yaml"))
    named = {s.folder for file in files for s in read_experiment(file).sequences if s.folder}
    assert named
    assert named <= set(catalogue)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("- a", "not a catalogue"),
        ("a: {}", r"a\.sequences: field required"),
        ("a: {sequences: {}, arhive: x}", r"a\.arhive: extra inputs"),
        ("a: {layout: kitti, sequences: {}}", "layout"),
        ("a: {archive: 'file:///etc/passwd', sequences: {b: {}}}", "no web address"),
        (
            "a: {archive: 'https://x', sequences: {b: {md5: 0}}}",
            r"a\.sequences\.b\.md5: extra",
        ),
    ],
)
def test_a_catalogue_of_another_form_is_refused(text, reason, tmp_path):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InputError, match=reason):
        read_catalogue(tmp_path / "c.yaml")
