"""Labels and objects of real rooms, seen by a camera that is mounted sideways or upside down.

    python -m benchmarks.semantics.mounted [--out runs/bench/mounted] [--rooms NAME ...]

Each recording is turned by right angles, its camera and its truth with it, run by default options
and scored as by `benchmarks.semantics.real_rooms`; once as it is, where the network finds which
side is up, and once with ``up: top`` in its camera.yaml, so that images are not turned for the
network. Rows of a turned image are exposed from the bottom, or columns one after another; the
latter is not modelled, so that the trajectory is worse (ATE in mm).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.cameras.mirrored import write_images
from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.semantics.real_rooms import (
    HEADER,
    aligned,
    row,
    score_labels,
    score_objects,
)
from benchmarks.semantics.room_truth import read_truth
from benchmarks.suite.measure import call
from bmask_slam.graph.camera import SIDES
from bmask_slam.graph.files.yaml_file import format_yaml, parse_yaml
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.run_folder.reader import Run
from bmask_slam.semantics.segmenters.upright import turned
from bmask_slam.sequences.camera_presets import PRESETS, preset_of_folder
from bmask_slam.sequences.cameras import format_camera, read_camera
from bmask_slam.sequences.lists import image_name, read_lists

ROOMS = ("redkitchen", "bonn_crowd")


def write_turned(source: Path, out: Path, turns: int) -> None:
    """Write a TUM folder with a groundtruth.txt, turned anticlockwise by right angles."""
    for name, images in zip(("rgb.txt", "depth.txt"), read_lists(source), strict=True):
        write_images(images.files, source, out, lambda image: turned(image, turns))
        lines = zip(images.timestamps_s.tolist(), images.files, strict=True)
        text = "".join(f"{stamp:.6f} {image_name(file, source)}\n" for stamp, file in lines)
        (out / name).write_text(text, encoding="utf-8")
    camera, preset = read_camera(source / "camera.yaml"), preset_of_folder(source)
    readout_s = PRESETS[preset].rolling_shutter_s if preset else 0.0
    poses = read_tum(source / "groundtruth.txt")
    camera, T_camera_turned = camera.turned(turns)
    T_world_camera = poses.poses_world_camera @ T_camera_turned
    text = parse_yaml(format_camera(camera), "camera.yaml")
    text["rolling_shutter"] = -(readout_s or 0.0) if turns == 2 else 0.0
    (out / "camera.yaml").write_text(format_yaml(text), encoding="utf-8")
    write_tum(out / "groundtruth.txt", Trajectory(poses.timestamps_s, T_world_camera))


def scored(title: str, room: str, sequence: Path, out: Path) -> tuple[str, ...]:
    """A row: the figures of `real_rooms`, and the ATE of a run by default options."""
    call(["-m", "bmask_slam", "run", str(sequence), "--out", str(out), "--overwrite", "--quiet"])
    run, truth = Run(out), read_truth(room, read_camera(SHARED / room / "camera.yaml"))
    T_truth_world = aligned(run, sequence)
    labels = score_labels(run, truth, T_truth_world)
    objects = score_objects(run.objects, truth, T_truth_world)
    return (*row(title, labels, objects), f"{1e3 * run.metrics['ate_rmse'].value:.1f}")


def main() -> None:
    """Print a row for each side that is up, found and not."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/bench/mounted"))
    parser.add_argument("--rooms", nargs="*", default=ROOMS, metavar="NAME")
    given = parser.parse_args()
    rows = []
    for room in given.rooms:
        for side in SIDES[1:]:
            name = f"{room}_{side}"
            sequence = given.out / "sequences" / name
            write_turned(SHARED / room, sequence, len(SIDES) - SIDES.index(side))
            rows.append(scored(f"{name}, found", room, sequence, given.out / name))
            with (sequence / "camera.yaml").open("a", encoding="utf-8") as file:
                file.write("up: top\n")
            rows.append(scored(f"{name}, not turned", room, sequence, given.out / f"{name}_as_is"))
    print(table((*HEADER, "ATE mm"), rows))


if __name__ == "__main__":
    main()
