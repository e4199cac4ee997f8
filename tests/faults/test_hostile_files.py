"""The smallest inputs that ended in a traceback, a hang or all memory: one clear error each."""

from __future__ import annotations

import io
import json
import os
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bmask_slam.config.configuration import resolve
from bmask_slam.datasets.unpack import unpack
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.map_run import remove_stored_frames
from bmask_slam.evaluation import frame_stamps
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files import reading
from bmask_slam.graph.files.array_file import FileKind, read_arrays, write_arrays
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.g2o.pose_graphs import read_g2o
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.graph.trajectory_formats import read_euroc, read_trajectory
from bmask_slam.mapping.inverse_depth.depth_map import DEPTH_FILE, read_depth_map
from bmask_slam.mapping.products.submaps import SUBMAP_FILE, read_submap
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.frame_file import read_frames
from bmask_slam.run_folder.reader import Run
from bmask_slam.run_folder.semantic_files import read_labels, read_objects
from bmask_slam.semantics.beliefs.movability import read_priors
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.labels import read_label_set
from bmask_slam.semantics.weights.checkpoints import load_network
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.lists import read_list
from bmask_slam.system_config import SystemConfig

DIGITS = b"9" * 5000
CAMERA = b"{width: 64, height: 48, fx: 50, fy: 50, cx: 31, cy: 23, depth_scale: 1000, fps: %s}\n"
FRAME_COLUMNS = b"index,timestamp,status,keyframe\n"
OBJECT = {
    "id": 0, "label": "cup", "probability": 0.5, "centroid_world_m": [0, 0, 1],
    "box": {"centre_world_m": [0, 0, 1], "axes_world": np.eye(3).tolist(), "size_m": [1, 1, 1]},
    "keyframes": [0], "landmarks": [1], "first_seen_s": 0.0, "last_seen_s": 1.0,
}  # fmt: skip
VIEW = b"""PARAMS_CAMERACALIB 0 0 0 0 0 0 0 1 500 500 320 240
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_TRACKXYZ 1 0 0 2
EDGE_PROJECT_DISPARITY 0 1 0 320 240 0.5 1 0 0 1 0 1
"""


def objects(**changes: Any) -> bytes:
    return json.dumps({"labels": ["unknown", "cup"], "objects": [{**OBJECT, **changes}]}).encode()


def in_run(reader: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """A reader of a run folder as one of its file."""
    return lambda path: reader(path.parent)


def configuration(path: Path) -> object:
    return resolve(SystemConfig, path)


def dense(path: Path) -> object:
    (path.parent / "dense").mkdir()
    path.rename(path.parent / "dense" / "settings.json")
    return DenseFolder.open(path.parent)


def alias_bomb(levels: int = 9) -> bytes:
    """Ten to the power of ``levels`` values."""
    lines = ["a0: &a0 [x,x,x,x,x,x,x,x,x,x]"]
    for k in range(1, levels):
        lines.append(f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]")
    return "\n".join(lines).encode()


FILES: dict[str, tuple[str, Callable[[Path], Any], bytes, str]] = {
    "EuRoC stamp of 400 digits": ("a.csv", read_euroc, b"1" * 400 + b",0,0,0,1,0,0,0", "no stamp"),
    "EuRoC stamp of 5000 digits": ("a.csv", read_trajectory, DIGITS + b",0,0,0,1,0,0,0", "is not"),
    "EuRoC stamp of other digits": ("a.csv", read_euroc, "²,0,0,0,1,0,0,0\n".encode(), "no stamp"),
    "a long quaternion": ("a.txt", read_tum, b"0 0 0 0 0 0 0 1e99\n", "a very long quaternion"),
    "KITTI of large numbers": ("a.txt", read_trajectory, b"1e99 " * 12, "no rotation"),
    "one endless line": ("a.txt", read_tum, b"1" * 100_000, "a line of 100000 characters"),
    "NUL in rgb.txt": ("rgb.txt", read_list, b"0.1 rgb/\0.png\n", "is no file name"),
    "300 letters in rgb.txt": ("rgb.txt", read_list, b"0.1 " + b"a" * 300, "too long"),
    "stamp of 5000 digits": ("rgb.txt", read_list, DIGITS + b" a.png", "not a finite number"),
    "g2o id of 5000 digits": ("a.g2o", read_g2o, b"VERTEX_SE2 " + DIGITS + b" 0 0 0", "vertex id"),
    "g2o FIX of 5000 digits": ("a.g2o", read_g2o, b"FIX " + DIGITS, "vertex id"),
    "g2o camera of nan": ("a.g2o", read_landmark_graph,
                          b"# bmask-slam camera nan nan 1 1 1 0 0 0 0 0\n" + VIEW, "'nan'"),
    "g2o camera of 1e99 px": ("a.g2o", read_landmark_graph,
                              b"# bmask-slam camera 1e99 1 1 1 1 0 0 0 0 0\n" + VIEW, "pixels"),
    "g2o offset of 5000 digits": ("a.g2o", read_landmark_graph,
                                  b"# bmask-slam landmarks " + DIGITS + b"\n" + VIEW, "whole"),
    "a date in camera.yaml": ("camera.yaml", read_camera, CAMERA % b"2026-99-99", "'2026-99-99'"),
    "!!int x in camera.yaml": ("camera.yaml", read_camera, CAMERA % b"!!int x", "camera.yaml"),
    "!!bool x": ("camera.yaml", read_camera, CAMERA % b"!!bool x", "camera.yaml"),
    "!!float ''": ("camera.yaml", read_camera, CAMERA % b"!!float ''", "camera.yaml"),
    "10^400 in camera.yaml": ("camera.yaml", read_camera, CAMERA % (b"1" + b"0" * 400), "401 dig"),
    "width of 10^99": ("camera.yaml", read_camera, (CAMERA % b"30").replace(b"64", b"1e99"), "pix"),
    "5000 digits in a config": ("c.yaml", configuration, b"tracking: " + DIGITS, "5000 digits"),
    "a set in a config": ("c.yaml", configuration, b"tracking: !!set {a, b}", "tag"),
    "bytes in a config": ("c.yaml", configuration, b"tracking: !!binary aaaa", "tag"),
    "a date in a config": ("c.yaml", configuration, b"tracking: 2026-99-99", "2026-99-99"),
    "deep YAML": ("c.yaml", read_yaml, b"- " * 5000, "nested more than"),
    "deep YAML by aliases": ("c.yaml", read_yaml, b"a0: &a0 [1]\n" + b"".join(
        b"a%d: &a%d [*a%d]\n" % (k, k, k - 1) for k in range(1, 900)), "nested more than"),
    "YAML that holds itself": ("c.yaml", read_yaml, b"&a [*a]", "nested more than"),
    "an alias bomb": ("c.yaml", read_yaml, alias_bomb(), "more than"),
    "a long YAML": ("c.yaml", read_yaml, b"a: 1\n" * 1_000_000, "GB"),
    "a date in priors": ("p.yaml", lambda p: read_priors(str(p)),
                         b"unknown: 0.1\nother: 2026-99-99", "no prior"),
    "deep priors": ("p.yaml", lambda p: read_priors(str(p)), b"- " * 5000, "nested more than"),
    "empty dense/settings.json": ("s.json", dense, b"", "settings.json: not JSON"),
    "a list as dense/settings.json": ("s.json", dense, b"[]", "object"),
    "deep dense/settings.json": ("s.json", dense, b'{"a":' * 9999, "settings.json: not JSON"),
    "no UTF-8 in labels.csv": ("labels.csv", in_run(read_labels), b"id,label\xff,probability\n",
                               "no column label"),
    "an id of 5000 digits in labels.csv": ("labels.csv", in_run(read_labels),
        b"id,label,probability,entropy,views\n" + DIGITS + b",cup,1,0,1\n", "whole number"),
    "a label of 200 kB": ("labels.csv", in_run(read_labels),
        b'id,label,probability,entropy,views\n1,"' + b"a" * 200_000 + b'",1,0,1\n', "no table"),
    "no UTF-8 in frames.csv": ("frames.csv", read_frames, FRAME_COLUMNS + b"\xff,0,OK,\n", "run"),
    "10^30 in frames.csv": ("frames.csv", read_frames, FRAME_COLUMNS + b"1%s,0,OK,\n" % (b"0" * 30),
                            "too large"),
    "no UTF-8 in the frames of an estimate": ("frames.csv",
        lambda path: frame_stamps(path.parent / "trajectory.txt"), b"timestamp\n\xff\n", "finite"),
    "objects.json with inf": ("objects.json", in_run(read_objects),
                              objects(first_seen_s=float("inf")), "finite"),
    "objects.json with 1e999": ("objects.json", in_run(read_objects),
        objects(first_seen_s=1).replace(b'"first_seen_s": 1', b'"first_seen_s": 1e999'), "finite"),
    "an object of id 10^30": ("objects.json", in_run(read_objects), objects(id=10**30), "id"),
    "a box of two axes": ("objects.json", in_run(read_objects),
        objects(box={**OBJECT["box"], "axes_world": [[1, 0, 0]]}), "axes_world"),
    "metrics.json with a text": ("metrics.json", in_run(lambda run: Run(run).metrics),
                                 b'[{"name": "a", "value": "b", "unit": "c"}]', "value"),
    "deep metrics.json": ("metrics.json", in_run(lambda run: Run(run).metrics),
                          b"[" * 9999, "not JSON"),
    "a label of 300 letters": ("labels.txt", lambda p: read_label_set(str(p)), b"a" * 300, "too"),
    "100 000 labels": ("labels.txt", lambda p: read_label_set(str(p)),
                       b"".join(b"%d\n" % k for k in range(100_000)), "more than 10000 classes"),
    "weights whose header is no JSON": ("w.safetensors", load_network,
                                        struct.pack("<Q", 9) + b"{\"a\": }  ", "not a whole"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "reader", "data", "words"), FILES.values(), ids=FILES)
def test_a_hostile_file_is_one_clear_error(
    tmp_path: Path, name: str, reader: Callable[[Path], Any], data: bytes, words: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        reader(path)
    assert words in str(caught.value)
    assert name in str(caught.value) or "settings.json" in str(caught.value)


def read_bag(path: Path) -> None:
    with open_bag(path):
        pass


def unpack_beside(path: Path) -> None:
    unpack(path, path.parent / "unpacked")


@pytest.mark.parametrize(
    "reader",
    [read_tum, read_list, read_yaml, read_colour, read_camera, read_bag, unpack_beside],
)
@pytest.mark.parametrize("name", ["pipe", "pipe.bag", "pipe.mcap", "pipe.db3"])
def test_a_pipe_is_not_waited_for(tmp_path: Path, reader: Callable[[Path], Any], name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=r"no plain file|no such|is no file"):
        reader(tmp_path / name)


def test_a_pipe_in_a_run_folder_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "dense").mkdir()
    os.mkfifo(tmp_path / "frames.csv")
    remove_stored_frames(tmp_path, tmp_path / "dense")
    with RunFolder(tmp_path, overwrite=True):
        assert not (tmp_path / "frames.csv").is_fifo()


# --- arrays --------------------------------------------------------------------------------------

KIND = FileKind("test", 1)


def npy(descr: str, shape: str, data: bytes = b"") -> bytes:
    """An array file with a header of our own."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize(
    "array",
    [
        npy("'<f8'", "(1000000000000,)"),
        npy("'<f8'", "(1000000000, 0, 1000000000)", b"\0" * 8),
        npy("'<U0'", "(1000000000000,)"),
        npy("'<f8'", "(-1,)"),
        npy("'|O'", "(1,)", b"\x80\x04."),
        npy("[('a', '<f8')]", "(1,)", b"\0" * 8),
        npy("'<f8'", "(" * 300 + ")" * 300),
        npy("'<f8", "(1,)"),
        b"\x93NUMPY\x09\x00",
        b"",
    ],
)
def test_an_array_is_as_large_as_its_header_says(tmp_path: Path, array: bytes) -> None:
    with zipfile.ZipFile(tmp_path / "map", "w") as zipped:
        zipped.writestr("a.npy", array)
    with pytest.raises(InputError, match="not a saved test, or a damaged one"):
        read_arrays(tmp_path / "map", KIND)


@pytest.fixture
def small_bombs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A megabyte stands for the 256 that a small file may unpack to."""
    monkeypatch.setattr(reading, "SMALL_BYTES", 1 << 20)


def test_a_small_zip_does_not_unpack_to_gigabytes(tmp_path: Path, small_bombs: None) -> None:
    size = 1 << 24
    with (
        zipfile.ZipFile(tmp_path / "map", "w", zipfile.ZIP_DEFLATED) as zipped,
        zipped.open("a.npy", "w") as file,
    ):
        file.write(npy("'|u1'", f"({size},)"))
        for _ in range(size >> 20):
            file.write(bytes(1 << 20))
    with pytest.raises(InputError, match="bytes that unpack to"):
        read_arrays(tmp_path / "map", KIND)


@pytest.mark.parametrize("header", ["[1]", "1", "[" * 99_999, '{"format": 1}', '{"arrays": 1e999}'])
def test_the_header_of_arrays(tmp_path: Path, header: str) -> None:
    with zipfile.ZipFile(tmp_path / "map", "w") as zipped, zipped.open("header.npy", "w") as file:
        np.save(file, np.array(header))
    with pytest.raises(InputError, match="not a saved test"):
        read_arrays(tmp_path / "map", KIND)


def test_a_submap_without_an_array(tmp_path: Path) -> None:
    arrays = {
        "points": np.zeros((4, 3), np.float32),
        "normals": np.zeros((4, 3), np.float32),
        "colours": np.zeros((4, 3), np.uint8),
        "variances": np.zeros(4, np.float32),
        "instances": np.zeros(4, np.uint16),
    }
    path = tmp_path / "000001"
    for name, array in arrays.items():
        write_arrays(path, SUBMAP_FILE, {"anchor": 1}, {k: arrays[k] for k in arrays if k != name})
        with pytest.raises(InputError, match=f"array '{name}' is missing"):
            read_submap(path)
        write_arrays(path, SUBMAP_FILE, {"anchor": 1}, {**arrays, name: array[:3]})
        with pytest.raises(InputError, match="different lengths"):
            read_submap(path)
    for anchor in ("one", None, float("inf")):
        write_arrays(path, SUBMAP_FILE, {"anchor": anchor}, arrays)
        with pytest.raises(InputError, match="its anchor"):
            read_submap(path)


def test_a_depth_map_without_an_array(tmp_path: Path) -> None:
    path, image = tmp_path / "000001", np.ones((4, 6), np.uint16)
    for arrays in ({"rho": image}, {"rho": image, "sigma": image[:3]}, {"rho": image[0]}):
        write_arrays(path, DEPTH_FILE, {}, arrays)
        with pytest.raises(InputError, match="000001"):
            read_depth_map(path)


# --- archives ------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder_first", [False, True])
@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_a_file_and_a_folder_of_one_name(tmp_path: Path, kind: str, folder_first: bool) -> None:
    names = ["a", "a/b"][:: -1 if folder_first else 1]
    path = tmp_path / f"archive.{kind}"
    if kind == "zip":
        with zipfile.ZipFile(path, "w") as zipped:
            for name in names:
                zipped.writestr(name, "content")
    else:
        with tarfile.open(path, "w") as tar:
            for name in names:
                info = tarfile.TarInfo(name)
                info.size = 7
                tar.addfile(info, io.BytesIO(b"content"))
    with pytest.raises(InputError, match=r"archive\.\w+: holds "):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_an_archive_that_unpacks_to_far_more(tmp_path: Path, kind: str, small_bombs: None) -> None:
    path, size = tmp_path / f"archive.{kind}", 1 << 24
    if kind == "zip":
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as zipped,
            zipped.open("a", "w") as out,
        ):
            for _ in range(size >> 20):
                out.write(bytes(1 << 20))
    else:
        with tarfile.open(path, "w:gz") as tar:
            info = tarfile.TarInfo("a")
            info.size = size
            with open("/dev/zero", "rb") as zeros:
                tar.addfile(info, zeros)
    with pytest.raises(InputError, match="bytes that unpack to"):
        unpack(path, tmp_path / "out")
    assert sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file()) < size
