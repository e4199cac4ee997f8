"""The page about a run: what is in it, hostile names, broken and missing files."""

from __future__ import annotations

import base64
import html.parser
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence

from bmask_slam.evaluation import evaluate
from bmask_slam.evaluation.recordings import JOINED, Part, write_parts
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.offline import runner
from bmask_slam.offline.options import RunOptions
from bmask_slam.reporting.run_report import write_run_report

HOSTILE = "<script>alert(1)</script> & 'x' \"y\""
WARNING = f"2026-01-01 10:00:00,000 WARNING bmask_slam.x: depth {HOSTILE}\n"


def hostile_object(number: int) -> dict[str, object]:
    box = {"centre_world_m": [1, 2, 3], "axes_world": np.eye(3).tolist(), "size_m": [0.5, 1, 2]}
    return {
        "id": number, "label": HOSTILE, "probability": 0.75, "distribution": {HOSTILE: 0.75},
        "centroid_world_m": [1, 2, 3], "box": box, "keyframes": [0, 1], "landmarks": [],
        "first_seen_s": 0.0, "last_seen_s": 1.0,
    }  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the fake system, frames 6 and 13 lost, with objects, in a folder of a bad name."""
    folder = tmp_path_factory.mktemp("report")
    out = folder / HOSTILE.replace("/", "-")
    runner.run(RunOptions(make_sequence(folder / "seq"), out=out, quiet=True), FakeSystem)
    with (out / "log.txt").open("a", encoding="utf-8") as log:
        log.write(2 * WARNING)
    content = {"labels": [HOSTILE], "up_world": [0, -1, 0], "floor_m": None}
    text = json.dumps(content | {"objects": [hostile_object(k) for k in (3, 4)]})
    (out / "objects.json").write_text(text, encoding="utf-8")
    cv2.imwrite(str(out / "objects.png"), np.full((90, 2400, 3), 7, np.uint8))
    return out


@pytest.fixture(scope="module")
def written(run: Path) -> Path:
    return write_run_report(run)


class Page(html.parser.HTMLParser):
    """Tags, addresses, headings and words of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href") and value]

    def handle_data(self, data):
        self.words.append(data)


def test_the_page_has_the_figures_the_warnings_and_the_files(written: Path) -> None:
    page = Page(written)
    assert "tracked 90.0 %" in page.text
    assert "frames LOST 2" in page.text
    assert f"depth {HOSTILE} (2 times)" in page.text
    assert f"{HOSTILE} 3 75 0.50 × 1.00 × 2.00 1.00, 2.00, 3.00 2" in page.text
    assert "T_world_camera of every tracked frame" in page.text
    assert page.tags.count("img") == 5, "path, errors, features, times, objects.png"


def test_the_page_is_one_file_and_every_text_is_escaped(written: Path) -> None:
    page = Page(written)
    assert "script" not in page.tags
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    svg = re.findall(r'src="(data:image/svg[^"]+)"', written.read_text())
    assert len(svg) == 4


def test_the_same_run_gives_the_same_bytes_elsewhere(run, written, tmp_path) -> None:
    other = write_run_report(run, tmp_path / "a.html")
    assert other.read_bytes() == written.read_bytes()


def test_what_is_broken_is_named_and_what_is_missing_left_out(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    for name in ("metrics.json", "trajectory.txt", "objects.png"):
        (copy / name).write_text("no such thing")
    for name in ("frames.csv", "events.csv", "config.yaml"):
        (copy / name).unlink()
    page = Page(write_run_report(copy))
    for name in ("metrics.json", "trajectory.txt", "objects.png"):
        assert re.search(rf"copy/{re.escape(name)}\S*: ", page.text), name
    assert page.tags.count("img") == 0


def test_a_film_that_is_none_does_not_get_into_the_page(run: Path, tmp_path: Path) -> None:
    """As a link to a private file in a stranger's run would."""
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (tmp_path / "private").write_text("secret")
    (copy / "film.gif").symlink_to(tmp_path / "private")
    written = write_run_report(copy)
    assert base64.b64encode(b"secret").decode() not in written.read_text()
    assert "film.gif: is no GIF" in Page(written).text


def test_no_run_and_no_folder_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no run"):
        write_run_report(tmp_path)
    with pytest.raises(InputError, match="is a folder; give the name of a file"):
        write_run_report(run, tmp_path)
    with pytest.raises(InputError, match="no such folder for the report"):
        write_run_report(run, tmp_path / "missing" / "page.html")


def test_all_errors_are_against_the_given_reference(run: Path, tmp_path: Path) -> None:
    """The run's is exact; beside one that swings by 5 cm its ATE is 5 cm in every place."""
    truth = read_tum(run.parent / "seq" / "groundtruth.txt")
    poses = truth.poses_world_camera.copy()
    poses[:, 2, 3] += 0.05 * (-1.0) ** np.arange(len(poses))
    write_tum(tmp_path / "swinging.txt", Trajectory(truth.timestamps_s, poses))
    plain = Page(write_run_report(run, tmp_path / "plain.html"))
    assert "ATE 0.00 cm" in plain.text
    page = Page(write_run_report(run, tmp_path / "given.html", tmp_path / "swinging.txt"))
    (ate_cm,) = re.findall(r"ATE ([0-9.]+) cm", page.text)
    (drawn_mm,) = re.findall(r"ATE ([0-9.]+) mm", page.text)
    (listed_m,) = re.findall(r"([0-9.]+) m +ate_rmse", page.text)
    assert float(ate_cm) == pytest.approx(4.9, abs=0.2)
    assert float(drawn_mm) == pytest.approx(10 * float(ate_cm), abs=0.1)
    assert float(listed_m) == pytest.approx(float(ate_cm) / 100, abs=1e-4)
    assert f"errors against {tmp_path / 'swinging.txt'}" in page.text


def test_a_reference_of_other_times_is_refused_as_by_evaluate(run: Path, tmp_path: Path) -> None:
    truth = read_tum(run.parent / "seq" / "groundtruth.txt")
    late = Trajectory(truth.timestamps_s + 1000, truth.poses_world_camera)
    write_tum(tmp_path / "late.txt", late)
    with pytest.raises(InputError) as of_evaluate:
        evaluate(run, tmp_path / "late.txt")
    with pytest.raises(InputError) as of_report:
        write_run_report(run, tmp_path / "page.html", tmp_path / "late.txt")
    assert str(of_report.value) == str(of_evaluate.value)
    assert "0 of 18 poses have a reference pose" in str(of_report.value)
    assert not (tmp_path / "page.html").exists()


def test_a_merged_run_is_beside_a_given_reference_by_its_own_stamps(run: Path, tmp_path) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    poses = read_tum(run / "trajectory.txt")
    write_tum(
        copy / "trajectory.txt", Trajectory(poses.timestamps_s + 30, poses.poses_world_camera)
    )
    write_parts(copy / JOINED, [Part(sequence="s", begin_s=0.0, end_s=1.9, shift_s=30.0)])
    reference = run.parent / "seq" / "groundtruth.txt"
    page = Page(write_run_report(copy, tmp_path / "page.html", reference))
    assert "ATE 0.00 cm" in page.text and "over 18 poses" in page.text
