"""A link in a folder that is written to: nothing is written, emptied or removed where it leads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_comparison import make_comparison

from bmask_slam.comparison.comparing import _locked
from bmask_slam.comparison.experiment.experiment import Configuration, Experiment, SequenceSource
from bmask_slam.comparison.jobs.cells import rendered_sequence, run_jobs
from bmask_slam.comparison.jobs.job import Job, run_job
from bmask_slam.comparison.optimise_folder import FolderOptions, optimise_folder
from bmask_slam.comparison.report.report import write_report
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import file_stem
from bmask_slam.graph.files.whole_file import open_plain
from bmask_slam.live.network.carrying import FilePiece, store
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.semantics.instances.surface_files import FOLDER, write_surfaces
from bmask_slam.semantics.instances.surfaces import SurfaceClasses
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.segmenters.mask_cache import CacheOptions, cache_masks
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter

KEPT = "keep me"


def lock(folder: Path) -> None:
    with _locked(folder):
        pass


def job(folder: Path) -> None:
    run_job(Job("a", "a", ("--version",), "", str(folder / "cell.json"), str(folder / "log.txt")))


WRITERS: dict[str, Callable[[Path], None]] = {".lock": lock, "log.txt": job, "cell.json": job}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_is_a_link(tmp_path: Path, name: str) -> None:
    victim, folder = tmp_path / "victim", tmp_path / "out"
    victim.write_text(KEPT)
    folder.mkdir()
    (folder / name).symlink_to(victim)
    try:
        WRITERS[name](folder)
    except InputError as error:
        assert f"{name}: is a link" in str(error)
    assert victim.read_text() == KEPT


def test_a_file_that_is_opened_in_place(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text(KEPT)
    (tmp_path / "a").symlink_to(tmp_path / "victim")
    for mode in ("w", "a", "wb"):
        with pytest.raises(InputError, match="a: is a link"):
            open_plain(tmp_path / "a", mode)
    with open_plain(tmp_path / "b", "w") as file:
        file.write("ü\n")
    assert (tmp_path / "b").read_bytes() == "ü\n".encode()


@pytest.mark.parametrize("kind", ["images", "overlays"])
def test_a_folder_of_masks_that_is_a_link(tmp_path: Path, kind: str) -> None:
    victim, out = tmp_path / "victim", tmp_path / "out"
    victim.mkdir()
    out.mkdir()
    (out / "settings.json").write_text("{}")
    (out / kind).symlink_to(victim)
    image = tmp_path / "a.png"
    cv2.imwrite(str(image), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputError, match=f"{kind}: is a link"):
        cache_masks(NoSegmenter(), [("a.png", image)], CacheOptions(out, {}), lambda k, n: None)
    assert not list(victim.iterdir())


def test_classes_of_surfaces_are_not_written_through_a_link(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / FOLDER).symlink_to(victim)
    seen = SurfaceClasses(label_set(("wall",)), np.ones((2, 2, 1), np.float16), 4.0, (8, 8))
    with pytest.raises(InputError, match=f"{FOLDER}: is a link"):
        write_surfaces(tmp_path, "a.png", seen)
    assert not list(victim.iterdir())


@pytest.mark.parametrize("name", ["sequences", "cells", "sequences/a-0.record", "cells/a/b"])
def test_folders_of_a_comparison_that_are_links(tmp_path: Path, name: str) -> None:
    """What they lead to was removed, and written to."""
    victim, out = tmp_path / "victim", tmp_path / "out"
    victim.mkdir()
    (out / name).parent.mkdir(parents=True)
    (out / name).symlink_to(victim)
    source = SequenceSource("a", render=RenderConfig("office"))
    experiment = Experiment("x", "", tmp_path, (source,), configurations={"b": Configuration()})
    with pytest.raises(InputError, match=f"{out / name}: is a link"):
        run_jobs(experiment, [rendered_sequence(source, RenderConfig("office"), 0, out)], out)


@pytest.mark.parametrize("name", ["jobs", "a.g2o"])
def test_folders_of_an_optimised_folder_that_are_links(tmp_path: Path, name: str) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.g2o").write_text("")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "victim")
    with pytest.raises(InputError, match=f"{name}: is a link"):
        optimise_folder(FolderOptions(tmp_path / "in", tmp_path / "out"))
    assert not (tmp_path / "victim").exists()


def test_a_file_that_comes_over_the_network(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text(KEPT)
    (tmp_path / "map.part").symlink_to(tmp_path / "victim")
    failed = []
    store(FilePiece(tmp_path / "map", 0, np.zeros(4, np.uint8), "saved"), failed.append)
    assert "map.part: is a link" in str(failed[0])
    assert (tmp_path / "victim").read_text() == KEPT


@pytest.mark.parametrize("name", ["dense", "dense/depth"])
def test_a_dense_map_that_is_a_link(tmp_path: Path, name: str) -> None:
    """A map with other settings would remove what it leads to."""
    victim, run = tmp_path / "victim", tmp_path / "run"
    victim.mkdir()
    (victim / "settings.json").write_text("{}")
    (run / name).parent.mkdir(parents=True)
    (run / name).symlink_to(victim)
    with pytest.raises(InputError, match=f"{name}: is a link"):
        DenseFolder(run, {"other": 1})
    assert [path.name for path in victim.iterdir()] == ["settings.json"]


def test_a_folder_of_figures_that_is_a_link(tmp_path: Path) -> None:
    victim, folder = tmp_path / "victim", tmp_path / "comparison"
    victim.mkdir()
    (victim / "thesis.pdf").write_text(KEPT)
    folder.mkdir()
    (folder / "figures").symlink_to(victim)
    with pytest.raises(InputError, match="figures: is a link"):
        write_report(make_comparison(folder), folder)
    assert (victim / "thesis.pdf").read_text() == KEPT


@pytest.mark.parametrize("name", ["../../victim", "a/b", "..", "/etc/passwd", "a\0b", "x" * 300])
def test_a_class_name_is_a_plain_part_of_a_file_name(name: str) -> None:
    stem = f"0001-{file_stem(name)}"
    assert Path(stem).name == stem and "\0" not in stem and len(stem) < 100
    assert json.loads(json.dumps(stem)) == stem
