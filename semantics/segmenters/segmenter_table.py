"""Segmenters by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from bmask_slam.graph.errors import InputError, did_you_mean
from bmask_slam.graph.extras import import_extra
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.semantics.labels import LabelSet, read_label_set
from bmask_slam.semantics.segmenters.own_class import OwnClass, names_class, own_segmenter
from bmask_slam.semantics.segmenters.segmenter import (
    CocoSegmenter,
    LabelImageSegmenter,
    NoSegmenter,
    Segmenter,
)
from bmask_slam.semantics.segmenters.upright import Finder, Upright, UprightSegmenter

NAMES = {
    "light": "YOLOX-Nano with masks, with the weights of this project or --weights",
    "mask-scoring-rcnn": "ResNet-FPN, with --weights",
    "precomputed": "masks that any tool made: --masks FILE.json (COCO) or a folder of label PNGs",
    "truth": "the annotations of a rendered sequence",
    "none": "no instances",
}
NETWORKS = ("light", "mask-scoring-rcnn")
TRUTH_FILE = "annotations.json"


@dataclass(frozen=True)
class SegmenterOptions:
    """Which segmenter, and its files.

    Attributes:
        name: one of NAMES, or ``module:Class`` of a class of the user's own: see ``named``.
        weights: of a network: a file, or a name such as ``torchvision:NAME``.
        proposals: ONNX file of a detector that finds the boxes for a network.
        masks: COCO file or folder of label PNGs, for "precomputed".
        labels: label set of the weights or the PNGs, where the file does not name it.
        min_score: class score below which a network's detection is dropped.
        surfaces: whether the light network gives every pixel a class, walls and floors too.
        ray: address of a Ray cluster to run on, see `semantics.segmenters.ray_segmenter`; "" for
            this process.
    """

    name: str = "light"
    weights: str | None = None
    proposals: Path | None = None
    masks: Path | None = None
    labels: str | None = None
    min_score: float = 0.5
    surfaces: bool = True
    ray: str = ""

    @classmethod
    def named(cls, name: str) -> SegmenterOptions:
        """Options with a name that the user wrote; only such a ``module:Class`` is imported."""
        return cls(written(name))

    @property
    def is_network(self) -> bool:
        """Whether it is a network of this project, of which an image takes long."""
        return self.name in NETWORKS

    @property
    def is_shipped(self) -> bool:
        """Whether it is the network that comes with this project, here, with its own weights."""
        return self == SegmenterOptions(min_score=self.min_score, surfaces=self.surfaces)

    def described(self) -> dict[str, str]:
        """The options as text, to compare with those of another run."""
        return {key: str(value) for key, value in asdict(self).items()}


def written(name: str) -> str:
    """A segmenter's name as its user wrote it, not a file."""
    return OwnClass(name) if names_class(name) else name


def measured_name(options: SegmenterOptions) -> str:
    """The name under which the masks of these options were measured; "" if they were not.

    See `semantics.beliefs.observation`.
    """
    given = options.weights or options.proposals or options.labels
    return options.name if options.name == "light" and not given else ""


FindWeights = Callable[[str], Path]
"""Path of the weights of a name, which it may download."""


def make_segmenter(
    options: SegmenterOptions,
    sequence: Path,
    find_weights: FindWeights = Path,
    upright: Upright | None = None,
) -> Segmenter:
    """Make the segmenter of ``options.name`` for the images of a folder.

    By default ``options.weights`` must be a path. ``find_weights`` must be picklable for Ray.
    Images are turned ``upright`` for a network; None: they are. On Ray only where the side that is
    up is known: nothing looks for it.

    Raises:
        InputError: an unknown name, or a file or class that is missing or does not fit.
    """
    found = _made(options, sequence, find_weights)
    if upright is None or not options.is_network:
        return found
    looks = not (options.ray or upright.side)  # a robot that sends its images may lack torch
    return UprightSegmenter(found, upright, _finder(found) if looks else None)


def _made(options: SegmenterOptions, sequence: Path, find_weights: FindWeights) -> Segmenter:
    """The segmenter for images as they are."""
    own = names_class(options.name)
    if not own and options.name not in NAMES:
        known = f"{', '.join(NAMES)}, or module:Class"
        near = did_you_mean(options.name, NAMES)
        raise InputError(f"segmenter {options.name!r}: not known; there are: {known}{near}")
    if options.name == "none":
        return NoSegmenter()
    if options.ray:
        from bmask_slam.semantics.segmenters.ray_segmenter import RaySegmenter  # noqa: PLC0415

        here = replace(options, ray="")
        remote = RaySegmenter(partial(make_segmenter, here, sequence, find_weights), options.ray)
        remote.measured = measured_name(options)
        return remote
    if own:
        return own_segmenter(options.name)
    if options.name == "truth":
        path = sequence / TRUTH_FILE
        if not path.is_file():
            raise InputError(f"{path}: no such file; only rendered sequences have the truth")
        return CocoSegmenter(path)
    if options.name == "precomputed":
        return _precomputed(options)
    return _network(options, find_weights)


def labels_of(options: SegmenterOptions, sequence: Path) -> LabelSet:
    """The classes of a segmenter, of which a network is not loaded.

    Raises:
        InputError: only a network's weights say them; else as ``make_segmenter``.
    """
    if not options.is_network:
        return make_segmenter(options, sequence).labels
    if options.labels is None and options.name != "light":
        raise InputError(f"segmenter {options.name!r}: only its weights say its classes; --labels")
    return read_label_set(options.labels or "coco")


def _precomputed(options: SegmenterOptions) -> Segmenter:
    if options.masks is None:
        raise InputError("segmenter 'precomputed': give --masks, a COCO file or a folder of PNGs")
    if options.masks.is_dir():
        return LabelImageSegmenter(options.masks, read_label_set(options.labels or "coco"))
    return CocoSegmenter(options.masks)


def _network(options: SegmenterOptions, find_weights: FindWeights) -> Segmenter:
    """A network segmenter; torch is imported here since that takes a second."""
    if options.weights is None and options.name != "light":
        raise InputError(f"segmenter {options.name!r}: give --weights, a file or torchvision:NAME")
    if not 0 <= options.min_score <= 1:  # nothing would be found; so for NaN
        raise InputError(f"min_score {options.min_score:g}: a class score is 0 to 1; give another")
    import_extra(*needed_by(options))
    from bmask_slam.semantics.network.yolox.selection import SelectionConfig  # noqa: PLC0415
    from bmask_slam.semantics.segmenters.light_segmenter import LightSegmenter  # noqa: PLC0415
    from bmask_slam.semantics.segmenters.network_segmenter import NetworkSegmenter  # noqa: PLC0415
    from bmask_slam.semantics.segmenters.yolox import YoloxConfig, YoloxDetector  # noqa: PLC0415
    from bmask_slam.semantics.weights.checkpoints import load_network  # noqa: PLC0415
    from bmask_slam.semantics.weights.light_weights import SHIPPED, is_light, load_light  # noqa: PLC0415
    from bmask_slam.semantics.weights.stuff_weights import SHIPPED as STUFF  # noqa: PLC0415
    from bmask_slam.semantics.weights.stuff_weights import load_stuff  # noqa: PLC0415

    labels = read_label_set(options.labels) if options.labels else None
    path = find_weights(options.weights) if options.weights else data_path(*SHIPPED)
    detector = None
    if options.proposals:
        selection = SelectionConfig(max(options.min_score, SelectionConfig.min_score))
        detector = YoloxDetector(options.proposals, YoloxConfig(selection))
    if is_light(path):
        _check_kind(options, "light", "YOLOX-Nano")
        stuff = load_stuff(data_path(*STUFF)) if options.surfaces else None
        network = load_light(path, labels)
        light = LightSegmenter(network, options.min_score, detector, stuff=stuff)
        light.measured = measured_name(options)
        return light
    other = load_network(path, labels)
    body = other.model.config.backbone
    _check_kind(options, "light" if body == "mobilenet_v2" else "mask-scoring-rcnn", body)
    return NetworkSegmenter(other, options.min_score, detector)


def _finder(segmenter: Segmenter) -> Finder:
    """What finds the side of an image that is up: the light network, this or the shipped one."""
    from bmask_slam.semantics.segmenters.light_segmenter import LightSegmenter  # noqa: PLC0415
    from bmask_slam.semantics.weights.light_weights import SHIPPED, load_light  # noqa: PLC0415

    if isinstance(segmenter, LightSegmenter):
        return segmenter
    return LightSegmenter(load_light(data_path(*SHIPPED)))


class LabelsOnly(NoSegmenter):
    """No segmenter, but the labels of one: masks come from another process."""

    def __init__(self, names: tuple[str, ...], options: SegmenterOptions) -> None:
        self.labels = LabelSet(names)
        self.measured = measured_name(options)


def needed_by(options: SegmenterOptions) -> tuple[str, str, str, str]:
    """What a network needs, as arguments of `graph.extras.import_extra`."""
    instead = "take --segmenter none: no labels, objects or masks"
    return "torch", f"segmenter {options.name!r}", "semantics", instead


def _check_kind(options: SegmenterOptions, name: str, body: str) -> None:
    """Raise InputError unless the network is of the kind that was asked for."""
    if name != options.name:
        raise InputError(
            f"{options.weights}: a {body} network, which is not {options.name!r}; take {name!r}"
        )
