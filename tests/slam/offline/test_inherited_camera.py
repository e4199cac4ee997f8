"""The camera of a run that uses a map: whose readout, delay and distortion of depth it has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_run import make_sequence

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.offline.inherited_camera import check_own_camera, inherited_calibration
from bmask_slam.offline.options import RunOptions
from bmask_slam.run_folder.map_file import write_map
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.sequence import Sequence, open_sequence

BEND = (0.016, -0.004, 0.003, -0.001, 0.007)


@pytest.fixture
def sequence(tmp_path: Path) -> Sequence:
    return open_sequence(make_sequence(tmp_path / "seq"))


def with_found(camera: Camera) -> Camera:
    """What a run may find of a camera."""
    times = {"rolling_shutter_s": 0.027, "depth_time_offset_s": -0.018}
    return replace(camera, **times, depth_distortion=BEND)  # type: ignore[arg-type]


def map_of(path: Path, camera: Camera) -> Path:
    """A map that says of which camera it is."""
    write_map(path, {"mapper.world.keyframes.id": np.zeros(1, dtype=np.int64)}, camera)
    return path


@pytest.mark.parametrize("use", ["map", "localise"])
@pytest.mark.parametrize("named", [False, True])
def test_what_the_run_of_the_map_found_is_taken_over(
    sequence: Sequence, use: str, named: bool, tmp_path: Path
) -> None:
    """Also where the camera is given by --camera, as it was for the run of the map."""
    write_camera(tmp_path / "camera.yaml", sequence.camera)
    source = map_of(tmp_path / "map", with_found(sequence.camera))
    options = RunOptions(sequence.folder, camera=tmp_path / "camera.yaml" if named else None)
    found = inherited_calibration(replace(options, **{use: source}), sequence)
    assert found.given == sequence.camera
    assert found.camera == with_found(sequence.camera)
    assert found.text == f"camera as found by {source}"
    off = replace(options, **{use: source}, calibrate="off")
    assert inherited_calibration(off, sequence).camera == sequence.camera


def test_what_a_named_camera_says_of_its_delay_is_kept(sequence: Sequence, tmp_path: Path) -> None:
    said = replace(sequence.camera, depth_time_offset_s=0.02)
    write_camera(tmp_path / "camera.yaml", said)
    source = map_of(tmp_path / "map", with_found(sequence.camera))
    options = RunOptions(sequence.folder, camera=tmp_path / "camera.yaml", localise=source)
    found = inherited_calibration(options, open_sequence(sequence.folder, camera=options.camera))
    assert found.camera == replace(with_found(sequence.camera), depth_time_offset_s=0.02)


def test_rate_noise_and_side_of_the_images_may_differ(sequence: Sequence, tmp_path: Path) -> None:
    """They do not decide where points are: a second recording of the camera at another rate."""
    made = with_found(replace(sequence.camera, fps=7.5, up="left"))
    options = RunOptions(sequence.folder, map=map_of(tmp_path / "map", made))
    found = inherited_calibration(options, sequence)
    assert found.camera == with_found(sequence.camera)
    check_own_camera(tmp_path / "map", made, sequence.with_camera(found.camera))


def test_a_refusal_names_what_decides_and_its_cure(sequence: Sequence, tmp_path: Path) -> None:
    made = with_found(replace(sequence.camera, fx=500.0))
    options = RunOptions(sequence.folder, map=map_of(tmp_path / "map", made))
    assert inherited_calibration(options, sequence).camera == sequence.camera
    with pytest.raises(InputError, match=r"\(fx 500\.0 and [0-9.]+\); a map can only be continued"):
        check_own_camera(tmp_path / "map", made, sequence)
    with pytest.raises(InputError, match=r"\(depth_time.*leave out --calibrate off, .*slam merge"):
        check_own_camera(tmp_path / "map", with_found(sequence.camera), sequence)


def test_rows_that_the_run_of_the_map_found_read_upwards_are_so_again(
    sequence: Sequence, tmp_path: Path
) -> None:
    """Also where a preset, which no file says, has them read downwards; what is new is of those."""
    kinect = replace(sequence.camera, rolling_shutter_s=0.026)
    upwards = replace(kinect, rolling_shutter_s=-0.026)
    source = map_of(tmp_path / "map", replace(upwards, depth_time_offset_s=-0.018))
    options = RunOptions(sequence.folder, map=source, camera=Path("kinect-v1"))
    found = inherited_calibration(options, sequence.with_camera(kinect))
    assert found.given == upwards
    assert found.camera == replace(upwards, depth_time_offset_s=-0.018)
    assert found.rows.startswith("rows are read from the bottom up")
