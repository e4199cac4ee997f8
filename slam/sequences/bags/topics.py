"""Which topics of a bag are its colour and depth images, and of which cameras they are."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.bags.bag_file import IMAGE_TYPES, INFO_TYPE, Bag
from bmask_slam.sequences.bags.ros_images import (
    DEPTH_SCALES,
    camera_of,
    colour_image,
    depth_encoding,
    depth_image,
)
from bmask_slam.sequences.bags.transforms import sdk_extrinsics, static_extrinsics
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.sequences.cameras import given_camera, read_camera
from bmask_slam.sequences.checks import check_depth_scale, check_sizes
from bmask_slam.sequences.images import Lens
from bmask_slam.sequences.recording import DepthForm

logger = logging.getLogger(__name__)

SEPARATOR = "::"
REGISTERED = ("aligned", "registered", "depth_to_rgb", "depth_to_color")
"""In the names of topics of depth that is registered to colour."""
_FIELDS = {
    INFO_TYPE: {"width", "height", "distortion_model", "d", "k", "p"},
    IMAGE_TYPES[0]: {"header", "encoding", "height", "width", "step", "is_bigendian", "data"},
    IMAGE_TYPES[1]: {"header", "format", "data"},
}
_SDK = "/device_0/sensor_{}/{}_0/"
_SDK_COLOUR, _SDK_DEPTH = _SDK.format(1, "Color"), _SDK.format(0, "Depth")
_SDK_UNITS = "/device_0/sensor_0/option/Depth_Units/value"


@dataclass(frozen=True)
class BagTopics:
    """Topics of a bag's images; an empty name is found by KNOWN_TOPICS.

    Attributes:
        rgb, depth: topics of images, raw or compressed.
        camera_info: topic of the colour camera's intrinsics; empty: the ``camera_info`` beside the
            colour topic.
    """

    rgb: str = ""
    depth: str = ""
    camera_info: str = ""

    def of_path(self, path: Path) -> Path:
        """A path that names a bag and these topics: lab.bag::/rgb::/depth."""
        names = astuple(self)
        return Path(SEPARATOR.join([str(path), *names])) if any(names) else path


def split_path(path: Path) -> tuple[Path, BagTopics]:
    """The bag and the topics of a path as ``BagTopics.of_path`` writes it."""
    bag, *names = str(path).split(SEPARATOR)
    return Path(bag), BagTopics(*names[:3])


_CAMERA = ("/camera", "/camera/camera")
KNOWN_TOPICS = (
    ("TUM RGB-D", "/camera/rgb/image_color", "/camera/depth/image"),
    *(("RealSense", f"{c}/color/image_raw", f"{c}/aligned_depth_to_color/image_raw")
      for c in _CAMERA),
    ("Azure Kinect", "/rgb/image_raw", "/depth_to_rgb/image_raw"),
    ("OAK-D", "/oak/rgb/image_raw", "/oak/stereo/image_raw"),
    ("OAK-D", "/oak/rgb/image_rect", "/oak/stereo/image_raw"),
    *(("Astra, OpenNI 2", f"/camera/rgb/{image}", f"/camera/depth_registered/{depth}")
      for image in ("image_raw", "image_rect_color")
      for depth in ("image_raw", "image_rect", "hw_registered/image_rect")),
    ("Orbbec", "/camera/color/image_raw", "/camera/depth_registered/image_raw"),
    ("RealSense SDK", f"{_SDK_COLOUR}image/data", f"{_SDK_DEPTH}image/data"),
    *(("RealSense, depth as it is", f"{c}/color/image_raw", f"{c}/depth/image_rect_raw")
      for c in _CAMERA),
    ("Azure Kinect, depth as it is", "/rgb/image_raw", "/depth/image_raw"),
    ("Orbbec, Astra", "/camera/color/image_raw", "/camera/depth/image_raw"),
    ("Astra, Xtion, Kinect", "/camera/rgb/image_raw", "/camera/depth/image_raw"),
)  # fmt: skip
"""Camera, colour and depth topics by the defaults of its driver; the first that a bag has is it.
Those that a driver has registered come first."""


def find_topics(bag: Bag, requested: BagTopics) -> BagTopics:
    """The topics' names in the bag; an image topic may exist in a compressed form only.

    Raises:
        InputError: a topic is missing or has no messages; the text lists the image topics.
    """
    images = [t.name for t in bag.topics if t.messages and t.type in IMAGE_TYPES]
    listed = ", ".join(images) or "none, the bag has no images"
    for wish, option in ((requested.rgb, "--rgb-topic"), (requested.depth, "--depth-topic")):
        if wish and not _form_of(wish, images):
            raise InputError(f"{bag.path}: no images on {wish}; give {option}, one of: {listed}")
    for _, rgb, depth in KNOWN_TOPICS:
        rgb, depth = requested.rgb or rgb, requested.depth or depth  # noqa: PLW2901
        found = _form_of(rgb, images), _form_of(depth, images)
        if all(found):
            return BagTopics(*found, requested.camera_info or _info_topic(bag, rgb))
    raise InputError(
        f"{bag.path}: no images on the topics of any camera that is known; give --rgb-topic and "
        f"--depth-topic, of: {listed}"
    )


def _form_of(wish: str, images: list[str]) -> str:
    """A topic itself or in its compressed form; "" if the bag has neither."""
    forms = (wish, f"{wish}/compressed", f"{wish}/compressedDepth")
    return next((name for name in forms if name in images), "")


def _uncompressed(topic: str) -> str:
    """The topic of which this one is a compressed form, or itself."""
    return topic.removesuffix("/compressed").removesuffix("/compressedDepth")


def _info_topic(bag: Bag, topic: str) -> str:
    """The camera_info topic of an image topic: beside it, or where RealSense's SDK has it in ROS 1.

    Of the two the one that the bag has.
    """
    base = _uncompressed(topic)
    beside = f"{base.rpartition('/')[0]}/camera_info"
    sdk = f"{base.removesuffix('/image/data')}/info/camera_info"
    return sdk if base.endswith("/image/data") and beside not in _infos(bag) else beside


class BagCamera(NamedTuple):
    """The camera of a bag's colour images, once its ``lens`` has undistorted them if it has one.

    ``form`` is what the values of its depth images mean.
    """

    camera: Camera
    form: DepthForm
    lens: Lens | None


def find_camera(bag: Bag, topics: BagTopics, given: Path | Camera | None) -> BagCamera:
    """The given camera, or that of the camera_info, and what depth values mean.

    Depth of another frame is registered by the camera_info beside it and by /tf_static, or by the
    extrinsics that RealSense's SDK records. Images of a lens that no camera describes are
    undistorted, unless the given camera is of those as recorded (``Lens.is_of_recorded``).

    Raises:
        InputError: no usable intrinsics, or images of another size.
    """
    rgb, depth = first_message(bag, topics.rgb), first_message(bag, topics.depth)
    scale = _depth_scale(bag, depth, topics.depth)
    preset = given if isinstance(given, Path) and is_preset(given) else None
    if given is None or preset is not None:
        own, lens = _camera_of(bag, topics.rgb, topics.camera_info, scale)
        camera = own if preset is None else given_camera(preset, own)
    else:
        camera, lens = given if isinstance(given, Camera) else read_camera(given), None
        if not isinstance(given, Camera):
            check_depth_scale(camera, scale, str(given), f"{bag.path}'s depth")
        with suppress(InputError):  # a camera_info is not needed
            lens = _camera_of(bag, topics.rgb, topics.camera_info, scale)[1]
    form = _depth_form(bag, topics, rgb.header.frame_id, depth.header.frame_id)
    images = colour_image(rgb, topics.rgb), depth_image(depth, topics.depth)
    check_sizes(*images, camera, f"{bag.path}: {topics.rgb} and {topics.depth}", form.camera)
    if lens is None or lens.is_of_recorded(camera):
        return BagCamera(camera, form, None)
    logger.info("%s: images are undistorted by the lens of %s", bag.path, topics.camera_info)
    return BagCamera(camera, form if form.camera else replace(form, lens=lens), lens)


def _depth_scale(bag: Bag, depth: Any, topic: str) -> float:
    """Stored depth of one metre: by the encoding, or by the unit that RealSense's SDK records."""
    scale = DEPTH_SCALES[depth_encoding(depth, topic)]
    for _, unit in bag.messages(_SDK_UNITS):
        with suppress(TypeError, ValueError):
            unit_m = float(getattr(unit, "data", 0.0))  # a number in ROS 1, its text in ROS 2
            return 1 / unit_m if 1e-6 <= unit_m <= 1 else scale
        logger.warning("%s: %s is no number; depth is taken in 1/%g m", bag.path, _SDK_UNITS, scale)
        break
    return scale


def _camera_of(bag: Bag, topic: str, info: str, scale: float) -> tuple[Camera, Lens | None]:
    """The camera of an image topic by its camera_info, and its lens. Raises InputError."""
    rectified = "_rect" in _uncompressed(topic).rpartition("/")[2]
    return camera_of(_camera_info(bag, info), scale, rectified, f"{bag.path}: {info}")


def _depth_form(bag: Bag, topics: BagTopics, rgb_frame: str, depth_frame: str) -> DepthForm:
    """How depth is brought to the colour camera, whose frames are those of the images' headers."""
    sdk = topics.depth.startswith(_SDK_DEPTH)
    if not sdk and (rgb_frame == depth_frame or any(word in topics.depth for word in REGISTERED)):
        return DepthForm()
    T_colour_depth = sdk_extrinsics(bag, _SDK_COLOUR, _SDK_DEPTH) if sdk else None
    if T_colour_depth is None and rgb_frame != depth_frame:
        T_colour_depth = static_extrinsics(bag, rgb_frame, depth_frame)
    info = _info_topic(bag, topics.depth)
    if T_colour_depth is None or info not in _infos(bag):
        logger.warning(
            "%s: colour is in the frame %r, depth in %r, and the bag does not tell where they are; "
            "depth must be registered to colour", bag.path, rgb_frame, depth_frame,
        )  # fmt: skip
        return DepthForm()
    camera, lens = _camera_of(bag, topics.depth, info, 1.0)
    moved_mm = 1e3 * T_colour_depth[:3, 3]
    logger.info("%s: depth is registered, its camera is %s mm beside colour's", bag.path, moved_mm)
    return DepthForm(camera=camera, T_colour_depth=T_colour_depth, lens=lens)


def _infos(bag: Bag) -> list[str]:
    return [topic.name for topic in bag.topics if topic.type == INFO_TYPE and topic.messages]


def _camera_info(bag: Bag, name: str) -> Any:
    available = _infos(bag)
    if name not in available:
        raise InputError(
            f"{bag.path}: no camera_info on {name}; give --camera F or --camera-info-topic, one "
            f"of: {', '.join(available) or 'none'}"
        )
    return first_message(bag, name)


def first_message(bag: Bag, name: str) -> Any:
    """The first message of a topic, checked for the fields that are read later."""
    for _, message in bag.messages(name):
        missing = _FIELDS[message.__msgtype__] - {field.lower() for field in vars(message)}
        if missing:
            raise InputError(f"{bag.path}: {name} has no {', '.join(sorted(missing))}")
        return message
    raise InputError(
        f"{bag.path}: no message on {name}; the bag is damaged, or the publisher is silent"
    )
