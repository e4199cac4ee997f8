"""Classes of the user's own as segmenters."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from repository import ROOT

from bmask_slam.config.configuration import dump, from_text
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.config import SemanticsConfig
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

MODULE = """
import numpy as np
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import label_set

class Fine:
    labels = label_set(["thing"])
    def segment(self, image, name):
        return [] if name else None

class Asks(Fine):
    def __init__(self, path):
        pass

class Mute:
    labels = label_set(["thing"])

class Nameless(Fine):
    labels = ["thing"]

class Small(Fine):
    def segment(self, image, name):
        mask = np.ones((20, 30), bool)
        return [Instance(mask, mask_box(mask), 1, certain(1, 2), 1.0, 1.0)]

class Unlisted(Fine):
    def segment(self, image, name):
        mask = np.ones(image.shape[:2], bool)
        return [Instance(mask, mask_box(mask), 2, certain(2, 3), 1.0, 1.0)]
"""
IMAGE = np.zeros((40, 60, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with the module ``own_masks``; on the import path as Python has it."""
    (tmp_path / "own_masks.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    monkeypatch.delitem(sys.modules, "own_masks", raising=False)
    return tmp_path


def make(name: str, folder: Path):
    return make_segmenter(SegmenterOptions.named(name), folder)


def test_a_class_on_pythonpath_is_a_segmenter(folder, monkeypatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(folder))
    segmenter = make("own_masks:Fine", folder)
    assert segmenter.labels.names == ("background", "thing")
    assert segmenter.segment(IMAGE, "a.png") == []
    with pytest.raises(InputError, match="gave NoneType"):
        segmenter.segment(IMAGE, "")
    for name, words in {
        "own_masks:Coarse": "has no class Coarse",
        "own_masks:Asks": "path.*defaults",
        "own_masks:Mute": "needs labels",
        "own_masks:Nameless": "needs labels",
        "no_such_masks:Fine": "PYTHONPATH",
        "own_masks:": "module:Class",
        "../own_masks:Fine": "module:Class",
    }.items():
        with pytest.raises(InputError, match=words):
            make(name, folder)


@pytest.mark.parametrize(("name", "words"), [("Small", "a mask of shape"), ("Unlisted", "label 2")])
def test_instances_of_another_image_or_label_set_are_refused(
    folder, monkeypatch, name: str, words: str
) -> None:
    """They ended `segment` in a traceback where they were drawn."""
    monkeypatch.setenv("PYTHONPATH", str(folder))
    with pytest.raises(InputError, match=rf"^segmenter own_masks:{name}: a\.png: {words}"):
        make(f"own_masks:{name}", folder).segment(IMAGE, "a.png")


def test_nothing_is_imported_from_the_current_folder(folder, monkeypatch) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    with pytest.raises(InputError, match="not in the current folder"):
        make("own_masks:Fine", folder)
    assert "" in sys.path  # as before


def test_a_file_names_no_class(folder, monkeypatch) -> None:
    """What a configuration says is text; what its user says outlives processes."""
    monkeypatch.setenv("PYTHONPATH", str(folder))
    options = SegmenterOptions.named("own_masks:Fine")
    text = dump(SemanticsConfig(options))
    read = from_text(SemanticsConfig, text, "config.yaml").segmenter
    assert read.name == options.name
    with pytest.raises(InputError, match="give --segmenter own_masks:Fine"):
        make_segmenter(read, folder)
    assert make_segmenter(pickle.loads(pickle.dumps(options)), folder).labels


def test_the_example_finds_red_things(monkeypatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "examples"))
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    image = IMAGE.copy()
    image[5:30, 20:50] = [200, 30, 20]
    (found,) = make("own_segmenter:RedThings", ROOT).segment(image, "a.png")
    np.testing.assert_array_equal(found.box, [20, 5, 50, 30])
    assert found.mask.sum() == 25 * 30
