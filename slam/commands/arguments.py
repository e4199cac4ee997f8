"""What several commands share: arguments of configuration, segmenter and viewer; the output."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, TypeAlias, get_args

from bmask_slam.graph.errors import InputError

if TYPE_CHECKING:
    from bmask_slam.evaluation import Row
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
    from bmask_slam.sequences.bags.topics import BagTopics
    from bmask_slam.system_config import SystemConfig
    from bmask_slam.viewer.options import ViewOptions

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

WEB_PORT, FOXGLOVE_PORT = 9090, 8765
DETAILS = (
    *("rpe_trans_rmse_frame", "rpe_rot_rmse_frame", "ate_rot_rmse", "tracking_ms_p95"),
    *("isam2_update_ms_median", "isam2_update_ms_p95", "latency_ms_p95"),
)
"""Figures of metrics.json that are not printed; nor are those of the graph."""
SEGMENTERS = "light, mask-scoring-rcnn, precomputed, truth, none, or module:Class of your own"
SEGMENTER_OPTIONS = ("segmenter", "weights", "proposals", "masks", "ray", "labels")


def add_output_arguments(parser: argparse.ArgumentParser, short: str) -> None:
    """Add --quiet, which prints only ``short``, and --json."""
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--quiet", action="store_true", help=f"print only {short}")
    how.add_argument("--json", action="store_true", help="print the result as JSON")


def print_result(
    arguments: argparse.Namespace,
    short: object,
    text: Callable[[], str],
    result: Mapping[str, Any],
) -> None:
    """Print ``short`` if --quiet was given, the result as JSON if --json was, else the text."""
    from bmask_slam.graph.files.json_file import format_json

    print(short if arguments.quiet else format_json(result) if arguments.json else text())


def add_camera_argument(parser: argparse.ArgumentParser, of_copy: bool = False) -> None:
    """Add --camera; and --full-size, but where images are only copied."""
    text = "camera.yaml in place of its own, or a model such as kinect-v1 for what that leaves out"
    parser.add_argument("--camera", type=Path, metavar="F", help=text)
    if of_copy:
        return
    text = "do not reduce large images: slower, more exact only where the camera moves slowly"
    parser.add_argument("--full-size", action="store_true", default=None, help=text)


def add_mesh_voxel_argument(parser: argparse.ArgumentParser) -> None:
    """Add --mesh-voxel."""
    text = "edge of the dense surface's voxels; 0.03: a quick preview (default: 0.01)"
    parser.add_argument("--mesh-voxel", dest="mesh_voxel_m", type=float, metavar="M", help=text)


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the topics of a bag."""
    known = "default: those of the known cameras' drivers"
    text = f"of a bag: colour images ({known})"
    parser.add_argument("--rgb-topic", metavar="T", help=text)
    parser.add_argument("--depth-topic", metavar="T", help=f"of a bag: depth images ({known})")
    text = "of a bag: the colour camera (default: the camera_info beside the colour topic)"
    parser.add_argument("--camera-info-topic", metavar="T", help=text)


def bag_topics(arguments: argparse.Namespace) -> BagTopics:
    """The topics that were asked for."""
    from bmask_slam.sequences.bags.topics import BagTopics

    names = (arguments.rgb_topic, arguments.depth_topic, arguments.camera_info_topic)
    return BagTopics(*(name or "" for name in names))


def add_segmenter_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    """Add --segmenter and what the segmenters need; ``default`` is for the help alone."""
    parser.add_argument("--segmenter", metavar="NAME", help=f"{SEGMENTERS} (default: {default})")
    parser.add_argument("--weights", metavar="F", help="weights file, or torchvision:NAME")
    parser.add_argument(
        "--proposals", type=Path, metavar="F", help="YOLOX network in ONNX that finds the boxes"
    )
    parser.add_argument(
        "--masks", type=Path, metavar="F", help="of precomputed: COCO file or folder of label PNGs"
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="segment on a Ray cluster: host:port, auto or local"
    )
    parser.add_argument("--labels", metavar="F", help="label set: file, or coco, coco91, paper")


def segmenter_options(arguments: argparse.Namespace, base: SegmenterOptions) -> SegmenterOptions:
    """The options with what was given on the command line; files by their absolute paths."""
    from bmask_slam.semantics.labels import is_shipped_name
    from bmask_slam.semantics.segmenters.segmenter_table import written

    given = {name: getattr(arguments, name) for name in ("weights", "labels", "ray")}
    given["name"] = written(arguments.segmenter) if arguments.segmenter else None
    for name in ("proposals", "masks"):
        path = getattr(arguments, name)
        given[name] = path.absolute() if path else None
    if arguments.weights and Path(arguments.weights).is_file():
        given["weights"] = str(Path(arguments.weights).absolute())
    if arguments.labels and not is_shipped_name(arguments.labels):
        given["labels"] = str(Path(arguments.labels).absolute())
    return replace(base, **{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True)
class ChosenConfig:
    """The configuration that was asked for.

    Attributes:
        config: of the system.
        name: of its file, without the suffix; "" without a file.
        is_default: nothing was asked for, not even what is the default.
    """

    config: SystemConfig
    name: str
    is_default: bool


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --config and --set."""
    text = "YAML file, or the name of a shipped one such as 'paper'"
    parser.add_argument("--config", metavar="F", help=text)
    text = "one value of the configuration, such as tracking.min_inliers=20; may be repeated"
    parser.add_argument("--set", metavar="A.B=C", action="append", default=[], help=text)
    text = "use fiducial markers, such as APRILTAG_36h11:0.16 or 4X4_50 (size by depth)"
    parser.add_argument("--markers", metavar="DICT[:SIZE_M]", help=text)


def chosen_config(arguments: argparse.Namespace) -> ChosenConfig:
    """The configuration by --config, --set and the segmenter's arguments. Raises InputError."""
    from bmask_slam.config.configuration import find_config, resolve
    from bmask_slam.system_config import SystemConfig

    file = find_config(arguments.config) if arguments.config else None
    settings = [*arguments.set, *_marker_settings(getattr(arguments, "markers", None))]
    plain = resolve(SystemConfig, file, settings)
    segmenter = segmenter_options(arguments, plain.semantics.segmenter)
    config = replace(plain, semantics=replace(plain.semantics, segmenter=segmenter))
    given = any(getattr(arguments, name) is not None for name in SEGMENTER_OPTIONS)
    is_default = not (file or settings or given)
    return ChosenConfig(config, file.stem if file else "", is_default)


def _marker_settings(markers: str | None) -> list[str]:
    """The settings that --markers stands for; the dictionary's name in any case, with DICT_ too."""
    from bmask_slam.graph.sensors.markers import Dictionary

    if markers is None:
        return []
    given, _, size_m = markers.partition(":")
    names = {name.upper(): name for name in get_args(Dictionary)}
    name = names.get(given.upper().removeprefix("DICT_"))
    if name is None:
        raise InputError(f"--markers {given}: no dictionary; choose of {', '.join(names.values())}")
    settings = ["sensors.markers.enabled=true", f"sensors.markers.dictionary='{name}'"]
    return [*settings, f"sensors.markers.size_m={size_m}"] if size_m else settings


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """Add where it goes: --record or --serve, --foxglove, and --host."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--record", type=Path, metavar="F.rrd", help="write a Rerun recording")
    where.add_argument(
        "--serve",
        type=int,
        nargs="?",
        const=WEB_PORT,
        default=0,
        metavar="PORT",
        help=f"show it in a browser (port {WEB_PORT})",
    )
    parser.add_argument(
        "--foxglove",
        nargs="?",
        const=str(FOXGLOVE_PORT),
        metavar="PORT|F.mcap",
        help=f"for Foxglove: a websocket (port {FOXGLOVE_PORT}), or a file F.mcap",
    )
    text = "address that --serve and --foxglove listen on; others than this machine's own let "
    text += "everyone in"
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help=text)


def view_options(arguments: argparse.Namespace, window: bool) -> ViewOptions:
    """What was asked for; ``window``: Rerun's own window, if nothing else was."""
    from bmask_slam.viewer.options import ViewOptions

    file, port = _foxglove(arguments.foxglove)
    elsewhere = arguments.record is not None or arguments.serve > 0
    if "view" not in arguments:  # the command that shows has a window unless told otherwise
        elsewhere |= arguments.foxglove is not None
    window = window and not elsewhere
    return ViewOptions(arguments.record, arguments.serve, window, arguments.host, file, port)


def _foxglove(text: str | None) -> tuple[Path | None, int]:
    """The file, or the port, of --foxglove."""
    if text is None:
        return None, 0
    if text.lower().endswith(".mcap"):
        return Path(text), 0
    if text.isdecimal() and 0 < int(text) < 65536:
        return None, int(text)
    raise InputError(f"--foxglove {text}: give a port, or a file that ends with .mcap")


def format_summary(rows: list[Row]) -> str:
    """The main figures of a run as a table; metrics.json holds all of them."""
    from bmask_slam.evaluation import format_table

    told = [row for row in rows if row["name"] not in DETAILS]
    return format_table([row for row in told if not row["name"].startswith(("graph_", "camera_"))])


def camera_lines(found: str, folder: Path | None) -> list[str]:
    """What a run has found of its camera, and how the next run gets it."""
    from bmask_slam.run_folder.folder import CAMERA

    lines = [f"Camera      {found}"] if found else []
    if folder is not None and (camera := folder / CAMERA).is_file():
        option = f"--camera {quote(str(camera))}"
        lines.append(f"            {option}: for the next recording of this camera")
    return lines
