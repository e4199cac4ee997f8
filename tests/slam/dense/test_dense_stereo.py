"""``bmask-slam map --depth-source stereo`` on a rendered pair of cameras, and its errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from true_run import make_run

from bmask_slam.cli import main
from bmask_slam.dense import surface
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.map_run import RunFusion
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.saved_map import open_run
from bmask_slam.dense.surface import keyframe_as_frame as as_frame
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.yaml_file import format_yaml, read_yaml
from bmask_slam.graph.geometry import make_pose
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.engine.path import camera_poses
from bmask_slam.rendering.engine.raycast import Renderer, to_image
from bmask_slam.rendering.rooms import office
from bmask_slam.rendering.sequence import _built
from bmask_slam.rendering.writer import stored_depth, write_lists, write_png
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import label_set
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.right_images import read_right_images
from bmask_slam.sequences.sequence import open_sequence

CAMERA = Camera(240, 180, fx=197.0, fy=197.0, cx=119.5, cy=89.5, stereo_bf_px_m=25.0)
COUNT = 5
STAMPS = [f"{0.2 * k:.6f}" for k in range(COUNT)]


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence with right images, their stamps 5 ms late, and the true depth in depth_true/."""
    folder = tmp_path_factory.mktemp("stereo") / "office"
    folder.mkdir()
    scene = _built(RenderConfig("office"), 0.25)[2]  # other tests of this process have it too
    renderer = Renderer(CAMERA, scene.atlas, scene.static)
    poses: Array = camera_poses(office.PATH, 30.0, 0)[: 6 * COUNT : 6]
    aside = make_pose(np.eye(3), np.array([CAMERA.stereo_bf_px_m / CAMERA.fx, 0, 0]))
    rng, lines = np.random.default_rng(2), []
    for stamp, T in zip(STAMPS, poses, strict=True):
        left, right = renderer.render(T), renderer.render(T @ aside)
        for kind, view in (("rgb", left), ("right", right)):
            noisy = to_image(view.rgb + 2 * rng.standard_normal(view.rgb.shape, np.float32))
            write_png(folder / kind / f"{stamp}.png", noisy)
        for kind in ("depth", "depth_true"):
            write_png(folder / kind / f"{stamp}.png", stored_depth(left.depth_m, 5000))
        lines.append(f"{float(stamp) + 0.005:.6f} right/{stamp}.png\n")
    write_lists(folder, STAMPS, poses)
    (folder / "right.txt").write_text("# right images\n" + "".join(reversed(lines)))
    write_camera(folder / "camera.yaml", CAMERA)
    return folder


@pytest.fixture
def sequence(pairs: Path, tmp_path: Path) -> Path:
    """A sequence that may be changed."""
    folder = tmp_path / "office"
    shutil.copytree(pairs, folder)
    return folder


def run_of(folder: Path, frames: tuple[int, ...] = tuple(range(COUNT))) -> Path:
    """A run folder beside the sequence, with keyframes at these frames."""
    return make_run(folder.parent / "run", open_sequence(folder), frames=frames)


def mapped(run: Path, source: str = "stereo", *more: str) -> int:
    return main(["map", str(run), "--voxel", "0.05", "--depth-source", source, *more])


def relative_errors(run: Path, pairs: Path) -> Array:
    """Of the fused depth of all keyframes (K, H, W), NaN where there is none."""
    found = []
    for keyframe in open_run(run).keyframes:
        file = pairs / "depth_true" / f"{STAMPS[keyframe.frame_index]}.png"
        true_m = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / 5000
        found.append(DenseFolder.open(run).fused(keyframe.id).depth_m() / true_m - 1)
    return np.stack(found)


def check_near_the_truth(relative: Array) -> None:
    known = relative[np.isfinite(relative)]
    assert len(known) > 0.7 * relative.size
    assert abs(np.median(known)) < 0.01
    assert np.median(np.abs(known)) < 0.03
    assert np.mean(np.abs(known) > 0.1) < 0.1


def write_depth(folder: Path, stamp: str, depth_m: Array) -> None:
    write_png(folder / "depth" / f"{stamp}.png", stored_depth(depth_m, 5000))


def test_the_map_of_pairs_is_right_whatever_the_sensor_measures(
    sequence: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(sequence)
    for k, stamp in enumerate(STAMPS):
        write_depth(sequence, stamp, np.full((180, 240), np.nan if k == 3 else 1.0))
    assert mapped(run, "stereo", "--mesh") == 0
    assert f"{COUNT} fused" in capsys.readouterr().out
    check_near_the_truth(relative_errors(run, sequence))
    assert (run / "dense" / "mesh.ply").is_file()


def test_the_baseline_is_read_from_the_sequences_camera_file(
    sequence: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(sequence, (0, 1))
    assert mapped(run) == mapped(run) == 0
    assert "0 fused, 2 were finished" in capsys.readouterr().out
    once = 1 + relative_errors(run, sequence)
    longer = replace(CAMERA, stereo_bf_px_m=1.1 * CAMERA.stereo_bf_px_m)
    write_camera(sequence / "camera.yaml", longer)
    assert mapped(run) == 0
    assert "2 fused, 0 were finished" in capsys.readouterr().out
    assert np.nanmedian((1 + relative_errors(run, sequence)) / once) == pytest.approx(1.1, abs=0.01)
    assert mapped(run, "sensor") == 0
    assert "2 fused, 0 were finished" in capsys.readouterr().out


def test_a_kept_volume_of_keyframes_alone_is_not_made_again(
    sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, made = run_of(sequence, (0, 1)), list[object]()
    monkeypatch.setattr(surface, "keyframe_as_frame", lambda *k: made.append(k) or as_frame(*k))
    clouds = []
    for _ in range(2):
        assert mapped(run, "stereo", "--keep-volume", "--quiet") == 0
        clouds.append((run / "dense" / "cloud.ply").read_bytes())
    assert len(made) == 2
    assert clouds[0] == clouds[1]


def test_both_uses_the_pair_where_the_sensor_has_no_depth(sequence: Path) -> None:
    """The first keyframe has no earlier one for a sweep."""
    run = run_of(sequence, (2,))
    true_m = open_sequence(sequence).load(2).depth_m
    write_depth(sequence, STAMPS[2], np.where(np.arange(240) < 140, np.nan, 1.02 * true_m))
    assert mapped(run, "both") == 0
    relative = relative_errors(run, sequence)
    check_near_the_truth(relative[..., :138])
    np.testing.assert_allclose(np.nanmedian(relative[..., 142:]), 0.02, atol=0.003)


def test_keyframes_with_broken_right_images_are_skipped_or_use_the_sensor(
    sequence: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, right = run_of(sequence), sequence / "right"
    (right / f"{STAMPS[1]}.png").unlink()
    write_png(right / f"{STAMPS[2]}.png", np.zeros((90, 120, 3), np.uint8))
    (right / f"{STAMPS[3]}.png").write_bytes(b"no image")
    lines = (sequence / "right.txt").read_text().splitlines()
    kept = [line for line in lines if not line.endswith(f"{STAMPS[4]}.png")]
    (sequence / "right.txt").write_text("\n".join(kept))
    assert mapped(run) == 0
    out, err = capsys.readouterr()
    assert "1 fused" in out and "4 left out" in out
    for k, text in ((1, "no such image"), (2, "120x90"), (3, "not a readable"), (4, "frame 4")):
        assert any(f"keyframe {k}: " in line and text in line for line in err.splitlines())
    assert mapped(run, "both", "--quiet") == 0
    counts = json.loads((run / "dense" / "dense.json").read_text())
    assert counts["keyframes_fused"] == COUNT and not counts["keyframes_left_out"]


def without_bf(folder: Path) -> None:
    values = read_yaml(folder / "camera.yaml")
    del values["stereo_bf"]
    (folder / "camera.yaml").write_text(format_yaml(values))


def negative_bf(folder: Path) -> None:
    path = folder / "camera.yaml"
    path.write_text(path.read_text().replace("stereo_bf: 25.0", "stereo_bf: -25.0"))


@pytest.mark.parametrize(
    ("spoil", "texts"),
    [
        (lambda f: (f / "right.txt").unlink(), ["right.txt: no such list", "--depth-source"]),
        (lambda f: (f / "right.txt").write_text("0.0\n"), ["right.txt:1", "'timestamp file'"]),
        (lambda f: (f / "right.txt").write_text("9.0 right/a.png\n"), ["right.txt", "0.02 s"]),
        (lambda f: (f / "camera.yaml").unlink(), ["camera.yaml: no such file", "stereo_bf"]),
        (without_bf, ["camera.yaml: stereo_bf is missing", "baseline in metres"]),
        (negative_bf, ["camera.yaml: stereo_bf is -25", "positive"]),
    ],
)
def test_missing_inputs_of_pairs_are_one_line(
    sequence: Path,
    spoil: Callable[[Path], object],
    texts: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = run_of(sequence, (0,))
    spoil(sequence)
    assert mapped(run, "stereo", "--quiet") == 1
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
    assert all(text in line for text in texts)
    assert not (run / "dense").exists()


def test_distorted_images_are_rejected_for_stereo(pairs: Path) -> None:
    distorted = replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="distortion"):
        read_right_images(open_sequence(pairs), distorted)


class PersonInTheMiddle:
    """A segmenter that finds a person in every image."""

    labels = label_set(("person",))

    def segment(self, image: Image, name: str) -> list[Instance]:
        mask = np.zeros(image.shape[:2], bool)
        mask[60:120, 90:150] = True
        return [Instance(mask, mask_box(mask), 1, certain(1, 2), 1.0, 1.0)]


def test_excluded_classes_get_no_stereo_depth(sequence: Path) -> None:
    opened = open_run(run_of(sequence, (0,)))
    options = MapOptions(opened.path, excluded=("person",), source="stereo")
    assert RunFusion(opened, PersonInTheMiddle(), options).fuse_all().fused == 1
    relative = relative_errors(opened.path, sequence)[0]
    assert np.isnan(relative[60:120, 90:150]).all()
    assert np.isfinite(relative[:, :80]).mean() > 0.7


def test_help_names_the_source(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["map", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "{sensor,both,stereo,motion}" in out and "right.txt" in out
