"""A user's own class as segmenter, by ``module:Class``."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance, check_instances
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter, check_image


class OwnClass(str):
    """``module:Class`` as its user wrote it on the command line or in Python.

    Equal text from a file (a configuration, a run folder) is plain text, and is not imported.
    """

    __slots__ = ()


def names_class(name: str) -> bool:
    """Whether a segmenter's name is ``module:Class``."""
    return ":" in name


class OwnSegmenter:
    """Passes images to an object of a user's class, and checks that it gives instances.

    Attributes:
        labels: label set of the object.
    """

    def __init__(self, name: str, inner: Segmenter) -> None:
        self.name, self.labels = name, inner.labels
        self._inner = inner

    def segment(self, image: Image, name: str) -> list[Instance]:
        """What the object finds.

        Raises:
            InputError: that is no list of instances of this image and of the object's labels.
        """
        check_image(image, name)
        found = self._inner.segment(image, name)
        if not isinstance(found, list) or not all(isinstance(i, Instance) for i in found):
            raise InputError(
                f"segmenter {self.name}: segment() gave {type(found).__name__} for {name}; "
                "give a list of bmask_slam.semantics.instances.instances.Instance"
            )
        size = (image.shape[0], image.shape[1])
        check_instances(found, size, self.labels, f"segmenter {self.name}: {name}")
        return found


def own_segmenter(name: str) -> OwnSegmenter:
    """Import ``module``, and make an object of ``Class`` without arguments.

    Raises:
        InputError: the name comes from a file; there is no such module or class; it needs
            arguments, or has no ``labels`` and ``segment(image, name)``.
    """
    if not isinstance(name, OwnClass):
        raise InputError(
            f"segmenter {name!r}: a file names it, and files do not run code; give --segmenter "
            f"{name} (in Python: SegmenterOptions.named({name!r}))"
        )
    made = _class_of(name)()
    labels: Any = getattr(made, "labels", None)
    if (
        not isinstance(labels, LabelSet)
        or len(labels) < 2
        or not callable(getattr(made, "segment", None))
    ):
        raise InputError(
            f"segmenter {name}: needs labels, a LabelSet with a class, and segment(image, name); "
            "see Segmenter in bmask_slam/semantics/segmenters/segmenter.py"
        )
    return OwnSegmenter(name, made)


def _class_of(name: str) -> Callable[[], Any]:
    module_name, _, class_name = name.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), class_name)):
        raise InputError(f"segmenter {name!r}: write it as module:Class, such as my_masks:Masks")
    with _without_current_folder():
        try:
            module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            raise InputError(
                f"segmenter {name}: {error}; modules are looked for on PYTHONPATH and among "
                "installed packages, not in the current folder"
            ) from error
    found = getattr(module, class_name, None)
    if not callable(found):
        raise InputError(f"segmenter {name}: {module_name} has no class {class_name}")
    try:
        inspect.signature(found).bind()
    except TypeError as error:
        raise InputError(
            f"segmenter {name}: {class_name}() {error}; give its arguments defaults"
        ) from error
    made: Callable[[], Any] = found
    return made


@contextmanager
def _without_current_folder() -> Iterator[None]:
    """Within it nothing is imported from the current folder, unless PYTHONPATH names that."""
    here, before = os.path.realpath(os.curdir), list(sys.path)
    named = {os.path.realpath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p}
    sys.path[:] = [p for p in before if os.path.realpath(p) != here or here in named]
    try:
        yield
    finally:
        sys.path[:] = before
