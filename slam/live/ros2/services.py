"""What ROS 2 can ask of a live run: save the map, begin anew, only locate frames in the map."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bmask_slam.graph.errors import InputError
from bmask_slam.live.messages import MapSaved
from bmask_slam.live.ros2.transport import Node, Request, typestore
from bmask_slam.run_folder.map_file import MAP

logger = logging.getLogger(__name__)

TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
SAVE_S = 60.0
"""Longest time that the map's process may take to save the map."""
ENDED = "the run has ended"


class ServedRun(Protocol):
    """What is asked of a live run; `LiveSlam` has it."""

    extends: bool

    @property
    def out(self) -> Path | None: ...
    def save_map(self, path: Path) -> None: ...
    def saved_maps(self) -> list[MapSaved]: ...


@dataclass(frozen=True, eq=False)
class _Saving:
    """A call that waits for a map file to be written."""

    request: Request
    path: Path
    until_s: float


class Ros2Services:
    """Answers save_map, reset and localise_only; for the thread that tracks.

    Attributes:
        reset_asked: the run is to end, and another to begin.
    """

    def __init__(self, node: Node, prefix: str) -> None:
        self.reset_asked = False
        self._save = node.service(f"{prefix}/save_map", TRIGGER)
        self._reset = node.service(f"{prefix}/reset", TRIGGER)
        self._localise = node.service(f"{prefix}/localise_only", SET_BOOL)
        self._saving: list[_Saving] = []
        self._later: list[_Saving] = []  # called while a map is being saved, which may lack frames
        self._resetting: list[Request] = []

    def serve(self, run: ServedRun) -> bool:
        """Answer what has been asked and can be answered; returns whether the run is to end."""
        for request in self._localise.take():
            _reply(request, *_localise_only(run, request.message.data), kind=SET_BOOL)
        for request in self._save.take():
            self._begin_saving(run, request)
        if self._saving:
            self._answer_saved(run)
        if self._later and not self._saving:
            run.saved_maps()  # answers that came too late are none of this call
            run.save_map(self._later[0].path)
            self._saving, self._later = self._later, []
        self._resetting += self._reset.take()
        self.reset_asked = bool(self._resetting)
        return self.reset_asked

    def begin(self, before: Path | None, now: Path | None) -> None:
        """Another run has begun, in a folder of its own; answers who asked for it."""
        for saving in [*self._saving, *self._later]:
            _reply(saving.request, False, "the run ended before its map was saved")
        for request in self._resetting:
            _reply(request, True, f"the run until now is in {before}, the new one in {now}")
        self._saving, self._later = [], []
        self._resetting, self.reset_asked = [], False

    def end(self, run: Path | None) -> None:
        """The run has ended, and no other begins; answers who still waits."""
        saved = None if run is None else run.absolute() / MAP
        is_saved = saved is not None and saved.exists()
        for saving in [*self._saving, *self._later]:
            _reply(saving.request, is_saved, str(saved) if is_saved else ENDED)
        for request in [*self._resetting, *self._save.take(), *self._reset.take()]:
            _reply(request, False, ENDED)
        for request in self._localise.take():
            _reply(request, False, ENDED, kind=SET_BOOL)
        self._saving, self._later, self._resetting = [], [], []

    def _begin_saving(self, run: ServedRun, request: Request) -> None:
        if run.out is None:
            _reply(request, False, "the run has no folder")
            return
        path = run.out.absolute() / MAP
        self._later.append(_Saving(request, path, time.monotonic() + SAVE_S))

    def _answer_saved(self, run: ServedRun) -> None:
        answers = {saved.path: saved for saved in run.saved_maps()}
        now_s, waiting = time.monotonic(), []
        for saving in self._saving:
            saved = answers.get(saving.path)
            if saved is not None:
                _reply(saving.request, not saved.failure, saved.failure or str(saving.path))
            elif now_s > saving.until_s:
                _reply(saving.request, False, "the map's process does not answer")
            else:
                waiting.append(saving)
        self._saving = waiting


def _localise_only(run: ServedRun, only: bool) -> tuple[bool, str]:
    """Switch it on or off: success, and what is said."""
    try:
        run.extends = not only
    except InputError as error:
        return False, str(error)
    logger.info("the map is %s", "not extended from now on" if only else "extended again")
    return True, "frames are only located in the map" if only else "the map is extended"


def _reply(request: Request, success: bool, text: str, kind: str = TRIGGER) -> None:
    response: Any = typestore().types[f"{kind}_Response"]
    request.reply(response(success, text))
