"""Every reader of files, with small good files for it: the table of what `make fuzz` tries."""

from __future__ import annotations

import io
import json
import random
import struct
import tarfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import PIL.Image
import torch
from engine import NUMBERS, TOKENS, Make, Reader
from fake_run import CAMERA as SMALL_CAMERA
from fake_run import FakeSystem, make_sequence
from recorded_bags import write_bag
from ros2_messages import example_message
from safetensors.torch import save
from small_comparison import make_comparison
from small_layouts import SMALL_LAYOUTS, SmallLayout, write_small
from synthetic_view import CAMERA, render_or_black

from bmask_slam.comparison.experiment.experiment_file import read_experiment
from bmask_slam.comparison.experiment.result import read_results, write_results
from bmask_slam.comparison.jobs.job import read_record
from bmask_slam.comparison.report.curves import read_losses, read_precision
from bmask_slam.config.configuration import dump, resolve
from bmask_slam.datasets.catalogue import read_catalogue
from bmask_slam.datasets.obtain import read_sums
from bmask_slam.datasets.unpack import unpack
from bmask_slam.dense.folder import LABEL_FILE, DenseFolder
from bmask_slam.dense.growing.store import FRAME_FILE, FrameStore
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.evaluation import frame_stamps
from bmask_slam.evaluation.reference import TruthBody, find_truth_body
from bmask_slam.events import read_events
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, write_arrays
from bmask_slam.graph.files.ply import read_ply, write_ply
from bmask_slam.graph.g2o.landmark_graphs import write_landmark_graph
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.g2o.pose_graphs import read_g2o
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.sensors.streams import read_measurements
from bmask_slam.graph.smoother.storage import GRAPH_FILE, graph_arrays, read_graph
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.graph.trajectory_formats import (
    read_times,
    read_trajectory,
    write_euroc,
    write_kitti,
)
from bmask_slam.live.network.connection import read_token
from bmask_slam.live.ros2.outputs import Ros2Frames
from bmask_slam.live.ros2.sensors import ImageClock, Ros2Sensors
from bmask_slam.live.ros2.tf import TF, RobotFrames
from bmask_slam.live.ros2.transport import decoded, typestore
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.live.sources.growing_folder import FollowOptions, GrowingFolder
from bmask_slam.mapping.inverse_depth.depth_map import DEPTH_FILE, read_depth_map
from bmask_slam.mapping.products.submaps import SUBMAP_FILE, read_submap
from bmask_slam.offline.checkpoint import CHECKPOINT_FILE, read_checkpoint
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.run_folder.covariance_file import read_covariances
from bmask_slam.run_folder.frame_file import read_frames
from bmask_slam.run_folder.landmark_file import read_dense_cloud, read_landmarks, read_markers
from bmask_slam.run_folder.map_file import MAP_FILE, read_map
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.run_folder.semantic_files import read_labels, read_objects
from bmask_slam.semantics.beliefs.class_sizes import read_sizes
from bmask_slam.semantics.beliefs.movability import read_priors
from bmask_slam.semantics.instances.coco_files import read_coco
from bmask_slam.semantics.instances.image_files import decode_image, read_colour
from bmask_slam.semantics.instances.surface_files import read_surfaces, surface_labels
from bmask_slam.semantics.labels import label_set, read_label_set
from bmask_slam.semantics.segmenters.mask_cache import CacheOptions, cache_masks
from bmask_slam.semantics.segmenters.segmenter import LabelImageSegmenter, NoSegmenter
from bmask_slam.semantics.weights.checkpoints import load_network, read_state
from bmask_slam.semantics.weights.light_weights import load_light
from bmask_slam.semantics.weights.stuff_weights import load_stuff
from bmask_slam.semantics.weights.yolox_onnx import load_onnx
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.bags.ros_images import (
    camera_of,
    colour_image,
    depth_image,
    stamp_s,
)
from bmask_slam.sequences.bags.sensors import SensorTopics
from bmask_slam.sequences.bags.transforms import static_extrinsics
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.lists import read_associations, read_pairs
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

CONFIG = resolve(
    SystemConfig,
    None,
    ("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0", "features.max_keypoints=250"),
)
WAIT = FollowOptions(silence_s=0.0, image_timeout_s=0.0, poll_s=0.0)


# --- good files ----------------------------------------------------------------------------------


def written(folder: Path, write: Callable[[Path], Any]) -> bytes:
    """What a function writes to a path."""
    path = folder / "written"
    write(path)
    return path.read_bytes()


def circle() -> Trajectory:
    """Five poses."""
    poses = np.stack([se3_exp(np.array([0, 0.3 * k, 0, 0.1 * k, 0, 0])) for k in range(5)])
    return Trajectory(1.0 + np.arange(5) / 10, poses)


def small_system() -> SlamSystem:
    """After five keyframes."""
    system = SlamSystem(CAMERA, CONFIG)
    for k in range(5):
        system.process(render_or_black(se3_exp(np.array([0, 0, 0, 0.03 * k, 0, 0])), k))
    return system


def run_files(folder: Path) -> dict[str, bytes]:
    """The files of a run with a checkpoint in it, by name."""
    sequence, out = make_sequence(folder / "seq", 8), folder / "run"

    class Stopping(FakeSystem):
        """A system whose results cannot be written, so that the checkpoint stays."""

        def finish(self) -> None:
            raise KeyError("stopped")

    options = RunOptions(sequence, out=out, quiet=True, checkpoint_every=4)
    with suppress(KeyError):
        run(options, Stopping)
    return {path.name: path.read_bytes() for path in out.iterdir()}


def coco() -> bytes:
    """A polygon, plain and compressed run lengths."""
    masks = [
        [[1, 1, 6, 1, 6, 6, 1, 6]],
        {"size": [8, 10], "counts": [3, 70, 7]},
        {"size": [8, 10], "counts": "0P2"},
    ]
    rows = [
        {"id": k, "image_id": 1, "category_id": 2, "segmentation": m, "score": 0.5, "iscrowd": 0}
        for k, m in enumerate(masks)
    ]
    image = {"id": 1, "file_name": "a/1.png", "height": 8, "width": 10}
    return json.dumps(
        {"images": [image], "annotations": rows, "categories": [{"id": 2, "name": "cup"}]}
    ).encode()


def objects() -> bytes:
    box = {"centre_world_m": [0, 0, 1], "axes_world": np.eye(3).tolist(), "size_m": [1, 1, 1]}
    row = {
        "id": 0, "label": "cup", "probability": 0.5, "centroid_world_m": [0, 0, 1], "box": box,
        "keyframes": [0, 2], "landmarks": [1, 5], "first_seen_s": 0.0, "last_seen_s": 1.0,
    }  # fmt: skip
    return json.dumps({"labels": ["unknown", "cup"], "objects": [row]}).encode()


def markers() -> bytes:
    pose = np.eye(4).tolist()
    row = {"id": 3, "size_m": 0.2, "T_world_marker": pose, "seen": 4, "used": 3}
    return json.dumps(
        {"dictionary": "4X4_50", "T_world_site": pose, "markers": [row, row | {"size_m": None}]}
    ).encode()


def images() -> tuple[bytes, ...]:
    colour = np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3)
    depth = np.full((24, 32), 1500, np.uint16)
    pairs = [(suffix, colour) for suffix in (".png", ".jpg", ".bmp", ".webp", ".ppm")]
    pairs += [(suffix, depth) for suffix in (".png", ".tiff")]
    return tuple(cv2.imencode(suffix, picture)[1].tobytes() for suffix, picture in pairs)


def surface_images() -> tuple[bytes, ...]:
    """Of an image of 24 rows and 32 columns: a wall above a floor."""
    codes = np.repeat(np.array([[256 + 200], [512 + 100], [512 + 255]], np.uint16), 4, axis=1)
    return (cv2.imencode(".png", codes)[1].tobytes(),)


def archives() -> tuple[bytes, ...]:
    packed = []
    for mode in ("w", "w:gz", "w:bz2", "w:xz"):
        out = io.BytesIO()
        with tarfile.open(fileobj=out, mode=mode) as tar:
            for name in ("seq/rgb.txt", "seq/rgb/1.png"):
                info = tarfile.TarInfo(name)
                info.size = 4
                tar.addfile(info, io.BytesIO(b"abcd"))
        packed.append(out.getvalue())
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as zipped:
        zipped.writestr("seq/rgb.txt", "abcd" * 20)
        zipped.writestr("seq/rgb/1.png", "abcd")
    return (*packed, out.getvalue())


def bags(folder: Path) -> dict[str, bytes]:
    """Bags of one frame: ROS 1, mcap, and a folder's metadata and database."""
    one, mcap = write_bag(folder / "a.bag", 1), write_bag(folder / "a.mcap", 1)
    both = write_bag(folder / "bag", 1)
    data = next(both.glob("*.db3"))
    found = {"a.bag": one, "a.mcap": mcap, "metadata.yaml": both / "metadata.yaml", "a.db3": data}
    return {name: path.read_bytes() for name, path in found.items()} | {"db": data.name.encode()}


def weights() -> tuple[bytes, ...]:
    tensors = {"a.weight": torch.zeros(2, 3), "a.bias": torch.ones(2)}
    metadata = {"network": json.dumps(LIGHT), "labels": '["b", "c", "d"]'}
    return save(tensors), save(tensors, metadata)


def pickled(folder: Path) -> tuple[bytes, ...]:
    state = {"a.weight": torch.zeros(2, 3), "a.bias": torch.ones(2)}
    return tuple(
        written(folder, partial(torch.save, content, _use_new_zipfile_serialization=new))
        for content in (state, {"model": state})
        for new in (True, False)
    )


def messages() -> tuple[bytes, ...]:
    """A colour image, a depth image, a compressed one and a CameraInfo, as JSON."""
    raw = {"height": 2, "width": 3, "is_bigendian": 0}
    depth = cv2.imencode(".png", np.full((2, 3), 1500, np.uint16))[1].tobytes()
    found = (
        {**raw, "encoding": "rgb8", "step": 9, "data": bytes(18).hex()},
        {**raw, "encoding": "16UC1", "step": 6, "data": bytes(12).hex()},
        {**raw, "encoding": "32FC1", "step": 12, "data": bytes(24).hex()},
        {"format": "16UC1; compressedDepth png", "data": (bytes(12) + depth).hex()},
        {"format": "png", "data": depth.hex()},
        {"height": 24, "width": 32, "distortion_model": "plumb_bob", "d": [0.0] * 5,
         "k": [30.0, 0, 15, 0, 30, 12, 0, 0, 1], "p": [30.0, 0, 15, 0, 0, 30, 12, 0, 0, 0, 1, 0]},
    )  # fmt: skip
    return tuple(json.dumps(message).encode() for message in found)


MESSAGES = messages()
LIGHT: dict[str, Any] = {
    "classes": 3, "backbone": "mobilenet_v2", "norm": "none", "channels": 8, "box_hidden": 8,
    "mask_channels": 8, "image": {"short_px": 64}, "anchors": {"ratios": [0.5, 1.0]},
}  # fmt: skip


# --- structures ----------------------------------------------------------------------------------

WRONG: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 10**12, 2**62, 2**63, 10**30, 0.5, 1e308, float("inf"), float("nan")),
    *("", "a", "..", "../x", "/x", "a\0b", "x" * 300, "²", [], {}, [[]], {"a": 1}, [1] * 100),
)


def changed_tree(tree: Any, rng: random.Random) -> Any:
    """A document with one of its values replaced, doubled or removed."""
    if not isinstance(tree, (dict, list)) or not tree or rng.random() < 0.1:
        return rng.choice(WRONG)
    copy: Any = tree.copy()
    key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
    action = rng.random()
    if action < 0.1:
        del copy[key]
    elif action < 0.15 and isinstance(copy, list):
        copy.insert(key, copy[key])
    elif action < 0.2 and isinstance(copy, dict):
        copy[str(rng.choice(WRONG))] = rng.choice(WRONG)
    else:
        copy[key] = changed_tree(tree[key], rng)
    return copy


def json_maker(*seeds: bytes) -> Make:
    """Documents like those of JSON files, with one or two changes."""
    trees = [json.loads(seed) for seed in seeds]

    def make(rng: random.Random) -> bytes:
        tree = changed_tree(rng.choice(trees), rng)
        tree = changed_tree(tree, rng) if rng.random() < 0.3 else tree
        return json.dumps(tree).encode(errors="surrogatepass")

    return make


def array_maker(write: Callable[[Path, dict[str, Any], Arrays], None], header: dict[str, Any],
                arrays: Arrays, folder: Path) -> Make:  # fmt: skip
    """Array files with changed arrays and headers whose zip is sound."""
    path = folder / f"arrays-{id(arrays)}"

    def make(rng: random.Random) -> bytes:
        changed, head = dict(arrays), header
        for name in rng.sample(sorted(arrays), rng.choice((0, 1, 1, 2))):
            changed[name] = changed_array(arrays[name], rng)
        if rng.random() < 0.1 and changed:
            del changed[rng.choice(sorted(changed))]
        if rng.random() < 0.3:
            head = changed_tree(header, rng)
            head = head if isinstance(head, dict) else header
        write(path, head, changed)
        return path.read_bytes()

    return make


def changed_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """An array of another length, shape or type, or with impossible values."""
    action = rng.randrange(7)
    if action == 0 and array.ndim:
        return array[: rng.randrange(len(array) + 1)]
    if action == 1 and array.ndim and len(array):
        return np.concatenate([array, array[:1]])
    if action == 2:
        return array.reshape(-1)
    if action == 3 and array.dtype.kind != "U":
        return array.astype(rng.choice((np.float32, np.int32, np.uint8, "U3", bool)), copy=True)
    if action == 4:
        return array[None]
    other = np.array(array)
    if other.size and other.dtype.kind in "iuf":
        extremes: tuple[Any, ...] = (0, 1, 255)
        if other.dtype.kind == "f":
            extremes = (np.nan, np.inf, -1.0, 1e30)
        elif other.dtype == np.int64:
            extremes = (-7, 10**6, 10**12, 2**62)
        flat = other.reshape(-1)
        flat[rng.randrange(len(flat))] = rng.choice(extremes)
        other = flat.reshape(other.shape)
    return other


def zip_maker(rng: random.Random) -> bytes:
    """Zips and tars of odd members."""
    out = io.BytesIO()
    names = ["a", "a/b", "../a", "/a", "a" * 300, "a\0b", "", ".", "a//b", "A", "a\\b", "c:a", "ü"]
    if rng.random() < 0.5:
        with zipfile.ZipFile(out, "w") as zipped:
            for _ in range(rng.randrange(4)):
                info = zipfile.ZipInfo(rng.choice(names))
                info.external_attr = rng.choice((0, 0o120777, 0o40755, 0o100644)) << 16
                zipped.writestr(info, rng.choice((b"", b"abc", b"\0" * 5000)))
    else:
        with tarfile.open(fileobj=out, mode=rng.choice(("w", "w:gz"))) as tar:
            for _ in range(rng.randrange(4)):
                member = tarfile.TarInfo(rng.choice(names))
                member.type = rng.choice((b"0", b"5", b"2", b"1", b"3", b"x", b"L", b"S"))
                member.linkname, member.size = rng.choice(names), rng.choice((0, 3, 512))
                tar.addfile(member, io.BytesIO(b"a" * member.size))
    data = bytearray(out.getvalue())
    if rng.random() < 0.3 and data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def onnx_maker(rng: random.Random) -> bytes:
    """Messages of fields in fields."""

    def field(depth: int) -> bytes:
        number, kind = rng.randrange(1, 12), rng.choice((0, 2, 2, 2, 1, 5, 3))
        head = bytes([number << 3 | kind])
        if kind == 0:
            return head + rng.choice((b"\x01", b"\xff" * 9 + b"\x01", b"\x80" * 30))
        if kind != 2:
            return head + bytes(4 if kind == 5 else 8)
        content = b"".join(field(depth - 1) for _ in range(rng.randrange(4))) if depth else b"Conv"
        size = len(content) if rng.random() < 0.95 else rng.randrange(2000)
        return head + _varint(size) + content

    return b"".join(field(4) for _ in range(rng.randrange(3)))


def _varint(number: int) -> bytes:
    out = b""
    while number > 127:
        out, number = out + bytes([number & 127 | 128]), number >> 7
    return out + bytes([number])


def safetensors_maker(rng: random.Random) -> bytes:
    """A sound frame around a changed header."""
    tree = {
        "__metadata__": {"network": '{"classes": 3}', "labels": '["b", "c", "d"]'},
        "a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]},
    }
    header = json.dumps(changed_tree(tree, rng)).encode()
    return struct.pack("<Q", len(header)) + header + bytes(24)


def network_maker(rng: random.Random) -> bytes:
    """Weights whose configuration was changed."""
    metadata = {"network": json.dumps(changed_tree(LIGHT, rng)), "labels": '["b", "c", "d"]'}
    return save({"a": torch.zeros(1)}, metadata)


def label_image() -> bytes:
    return cv2.imencode(".png", np.arange(80, dtype=np.uint16).reshape(8, 10) % 3)[1].tobytes()


def palette_image() -> bytes:
    picture = PIL.Image.fromarray(np.arange(80, dtype=np.uint8).reshape(8, 10) % 3).convert("P")
    out = io.BytesIO()
    picture.save(out, "png")
    return out.getvalue()


def surfaces_maker(rng: random.Random) -> bytes:
    """Sound PNGs of any shape, depth and classes."""
    shape = tuple(rng.choice((1, 2, 3, 4, 6, 200)) for _ in range(2)) + rng.choice(((), (), (3,)))
    kind = rng.choice((np.uint16, np.uint16, np.uint8))
    value = rng.choice((0, 255, 256, 767, 1023, 1024, 65535))
    return cv2.imencode(".png", np.full(shape, value & np.iinfo(kind).max, kind))[1].tobytes()


def sizes_maker(rng: random.Random) -> bytes:
    """A line of a class with odd lengths and places."""
    parts = ("0.1", "2", "-1", ".inf", ".nan", "1e400", "true", "", "floor", "top", "moon", "[]")
    row = ", ".join(rng.choice(parts) for _ in range(rng.choice((1, 2, 3, 3, 3, 4))))
    return f"cup: {rng.choice((row, f'[{row}]', f'{{{row}}}'))}\n".encode()


def yaml_maker(rng: random.Random) -> bytes:
    """YAML of tokens in any order."""
    parts = (*TOKENS, *NUMBERS, b"a: ", b"tracking: ", b"\n", b"\n  ", b"- ", b"fx: ", b"| ", b"> ")
    return b"".join(rng.choice(parts) for _ in range(rng.randrange(1, 20)))


# --- readers that need more than a path ----------------------------------------------------------


def in_folder(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda path: read(path.parent)


def read_masks(path: Path) -> None:
    for image in read_coco(path).images:
        for found in image.objects:
            found.mask()


STUFF = label_set(("wall", "floor", "door"))


def read_surface_image(path: Path) -> None:
    folder = path.parent / "surfaces"
    folder.mkdir()
    (folder / "a.png").write_bytes(path.read_bytes())
    seen = read_surfaces(path.parent, "a.jpg", STUFF, (24, 32))
    assert seen is not None and seen.pixels().shape == (24, 32, 3)


def read_surface_names(path: Path) -> None:
    folder = path.parent / "surfaces"
    folder.mkdir()
    (folder / "classes.txt").write_bytes(path.read_bytes())
    surface_labels(path.parent)


def read_class_sizes(path: Path) -> None:
    with patch("bmask_slam.semantics.beliefs.class_sizes.data_path", lambda *parts: path):
        assert np.isfinite(read_sizes(label_set(("cup",))).typical_m).all()


def read_dense_settings(path: Path) -> None:
    folder = path.parent / "dense"
    folder.mkdir()
    (folder / "settings.json").write_bytes(path.read_bytes())
    DenseFolder.open(path.parent)


def read_evidence(path: Path) -> None:
    folder = path.parent / "dense" / "labels"
    folder.mkdir(parents=True)
    (folder / "000001").write_bytes(path.read_bytes())
    dense = DenseFolder.__new__(DenseFolder)
    dense.path = folder.parent
    dense.evidence(1)


def read_label_image(path: Path) -> None:
    labels = label_set(("b", "cup", "chair"))
    LabelImageSegmenter(path.parent, labels).segment(np.zeros((8, 10, 3), np.uint8), "a.png")


def read_mask_settings(path: Path) -> None:
    no_images: list[tuple[str, Path]] = []
    cache_masks(NoSegmenter(), no_images, CacheOptions(path.parent, {"name": "x"}), lambda *_: None)


EIGHT_BY_SIX = replace(CAMERA, width=8, height=6)


def read_frame(path: Path) -> None:
    folder = path.parent / "dense" / "frames"
    folder.mkdir(parents=True)
    (folder / "00000001").write_bytes(path.read_bytes())
    for number in FrameStore(folder.parent, EIGHT_BY_SIX, 1 << 20).places:
        FrameStore(folder.parent, EIGHT_BY_SIX, 1 << 20).load(number)


def restore(path: Path) -> None:
    SlamSystem(CAMERA, CONFIG).restore(read_map(path)[0], path)


def read_bag(path: Path) -> None:
    with open_bag(path) as bag:
        for _, message in bag.messages(*(topic.name for topic in bag.topics)):
            assert message


def bag_folder(database: bytes, name: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        folder = path.parent / "bag"
        folder.mkdir()
        (folder / name).write_bytes(database)
        (folder / "metadata.yaml").write_bytes(path.read_bytes())
        read_bag(folder)

    return read


def follow(path: Path) -> None:
    """A list of a folder that grows."""
    (path.parent / "depth.txt").write_bytes(path.read_bytes())
    (path.parent / "camera.yaml").write_text(SMALL_CAMERA)
    (path.parent / ".finished").touch()
    for _ in GrowingFolder(path.parent, options=WAIT).frames():
        pass


def read_first(path: Path) -> None:
    """Open a recording that is a file, and read a frame."""
    open_sequence(path).load(0)


LAYOUT_FILES = (
    ("7-Scenes", "frame-000001.pose.txt"),
    ("ScanNet", "intrinsic/intrinsic_depth.txt"),
    ("Replica", "cam_params.json"),
    ("Replica", "traj.txt"),
    ("ICL-NUIM", "livingRoom0.gt.freiburg"),
    ("EuRoC", "mav0/cam0/data.csv"),
    ("EuRoC", "mav0/depth0/sensor.yaml"),
    ("EuRoC", "mav0/state_groundtruth_estimate0/data.csv"),
    ("Open3D", "camera_intrinsic.json"),
    ("Polycam", "keyframes/cameras/1000000.json"),
)


def small_layout(name: str) -> SmallLayout:
    return next(small for small in SMALL_LAYOUTS if small.name == name)


def packed_file(layout: SmallLayout, folder: Path) -> bytes:
    return write_small(layout, folder).read_bytes()


def file_of(layout: str, file: str, folder: Path) -> bytes:
    """A file of a small recording in a layout."""
    parent = folder / file.replace("/", "-")
    return (write_small(small_layout(layout), parent) / file).read_bytes()


def in_layout(layout: str, file: str, path: Path) -> None:
    """A recording in a layout with another file in the place of one of its own."""
    data = path.read_bytes()
    path.unlink()
    whole = write_small(small_layout(layout), path.parent / "in")
    (whole / file).write_bytes(data)
    open_sequence(whole)


def open_folder(path: Path) -> None:
    """A sequence whose list it is."""
    (path.parent / "depth.txt").write_bytes(path.read_bytes())
    (path.parent / "camera.yaml").write_text(SMALL_CAMERA)
    read_pairs(path.parent, 0.02, 0.0)
    open_sequence(path.parent)


def as_text(read: Callable[[str], Any]) -> Callable[[Path], Any]:
    return lambda path: read(str(path))


def both_pictures(path: Path) -> None:
    decode_image(path, cv2.IMREAD_UNCHANGED)
    read_colour(path)


ROS_TYPES: dict[tuple[bool, bool], dict[str, type]] = {
    (True, False): {
        **{"height": int, "width": int, "distortion_model": str},
        **{"k": list, "d": list, "p": list},
    },
    (False, True): {"format": str, "data": str},
    (False, False): {
        **{"height": int, "width": int, "step": int, "is_bigendian": int},
        **{"encoding": str, "data": str},
    },
}


def is_float(value: object) -> bool:
    """Whether it can be a float64 of a message."""
    return isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**53)


def read_message(path: Path) -> None:
    """A ROS image or CameraInfo whose fields stand in a JSON file, data as hexadecimal digits."""
    try:
        fields = json.loads(path.read_text())
        message = SimpleNamespace(**fields)
        message.data = np.frombuffer(bytes.fromhex(fields.get("data", "")), np.uint8)
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError("no message") from error
    kinds = ROS_TYPES.get(("k" in fields, "format" in fields), {"none": str})
    wrong = [name for name, kind in kinds.items() if not isinstance(fields.get(name), kind)]
    counts = [value for value in fields.values() if isinstance(value, int)]
    if wrong or any(not 0 <= count < 2**32 for count in counts):
        raise InputError("not of the message's type")  # which rosbags would not give either
    for name, length in (("k", 9), ("p", 12), ("d", None)):
        row = fields.get(name, [0.0] * 12)
        listed = isinstance(row, list) and (length in (None, len(row)) or name not in fields)
        if not listed or not all(map(is_float, row)):
            raise InputError("not of the message's type")
    if hasattr(message, "k"):
        for rectified in (False, True):
            camera_of(message, 1000.0, rectified, "here")
        return
    for read in (colour_image, depth_image):
        with suppress(InputError):
            read(message, "here")


WIRE = {
    "sensor_msgs/msg/Imu": "imu", "nav_msgs/msg/Odometry": "odometry",
    "sensor_msgs/msg/NavSatFix": "position", "tf2_msgs/msg/TFMessage": "/tf_static",
    "sensor_msgs/msg/CameraInfo": "", "sensor_msgs/msg/CompressedImage": "",
}  # fmt: skip
"""Types of messages that come over DDS, and what hears them."""


def wire() -> tuple[bytes, ...]:
    """The bytes of such messages, after a byte for the type."""
    rng = np.random.default_rng(0)
    return tuple(
        bytes([k]) + bytes(typestore().serialize_cdr(example_message(name, rng), name))
        for k, name in enumerate(WIRE)
    )


def hear(path: Path) -> None:
    """Bytes as they come over DDS, to sensors and tf."""
    data = path.read_bytes()
    name = list(WIRE)[data[0] % len(WIRE)] if data else "sensor_msgs/msg/Imu"
    message = decoded(data[1:], name)
    if message is None:
        raise InputError("not of the message's type")
    if WIRE[name] == "/tf_static":
        bag: Any = SimpleNamespace(path=path, messages=lambda _: [("/tf_static", message)])
        static_extrinsics(bag, "a", "b")
        reader = SimpleNamespace(take=lambda _: [message])
        node: Any = SimpleNamespace(published=lambda: {TF: name}, reader=lambda *_: reader)
        RobotFrames(node, "here", lambda: [message]).odometry("ab", "abc", 0.0)
    elif WIRE[name]:
        reader = SimpleNamespace(broken=0, take=lambda _: [message, message])
        node = SimpleNamespace(published=lambda: {"/s": name}, reader=lambda *_: reader)
        sensors = Ros2Sensors(node, SensorTopics(**{WIRE[name]: "/s"}), 0.0)
        sensors.take(ImageClock(stamp_s(message.header), 0.0))


def follow_bag(path: Path) -> None:
    for _ in BagSource(path).frames():
        pass


def unpacked(path: Path) -> None:
    unpack(path, path.parent / "out")
    inside = (path.parent / "out").resolve()
    for found in inside.rglob("*"):
        assert not found.is_symlink() and found.resolve().is_relative_to(inside)


# --- the table -----------------------------------------------------------------------------------


def text_readers(folder: Path) -> list[Reader]:
    """Lists, trajectories, graphs and tables."""
    path, files = circle(), run_files(folder)
    tum = written(folder, lambda p: write_tum(p, path))
    kitti = written(folder, lambda p: write_kitti(p, path.poses_world_camera))
    euroc = written(folder, lambda p: write_euroc(p, path))
    listed = b"# time file\n0.1 rgb/1.png\n0.2 rgb/2.png\n0.3 rgb/3.png\n"
    pairs = b"0.1 rgb/1.png 0.11 depth/1.png\n0.2 rgb/2.png 0.2 depth/2.png\n"
    identity = b"0 0 0 0 0 0 1 "
    upper = b" ".join(b"1" if a == b else b"0" for a in range(6) for b in range(a, 6))
    poses = b"".join(b"VERTEX_SE3:QUAT %d %s\n" % (k, identity) for k in range(3))
    spatial = poses + b"EDGE_SE3:QUAT 0 1 %s%s\nFIX 0\n" % (identity, upper)
    planar = b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    row = b"0 1.0 " + b" ".join(b"1e-6" if w == b"1" else b"0" for w in upper.split()) + b"\n"
    labels = b"id,label,probability,entropy,views\n3,cup,0.9,0.1,4\n8,unknown,1,0,2\n"
    losses = b"step,loss,value\n0,rpn,1.5\n1,rpn,1.0\n0,box,2\n1,box,1\n"
    curves = b"kind,ranked_by,recall,precision\nsegm,score,0.0,1.0\nsegm,score,0.5,0.7\n"
    return [
        Reader("TUM trajectory", "a.txt", read_tum, (tum,)),
        Reader("odometry", "a.txt", lambda p: read_measurements(p, "odometry"), (tum,)),
        Reader("position", "a.txt", lambda p: read_measurements(p, "position"),
               (b"1.0 2 3 4 0.5\n2.0 2 3 4\n",)),
        Reader("accelerometer", "a.txt", lambda p: read_measurements(p, "accelerometer"),
               (b"1.0 0.1 9.8 0.2\n2.0 0.1 9.8 0.1\n",)),
        Reader("IMU", "imu.csv", lambda p: read_measurements(p, "imu"),
               (b"#timestamp\n1000000000,0.1,0,0,0,9.8,0\n1005000000,0.1,0,0,0,9.8,0\n",)),
        Reader("any trajectory", "a.txt", partial(read_trajectory, stamps_s=path.timestamps_s),
               (tum, kitti, euroc)),
        Reader("stamps", "times.txt", read_times, (b"0.1\n0.2\n0.3\n", tum)),
        Reader("rgb.txt", "rgb.txt", open_folder, (listed,)),
        Reader("associations.txt", "associations.txt", read_associations, (pairs,)),
        Reader("growing list", "rgb.txt", follow, (listed,)),
        Reader("g2o pose graph", "a.g2o", read_g2o, (spatial, planar)),
        Reader("frames.csv", "frames.csv", read_frames, (files["frames.csv"],)),
        Reader("frames.csv, stamps", "frames.csv",
               lambda p: frame_stamps(p.parent / "trajectory.txt"), (files["frames.csv"],)),
        Reader("events.csv", "events.csv", in_folder(read_events), (files["events.csv"],)),
        Reader("covariances.txt", "covariances.txt", read_covariances, (row,)),
        Reader("labels.csv", "labels.csv", in_folder(read_labels), (labels,)),
        Reader("losses.csv", "losses.csv", read_losses, (losses,)),
        Reader("precision_recall.csv", "p.csv", read_precision, (curves,)),
        Reader("label set", "labels.txt", as_text(read_label_set), (b"cup\n# no\nN/A\nchair\n",)),
        Reader("classes of surfaces", "c.txt", read_surface_names, (b"wall\nfloor\n# no\ndoor\n",)),
        Reader("token", "token", read_token, (b"abcdefghijklmnopqrstuvwxyz\n",)),
        Reader("SHA256SUMS", "SHA256SUMS", read_sums, (b"ab  a.tgz\ncd  b.tgz\n",)),
        Reader("config.yaml's sequence", "config.yaml", in_folder(find_sequence),
               (b"# bmask-slam 0.1, sequence /nowhere/s, stride 1\n",)),
    ]  # fmt: skip


def document_readers(folder: Path) -> list[Reader]:
    """YAML and JSON."""
    priors = b"unknown: 0.1\nother: 0.2\nperson: 0.9\n"
    sets = b'tum: {archive: "https://x/{name}.tgz", sequences: {a: {size: 5}, b: {}}}\n'
    experiment = (
        b"sequences: {office: {render: {name: office, frames: 5}}, own: somewhere}\n"
        b"configurations: {default: {}, other: {set: [loops.enabled=false]}}\nseeds: [0, 1]\n"
        b"published: {Paper: {source: x, ate_rmse: {own: 0.01}}}\n"
    )
    metrics = b'[{"name": "ate", "value": 0.5, "unit": "m"}]'
    record = b'{"status": "done", "error": "", "wall_s": 1.5, "figures": {"a": 1.0}, "depends": {}}'
    settings = b'{"method": 3, "labels": ["background"], "voxel_m": 0.01, "without": []}'
    results = written(folder, lambda p: write_results(p, make_comparison(folder)))
    part = {"sequence": str(make_sequence(folder / "part", 3)), "begin_s": 0.0, "end_s": 0.2}
    joined = json.dumps({"recordings": [part | {"shift_s": s} for s in (0.0, 11.0)]}).encode()

    def of_json(name: str, file: str, read: Callable[[Path], Any], seed: bytes) -> Reader:
        return Reader(name, file, read, (seed,), json_maker(seed))

    return [
        Reader("camera.yaml", "camera.yaml", read_camera, (SMALL_CAMERA.encode(),), yaml_maker),
        Reader("configuration", "c.yaml", lambda p: resolve(SystemConfig, p),
               (dump(CONFIG).encode()[:1500], b"tracking: {min_inliers: 20}\n"), yaml_maker),
        Reader("ROS 2 parameters", "p.yaml", lambda p: resolve(Ros2Frames, p),
               (b"base: base_link\nprefix: /slam\n",), yaml_maker),
        Reader("groundtruth.yaml", "groundtruth.yaml", in_folder(find_truth_body),
               (TruthBody().yaml().encode(),), yaml_maker),
        Reader("movability priors", "p.yaml", as_text(read_priors), (priors,), yaml_maker),
        Reader("sizes of classes", "s.yaml", read_class_sizes, (b"cup: [0.1, 0.2, top]\n",),
               sizes_maker),
        Reader("catalogue", "c.yaml", read_catalogue, (sets,), yaml_maker),
        Reader("experiment", "e.yaml", read_experiment, (experiment,), yaml_maker),
        of_json("COCO", "annotations.json", read_masks, coco()),
        of_json("settings of masks", "settings.json", read_mask_settings, b'{"name": "x"}'),
        of_json("objects.json", "objects.json", in_folder(read_objects), objects()),
        of_json("markers.json", "markers.json", read_markers, markers()),
        of_json("metrics.json", "metrics.json", in_folder(lambda p: Run(p).metrics), metrics),
        of_json("results.json", "results.json", read_results, results),
        of_json("recordings.json", "recordings.json", read_first, joined),
        of_json("record of a job", "cell.json", read_record, record),
        of_json("dense/settings.json", "s.json", read_dense_settings, settings),
    ]  # fmt: skip


def array_readers(folder: Path) -> list[Reader]:
    """Saved graphs, maps and checkpoints, dense maps, point clouds."""
    system, rng = small_system(), np.random.default_rng(0)
    smoother = system.mapper.smoother
    header = json.loads(json.dumps({"camera": CAMERA.__dict__}))
    points = rng.random((6, 3)).astype(np.float32)
    submap = {
        "points": points, "normals": points, "colours": np.zeros((6, 3), np.uint8),
        "variances": points[:, 0], "instances": np.zeros(6, np.uint16),
    }  # fmt: skip
    image = np.ones((6, 8), np.uint16)
    packed = (cv2.imencode(".png", image)[1], cv2.imencode(".jpg", np.zeros((6, 8, 3)))[1])
    evidence = {
        "log_likelihoods": np.zeros((3, 4), np.float32),
        "landmark_ids": np.arange(3), "landmark_instances": np.ones(3, np.uint16),
        "stuff": np.zeros((2, 2), np.float32),
    }  # fmt: skip

    def of_arrays(
        name: str, read: Any, kind: FileKind, head: dict[str, Any], arrays: Arrays, file: str = "1"
    ) -> Reader:
        def write(path: Path, head: dict[str, Any], arrays: Arrays) -> None:
            write_arrays(path, replace(kind, compressed=False), head, arrays)

        seed = written(folder, lambda p: write(p, head, arrays))
        return Reader(name, file, read, (seed,), array_maker(write, head, arrays, folder))

    checkpoint = run_files(folder / "again")["checkpoint"]
    head, arrays = _opened(checkpoint, folder)
    landmarks = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2],
                 "red": np.zeros(6, np.uint8), "green": np.zeros(6, np.uint8),
                 "blue": np.zeros(6, np.uint8), "observations": np.ones(6, np.int32),
                 "id": np.arange(6, dtype=np.int32), "label": np.ones(6, np.int32),
                 "probability": points[:, 0], "entropy": points[:, 1], "nx": points[:, 0],
                 "ny": points[:, 1], "nz": points[:, 2], "sigma": points[:, 0]}  # fmt: skip
    cloud = written(folder, lambda p: write_ply(p, landmarks))
    graph = written(folder, lambda p: write_landmark_graph(p, smoother.tables, CAMERA))
    state = system.state()
    return [
        of_arrays("saved graph", read_graph, GRAPH_FILE, header, graph_arrays(smoother.tables)),
        of_arrays("saved map", restore, MAP_FILE, header, state),
        of_arrays("saved map, mapped", in_folder(read_saved_map), MAP_FILE, header, state, "map"),
        of_arrays("checkpoint", _checkpoint(folder), CHECKPOINT_FILE, head, arrays, "checkpoint"),
        of_arrays("submap", read_submap, SUBMAP_FILE, {"anchor": 1}, submap),
        of_arrays("fused depth", read_depth_map, DEPTH_FILE, {},
                  {"rho": image, "sigma": image}),
        of_arrays("keyframe labels", read_evidence, LABEL_FILE, {"stuff": ["wall", "floor"]},
                  evidence),
        of_arrays("surface frame", read_frame, FRAME_FILE, {},
                  {"depth": packed[0].reshape(-1), "colours": packed[1].reshape(-1),
                   "T_reference_camera": np.eye(4), "follows": np.zeros(2, np.int64)}),
        Reader("PLY", "a.ply", read_ply, (cloud,)),
        Reader("landmarks.ply", "a.ply", lambda p: read_landmarks(p, ("unknown", "cup")), (cloud,)),
        Reader("dense/cloud.ply", "a.ply", lambda p: read_dense_cloud(p, ("b", "cup")), (cloud,)),
        Reader("g2o with landmarks", "a.g2o", read_landmark_graph, (graph[:6000], graph)),
    ]  # fmt: skip


def _opened(checkpoint: bytes, folder: Path) -> tuple[dict[str, Any], Arrays]:
    path = folder / "opened"
    path.write_bytes(checkpoint)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    head = json.loads(str(arrays.pop("header")))
    return {k: v for k, v in head.items() if k not in ("format", "version", "arrays")}, arrays


def _checkpoint(folder: Path) -> Callable[[Path], None]:
    config = (folder / "again" / "run" / "config.yaml").read_bytes()

    def read(path: Path) -> None:
        (path.parent / "config.yaml").write_bytes(config)
        read_checkpoint(path.parent)

    return read


def binary_readers(folder: Path) -> list[Reader]:
    """Images, archives, bags, weights."""
    packed, recorded = archives(), bags(folder)
    database = bag_folder(recorded["a.db3"], recorded["db"].decode())
    return [
        Reader("image", "1.png", both_pictures, images()),
        Reader("label image", "a.png", read_label_image, (label_image(), palette_image())),
        Reader("surfaces", "1.png", read_surface_image, surface_images(), surfaces_maker),
        Reader("archive", "a.tgz", unpacked, packed, zip_maker),
        Reader("ROS 1 bag", "a.bag", read_bag, (recorded["a.bag"],)),
        Reader("bag as a sequence", "a.bag", read_first, (recorded["a.bag"],)),
        *(
            Reader(small.name, small.file, read_first, (packed_file(small, folder),))
            for small in SMALL_LAYOUTS
            if Path(small.file).suffix
        ),
        *(
            Reader(
                f"{layout}: {file}",
                Path(file).name,
                partial(in_layout, layout, file),
                (file_of(layout, file, folder),),
            )
            for layout, file in LAYOUT_FILES
        ),
        Reader("bag as a source", "a.bag", follow_bag, (recorded["a.bag"],)),
        Reader("ROS message", "m.json", read_message, MESSAGES, json_maker(*MESSAGES)),
        Reader("ROS 2 over DDS", "m.cdr", hear, wire()),
        Reader("mcap", "a.mcap", read_bag, (recorded["a.mcap"],)),
        Reader("ROS 2 database", "a.db3", read_bag, (recorded["a.db3"],)),
        Reader("ROS 2 metadata", "metadata.yaml", database, (recorded["metadata.yaml"],)),
        Reader("safetensors", "w.safetensors", read_state, weights(), safetensors_maker),
        Reader("network of weights", "w.safetensors", load_network, weights()[1:], network_maker),
        Reader("head for stuff", "w.safetensors", load_stuff, weights(), safetensors_maker),
        Reader("light network", "w.safetensors", load_light, weights(), safetensors_maker),
        Reader("PyTorch weights", "w.pth", read_state, pickled(folder)),
        Reader("ONNX weights", "w.onnx", load_onnx, (b"",), onnx_maker),
    ]


def all_readers(folder: Path) -> list[Reader]:
    """The whole table; ``folder`` is for making the good files."""
    made = []
    for k, group in enumerate((text_readers, document_readers, array_readers, binary_readers)):
        (folder / str(k)).mkdir(parents=True)
        made += group(folder / str(k))
    return made
