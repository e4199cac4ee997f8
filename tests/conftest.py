"""Configuration and fixtures of all tests."""

from __future__ import annotations

import fcntl
import gc
import hashlib
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from bmask_slam.graph.camera import Camera
    from bmask_slam.rendering.config import RenderConfig

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def pytest_configure() -> None:
    """One thread a process, and no segmenter in runs where a test does not ask for one.

    The workers of pytest-xdist share the cores. A network in each run would take minutes; what a
    user gets is tested in processes of their own. Ctrl-C ends what tests start, also where a shell
    has started pytest in the background and so made all processes ignore it.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for variable in ONE_THREAD:  # read when numpy, OpenCV and torch are loaded
        os.environ.setdefault(variable, "1")
    from bmask_slam.labelling import config

    config.DEFAULT_SEGMENTER = "none"


def pytest_collection() -> None:
    gc.disable()


def pytest_collection_finish() -> None:
    """What was imported stays to the end: the collector need not look at it again and again."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def rendered(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Callable[[RenderConfig], Path]:
    """Returns the folder of a rendered sequence, which all tests of all workers share: read only.

    A configuration is rendered once a session, when a test first asks for it.
    """
    from bmask_slam.rendering.sequence import render_sequence

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if hasattr(request.config, "workerinput") else base  # of pytest-xdist

    def folder(config: RenderConfig) -> Path:
        name = f"{config.name}-{hashlib.sha1(repr(config).encode()).hexdigest()[:8]}"
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            path = shared / name / config.name
            return path if path.is_dir() else render_sequence(config, path)

    return folder


@pytest.fixture(scope="session")
def office(rendered: Callable[[RenderConfig], Path]) -> Path:
    """The first half second of the rendered office in small images, with the true depth."""
    from bmask_slam.rendering.config import RenderConfig

    return rendered(RenderConfig("office", frames=15, width=160, height=120, true_depth=True))


SLOW_OFFICE_FRAMES = 60


@pytest.fixture(scope="session")
def slow_office(rendered: Callable[[RenderConfig], Path]) -> Path:
    """Seven and a half seconds of the office at 8 Hz, in small images."""
    from bmask_slam.rendering.config import RenderConfig

    return rendered(RenderConfig("office", SLOW_OFFICE_FRAMES, fps=8.0, width=160, height=120))


@pytest.fixture
def small_disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A file system of 300 kB, too small for a run folder's map, or of another size."""
    path = tmp_path / "disk"
    path.mkdir()
    size = getattr(request, "param", "300k")
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)]
    if shutil.which("mount") is None or subprocess.call(command, stderr=-3):
        pytest.skip("a small file system cannot be mounted: not root, or not Linux")
    yield path
    subprocess.run(["umount", str(path)], check=True)


SWEEP_DELAY_S = 0.016


@pytest.fixture(scope="session")
def late_sweep(rendered: Callable[[RenderConfig], Path]) -> Path:
    """Eight seconds of the office by a sweeping camera; depth is late, which camera.yaml omits."""
    from bmask_slam.rendering.config import RenderConfig

    late_ms = 1e3 * SWEEP_DELAY_S
    config = RenderConfig(
        "office", 125, fps=15.0, width=320, height=240, sweeping=True, depth_delay_ms=late_ms
    )
    return rendered(config)


@pytest.fixture(scope="session")
def sweep_camera(late_sweep: Path) -> Camera:
    """The right camera of ``late_sweep``."""
    from bmask_slam.sequences.cameras import read_camera

    return replace(read_camera(late_sweep / "camera.yaml"), depth_time_offset_s=SWEEP_DELAY_S)


@pytest.fixture(scope="session")
def turned_sweep(
    rendered: Callable[[RenderConfig], Path], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A sweep whose rows are read from the bottom up; camera.yaml says the opposite."""
    from bmask_slam.rendering.config import RenderConfig
    from bmask_slam.sequences.cameras import read_camera, write_camera

    config = RenderConfig(
        "office", 125, fps=15.0, width=320, height=240, sweeping=True, rolling_shutter_ms=-20.0
    )
    folder = shutil.copytree(rendered(config), tmp_path_factory.mktemp("turned") / "sweep")
    camera = read_camera(folder / "camera.yaml")
    write_camera(folder / "camera.yaml", replace(camera, rolling_shutter_s=0.02))
    return folder
