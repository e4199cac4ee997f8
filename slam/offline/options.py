"""What a run is told, and how that is written into its folder so that it can be resumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.system_config import SystemConfig

_PATHS = ("sequence", "camera", "reference", "map")
_RECORDED = (*_PATHS, "config_name", "max_frames", "stride", "checkpoint_every", "dense")
_FLAGS = {"map": "--continue", "dense": "--map"}
"""Of options that are not called as their field is."""


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to put it.

    Attributes:
        sequence: folder in TUM layout.
        config: of the system.
        config_name: for the name of the run folder, where ``out`` is None.
        out: the run folder; None: the first free ``runs/<sequence>[-<config_name>][-<n>]``.
        overwrite: replace the run that ``out`` holds.
        camera: a camera.yaml to use in place of the sequence's own.
        reference: TUM file or sequence folder to compare with; None: the sequence's own, if any.
        max_frames: stop after so many frames.
        stride: take every n-th frame.
        checkpoint_every: frames from one checkpoint to the next; None: none is written.
        map: map file, or run folder that holds one, to go on from.
        localise: the same, to find the frames in; it stays as it is.
        dense: also make a dense map, keyframes being fused on the way.
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
    dense: bool = False
    quiet: bool = False

    def __post_init__(self) -> None:
        for option in ("stride", "max_frames", "checkpoint_every"):
            value = getattr(self, option)
            if value is not None and value < 1:
                raise InputError(f"{_flag(option)} {value}: must be a whole number of at least 1")
        if self.localise is None:
            return
        for option in ("map", "checkpoint_every", "dense"):
            if getattr(self, option):
                raise InputError(
                    f"--localise {self.localise}: learns nothing that {_flag(option)} could go on "
                    "from; leave one of the two away"
                )

    def recorded(self) -> dict[str, Any]:
        """What a checkpoint must know of these, as JSON values, with absolute paths."""
        found = {name: getattr(self, name) for name in _RECORDED}
        return found | {name: str(found[name].absolute()) for name in _PATHS if found[name]}

    @classmethod
    def from_recorded(
        cls, recorded: Mapping[str, Any], config: SystemConfig, out: Path
    ) -> RunOptions:
        """The options of ``recorded`` values. Raises KeyError or TypeError for others."""
        found = {name: recorded[name] for name in _RECORDED}
        paths = {name: Path(found[name]) for name in _PATHS if found[name]}
        return cls(**{**found, **paths}, config=config, out=out.absolute())

    def with_given(self, given: Mapping[str, Any]) -> RunOptions:
        """These options of a begun run, with what the user gives again when resuming it.

        The sequence may have been moved; all else must be as it was.

        Raises:
            InputError: something is different.
        """
        free = ("sequence", "quiet")
        for option in (name for name in given if name not in free):
            value, own = given[option], getattr(self, option)
            if own != (value.absolute() if isinstance(value, Path) else value):
                was = "another configuration" if option == "config" else own
                raise InputError(
                    f"{_flag(option)}: the run was begun with {was}; leave it away, or start a "
                    "new run"
                )
        return replace(self, **{name: given[name] for name in free if name in given})


def _flag(option: str) -> str:
    return _FLAGS.get(option, "--" + option.replace("_", "-"))
