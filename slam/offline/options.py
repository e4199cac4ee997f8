"""The options of a run, and how a checkpoint keeps them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bmask_slam.calibration.config import CALIBRATE
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.system_config import SystemConfig

_PATHS = ("sequence", "camera", "reference", "map")
_RECORDED = (
    *(*_PATHS, "config_name", "max_frames", "stride", "checkpoint_every", "dense"),
    *("calibrate", "mesh_voxel_m", "parallel", "full_size"),
)
_ADDED = {"mesh_voxel_m": None, "parallel": False, "full_size": True}
"""What checkpoints written before do not have."""
_FLAGS = {"map": "--continue", "dense": "--map", "mesh_voxel_m": "--mesh-voxel"}
"""Flags that differ from the name of their field."""


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to put it.

    Attributes:
        sequence: a recording in any layout of docs/data.md.
        config: of the system.
        config_name: part of the run folder's name where ``out`` is None.
        out: the run folder; None: the first free ``runs/<sequence>[-<config_name>][-<n>]``.
        overwrite: replace the run that ``out`` holds.
        camera: a camera.yaml to use in place of the sequence's own, or the name of a camera preset.
        reference: TUM file or sequence folder to compare with; None: the sequence's own, if any.
        max_frames: stop after so many frames.
        stride: take every n-th frame.
        checkpoint_every: frames from one checkpoint to the next; None: no checkpoints.
        map: map file, or run folder with one, that the run continues.
        localise: map file, or run folder with one, in which the frames are located; it is not
            changed.
        calibrate: whether the camera's readout time and delay are found from its motion:
            "auto", and used where that is sure; "report", and only said; "off".
        dense: also make a dense map, after the last frame.
        mesh_voxel_m: edge of its voxels, for a preview; None: 0.01.
        parallel: tracking, map and masks each have a process, and work at the same time.
        full_size: large images are not reduced, as `open_sequence` does otherwise.
        quiet: no progress bar.
    """

    sequence: Path
    config: SystemConfig = field(default_factory=SystemConfig)
    config_name: str = ""
    out: Path | None = None
    overwrite: bool = False
    camera: Path | None = None
    reference: Path | None = None
    max_frames: int | None = None
    stride: int = 1
    checkpoint_every: int | None = None
    map: Path | None = None
    localise: Path | None = None
    calibrate: str = "auto"
    dense: bool = False
    mesh_voxel_m: float | None = None
    parallel: bool = False
    full_size: bool = False
    quiet: bool = False

    def __post_init__(self) -> None:
        for option in ("stride", "max_frames", "checkpoint_every"):
            value = getattr(self, option)
            if value is not None and value < 1:
                raise InputError(f"{_flag(option)} {value}: must be a whole number of at least 1")
        if self.calibrate not in CALIBRATE:
            raise InputError(f"--calibrate {self.calibrate}: is not one of {', '.join(CALIBRATE)}")
        if self.mesh_voxel_m is not None and not self.dense:
            raise InputError(
                f"--mesh-voxel {self.mesh_voxel_m}: is for the dense map; give --map too, or omit "
                "it"
            )
        if self.parallel and (self.map or self.localise):
            raise InputError(
                "--parallel: begins a map of its own; give it without "
                + ("--localise" if self.localise else "--continue")
            )
        if self.localise is None:
            return
        given = vars(self) | {"covariances": self.config.covariances}
        for option in ("map", "checkpoint_every", "dense", "covariances"):
            if given[option]:
                raise InputError(
                    f"--localise {self.localise}: does not extend the map, which {_flag(option)} "
                    "needs; give one of the two"
                )

    def recorded(self) -> dict[str, Any]:
        """The options that a checkpoint keeps, as JSON values; paths are absolute."""
        found = {name: getattr(self, name) for name in _RECORDED}
        return found | {name: str(_absolute(found[name])) for name in _PATHS if found[name]}

    @classmethod
    def from_recorded(
        cls, recorded: Mapping[str, Any], config: SystemConfig, out: Path
    ) -> RunOptions:
        """The options of ``recorded`` values. Raises KeyError or TypeError for others."""
        found = {name: (_ADDED | dict(recorded))[name] for name in _RECORDED}
        if not found["dense"]:
            found["mesh_voxel_m"] = None  # it was ignored where no map is made
        paths = {name: Path(found[name]) for name in _PATHS if found[name]}
        return cls(**{**found, **paths}, config=config, out=out.absolute())

    def with_given(self, given: Mapping[str, Any]) -> RunOptions:
        """The options to resume a run with, when the user repeats some of them.

        The sequence may have been moved; all others must be as they were.

        Raises:
            InputError: an option differs.
        """
        free = ("sequence", "quiet")
        for option in (name for name in given if name not in free):
            value, own = given[option], getattr(self, option)
            if own != (_absolute(value) if isinstance(value, Path) else value):
                raise InputError(
                    f"{_flag(option)}: the run was started {_words(option, own)}; omit it, or "
                    "start a new run"
                )
        taken = (*free, "config")  # an equal one may name a class that only its user may name
        return replace(self, **{name: given[name] for name in taken if name in given})


def _absolute(path: Path) -> Path:
    """The path from the root; the name of a camera preset as it is."""
    return path if is_preset(path) else path.absolute()


def _words(option: str, own: object) -> str:
    """An option's value that a run was started with, in words."""
    if option not in _PATHS and (own is None or isinstance(own, bool)):
        return f"{'with' if own else 'without'} {_flag(option)}"
    return "with another configuration" if option == "config" else f"with {own}"


def _flag(option: str) -> str:
    return _FLAGS.get(option, "--" + option.replace("_", "-"))
