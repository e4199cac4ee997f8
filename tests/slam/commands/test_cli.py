"""The command line as a user meets it: output, exit status, one-line errors, quick help."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fake_run import make_sequence, true_trajectory
from repository import ROOT
from source_tree import SOURCES, location

import bmask_slam.rendering.sequence
from bmask_slam import cli
from bmask_slam.commands import sequences
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation.recordings import JOINED, Part, write_parts
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.trajectory import write_tum
from bmask_slam.offline.runner import RunSummary
from bmask_slam.rendering.config import SCENES, RenderConfig
from bmask_slam.run_folder.origin import Origin
from bmask_slam.runtime.progress import console_log
from bmask_slam.system_config import SystemConfig

HEAVY = ("numpy", "cv2", "gtsam", "open3d", "torch", "pydantic", "ruamel.yaml")
COMMANDS = ("run", "evaluate", "render", "info", "optimise", "export", "calibrate")


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a command in this process."""
    try:
        status = cli.main([str(a) for a in arguments])
    except SystemExit as end:
        status = int(end.code or 0)
    return status, *capsys.readouterr()


def test_paths_in_commands_that_messages_show_are_quoted_for_the_shell() -> None:
    shown = re.compile(r"f\"[^\"]*bmask-slam (?:run|map|--)[^\"{]*\{(?!quote\()")
    found = [f"{location(p)}: {m[0]}" for p in SOURCES for m in shown.finditer(p.read_text())]
    assert not found


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return make_sequence(tmp_path / "seq")


@pytest.mark.parametrize("arguments", [["--help"], *([c, "--help"] for c in COMMANDS)])
def test_help_answers_without_heavy_imports(arguments: list[str]) -> None:
    code = (
        "import sys; from bmask_slam.cli import main\n"
        f"try: main({arguments!r})\n"
        f"finally: print(set({HEAVY!r}) & set(sys.modules))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "usage: bmask-slam" in done.stdout
    assert done.stdout.endswith("set()\n")


def test_libraries_wait_without_spinning(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")  # a user's own choice
    monkeypatch.setenv("OMP_WAIT_POLICY", "")
    monkeypatch.delenv("OMP_WAIT_POLICY")
    call(capsys, "--version")
    assert [os.environ[name] for name in cli.WAITING] == ["3", "PASSIVE"]


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys, "--version") == (0, f"bmask-slam {bmask_slam.__version__}\n", "")


def test_python_m_bmask_slam() -> None:
    command = [sys.executable, "-m", "bmask_slam", "--version"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == f"bmask-slam {bmask_slam.__version__}\n"


def test_completion_knows_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    status, output, _ = call(capsys, "--print-completion", "bash")
    assert status == 0
    for command in ("run", "evaluate-segmentation", "compare"):
        assert command in output
    assert "--checkpoint-every" in output
    assert "_shtab_bmask_slam_report_pos_0_COMPGEN=_shtab_compgen_files" in output
    assert subprocess.run(["bash", "-n"], input=output, text=True, check=True).returncode == 0


def test_no_command_and_a_wrong_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys)[0] == 2
    status, _, errors = call(capsys, "rum")
    assert status == 2
    assert "invalid choice: 'rum'" in errors
    assert errors.endswith("; did you mean run?\n")
    errors = call(capsys, "run", "x", "--qiuet")[2]
    assert errors.endswith("unrecognized arguments: --qiuet; did you mean --quiet?\n")


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("run", "seq", "--config", "papre"), "paper"),
        (("compare", "rendred"), "rendered"),
        (("compare", "rendered", "--sequences", "offce"), "office"),
        (("render", "livingroom", "--out", "x"), "living_room"),
        (("run", "sq"), "seq"),
    ],
)
def test_a_mistyped_name_is_suggested(capsys, sequence, monkeypatch, arguments, meant) -> None:
    monkeypatch.chdir(sequence.parent)
    status, _, errors = call(capsys, *arguments)
    assert (status, errors.endswith(f"; did you mean {meant}?\n")) == (1, True), errors


def test_results_as_json_and_the_log_on_stderr(capsys, sequence, tmp_path) -> None:
    file = tmp_path / "path.txt"
    write_tum(file, true_trajectory(5))
    words = ("export", file, "--format", "kitti", "--out", tmp_path / "k.txt", "--json")
    status, output, _ = call(capsys, *words)
    assert (status, json.loads(output)["files"][0]) == (0, str(tmp_path / "k.txt"))
    assert call(capsys, *words, "--quiet")[0] == 2
    status, output, _ = call(capsys, "convert", sequence, tmp_path / "c", "--json", "-v")
    assert (status, json.loads(output)["colour"]) == (0, 20)
    with console_log(logging.INFO):
        logging.getLogger("bmask_slam.x").info("done so far")
    assert "INFO: done so far" in capsys.readouterr().err


def test_run_prints_table_folder_and_picture(capsys, sequence: Path, tmp_path: Path) -> None:
    status, output, _ = call(capsys, "run", sequence, "--out", tmp_path / "out")
    assert status == 0
    assert re.search(r"^tracked_share +[\d.]+ %$", output, re.MULTILINE)
    assert str(tmp_path / "out/trajectory.png") in output
    rows = json.loads((tmp_path / "out/metrics.json").read_text())
    assert {"tracked_share", "frames_per_second", "peak_rss_mb"} <= {row["name"] for row in rows}


def test_covariances_are_written_on_request(capsys, sequence: Path, tmp_path: Path) -> None:
    """Nothing is tracked, so there are none, and the run finishes."""
    out = tmp_path / "out"
    assert call(capsys, "run", sequence, "--out", out, "--covariances", "--quiet")[0] == 0
    assert (out / "covariances.txt").read_text().startswith("# covariances of keyframe poses")
    assert "covariances: true" in (out / "config.yaml").read_text()
    assert call(capsys, "run", sequence, "--out", out, "--overwrite", "--quiet")[0] == 0
    assert not (out / "covariances.txt").exists()


def test_quiet_run_prints_only_the_folder(capsys, sequence: Path, tmp_path: Path) -> None:
    found = call(capsys, "run", sequence, "--out", tmp_path / "out", "--quiet", "--max-frames", 3)
    assert found[:2] == (0, f"{tmp_path / 'out'}\n")
    assert "frame" not in found[2]


def test_print_config_resolves_back(capsys, tmp_path: Path) -> None:
    status, output, _ = call(
        capsys, "run", "-", "--print-config", "--set", "tracking.min_inliers=33"
    )
    (tmp_path / "c.yaml").write_text(output)
    assert status == 0
    assert resolve(SystemConfig, tmp_path / "c.yaml").tracking.min_inliers == 33


@pytest.mark.parametrize("file", sorted(data_path("configs").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_shipped_configuration_runs(capsys, sequence: Path, tmp_path: Path, file) -> None:
    out = tmp_path / "out"
    status, _, errors = call(capsys, "run", sequence, "--out", out, "--config", file.stem)
    assert (status, errors.count("error")) == (0, 0)
    assert resolve(SystemConfig, out / "config.yaml") == resolve(SystemConfig, file)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "nowhere"], "nowhere: no such folder"),
        (["run", "seq", "--set", "tracking.min_inlier=3"], "did you mean tracking.min_inliers?"),
        (["run", "seq", "--config", "papper"], "papper.yaml: no such file; there are:"),
        (["run", "seq", "--stride", "0"], "--stride 0: must be"),
        (["run", "seq", "--out", "seq/rgb.txt"], "seq/rgb.txt: is a file"),
        (["run", "seq", "--reference", "none.txt"], "none.txt: no such file"),
        (["info", "nowhere"], "nowhere: no such folder"),
        (["evaluate", "none.txt", "--reference", "seq"], "none.txt: no such file"),
        (["render", "attic", "--out", "x"], "choose one of office"),
        (["render", "office", "--out", "x", "--frames", "0"], "frames=0"),
        (["render", "office", "--out", "x", "--seed", "-1"], "seed=-1: must not be negative"),
        (["info", "seq/rgb.txt"], "seq/rgb.txt: a file, and no recording"),
        (["run", "seq", "--set", "tracking.min_inliers=-3"], "= -3 is negative; give 0 or more"),
        (["run", "seq", "--set", "graph.relinearize_skip=0"], "= 0: must be at least 1"),
        (["live", "seq", "--max-frames", "0"], "--max-frames 0: must be a whole number"),
        (["live", "seq", "--map", "--map-frames", "nan"], "--map-frames nan: must be 0 or more"),
        (["live", "seq", "--map-frames", "3"], "--map-frames 3: is for the dense map; give --map"),
        (["run", "seq", "--mesh-voxel", "0.03"], "--mesh-voxel 0.03: is for the dense map; give"),
        (["workstation", "--port", "99999", "--token-file", "t"], "--port 99999: give one from 0"),
        (
            ["evaluate-segmentation", "--data", "x", "--images", "seq", "--plot", "none/a.png"],
            "none/a.png: the folder none is not there",
        ),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_files(
    capsys, sequence: Path, tmp_path: Path, monkeypatch, arguments: list[str], expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    status, output, errors = call(capsys, *arguments)
    lines = [line for line in errors.splitlines() if line.startswith("error: ")]
    assert (status, output) == (1, "")
    assert len(lines) == 1
    assert expected in lines[0]
    assert "Traceback" not in errors
    assert sorted(tmp_path.rglob("*")) == before


def test_a_run_over_a_run_is_refused_until_overwrite(capsys, sequence: Path, tmp_path) -> None:
    command = ("run", sequence, "--out", tmp_path / "out", "--max-frames", 2, "--quiet")
    assert call(capsys, *command)[0] == 0
    status, _, errors = call(capsys, *command)
    assert status == 1
    assert "already holds a run" in errors
    assert call(capsys, *command, "--overwrite")[0] == 0


def test_evaluate_table_json_and_plot(capsys, sequence: Path, tmp_path: Path) -> None:
    estimate = true_trajectory(20)
    estimate.poses_world_camera[::2, 2, 3] += 0.06
    write_tum(tmp_path / "e.txt", estimate)
    plot = tmp_path / "p.png"
    command = ("evaluate", tmp_path / "e.txt", "--reference", sequence)
    status, output, _ = call(capsys, *command, "--json", "--plot", plot)
    rows = {row["name"]: row["value"] for row in json.loads(output)}
    assert status == 0
    assert rows["ate_rmse"] == pytest.approx(0.03, rel=0.02)
    assert plot.exists()
    assert re.search(r"^ate_rmse +0\.0299 m$", call(capsys, *command)[1], re.MULTILINE)


def test_no_scale_of_an_estimate_that_does_not_move(capsys, sequence: Path, tmp_path: Path) -> None:
    still = true_trajectory(20)
    still.poses_world_camera[:, :3, 3] = 1.0, 2.0, 3.0
    write_tum(tmp_path / "still.txt", still)
    command = ("evaluate", tmp_path / "still.txt", "--reference", sequence)
    assert call(capsys, *command)[0] == 0
    status, output, errors = call(capsys, *command, "--with-scale")
    assert (status, output, errors.count("\n")) == (1, "", 1)
    assert f"{tmp_path / 'still.txt'} against" in errors
    assert "does not move" in errors and "omit --with-scale" in errors


def test_info(capsys, sequence: Path) -> None:
    status, output, _ = call(capsys, "info", sequence)
    assert status == 0
    assert re.search(r"^frames +20 in 1.90 s, 10.00 Hz$", output, re.MULTILINE)


def test_info_of_a_run_is_that_of_its_recordings(capsys, sequence: Path, tmp_path: Path) -> None:
    merged, alone = tmp_path / "merged", tmp_path / "alone"
    for run in (merged, alone):
        run.mkdir()
        (run / "config.yaml").write_text(f"# {Origin(sequence)}\n")
    parts = [
        Part(sequence=str(sequence), begin_s=0.0, end_s=1.9, shift_s=shift_s)
        for shift_s in (0.0, 12.0)
    ]
    write_parts(merged / JOINED, parts)
    status, output, _ = call(capsys, "info", merged)
    assert status == 0
    assert re.search(r"^frames +40 in 13.90 s, 10.00 Hz$", output, re.MULTILINE)
    assert call(capsys, "info", alone) == call(capsys, "info", sequence)


def test_render_help_names_every_scene(capsys) -> None:
    output = " ".join(call(capsys, "render", "--help")[1].split())
    assert all(name in output for name in SCENES)


def test_render_options_reach_the_renderer(capsys, monkeypatch, tmp_path: Path) -> None:
    calls = []

    def render(config: RenderConfig, out: Path, progress) -> Path:
        calls.append((config, out))
        progress(1, 2)
        progress(2, 2)
        return out

    monkeypatch.setattr(bmask_slam.rendering.sequence, "render_sequence", render)
    options = [
        "--frames",
        "2",
        "--seed",
        "7",
        "--people",
        "3",
        "--no-noise",
        "--motion-blur",
        "--fps",
        "15",
        "--rounds",
        "2",
    ]
    status, output, errors = call(capsys, "render", "corridor", "--out", tmp_path, *options)
    expected = RenderConfig("corridor", 2, 7, 3, noise=False, motion_blur=True, fps=15.0, rounds=2)
    assert (status, calls) == (0, [(expected, tmp_path)])
    assert f"bmask-slam run {tmp_path}" in output
    assert "2/2" in errors


@pytest.mark.parametrize(
    ("error", "status", "expected"),
    [
        (InputError("a file:\nwrong"), 1, "error: a file: wrong\n"),
        (OSError(28, "No space left on device", "f"), 1, "error: f: No space left on device"),
        (OSError(28, "No space left on device"), 1, "error: output: No space left on device"),
        (OSError(28, "No space left", "read", None, "written"), 1, "error: written: No space left"),
        (OSError(13, "Permission denied", "f"), 1, "error: f: Permission denied; change its perm"),
        (OSError(5, "Input/output error"), 1, "error: output: Input/output error; the disk or the"),
        (OSError(24, "Too many open files"), 1, "error: output: Too many open files; raise the"),
        (OSError(30, "Read-only file system", "f"), 1, "error: f: Read-only file system; change"),
        (OSError(12, "Cannot allocate memory"), 1, "error: out of memory; free some"),
        (MemoryError(), 1, "error: out of memory; free some"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_expected_errors(capsys, monkeypatch, error, status: int, expected: str) -> None:
    def fail(arguments: object) -> int:
        raise error

    monkeypatch.setattr(sequences, "_info", fail)
    found = call(capsys, "info", "x")
    assert found[0] == status
    assert found[2].startswith(expected)


@pytest.mark.parametrize(
    "words", ["convert {sequence} {file}/b", "convert {sequence} {file}/b/c",
              "download tum/freiburg1_xyz --to {file}/b", "workstation --token-file {file}/b"],
)  # fmt: skip
def test_a_file_in_the_place_of_a_folder(capsys, sequence: Path, tmp_path: Path, words) -> None:
    file = tmp_path / "file"
    file.write_text("")
    given = words.format(sequence=sequence, file=file).split()
    status, _, errors = call(capsys, *given)
    assert status == 1
    assert re.search(rf"error: {file}\S*: .*; a file is where a folder has to be", errors)


@pytest.mark.skipif(sys.platform != "linux", reason="needs a file that cannot be read")
def test_a_disk_that_fails_is_named_with_the_file(capsys, sequence: Path) -> None:
    """It passed for a terminal that was closed, after which nothing is said."""
    (sequence / "rgb.txt").unlink()
    (sequence / "rgb.txt").symlink_to("/proc/self/mem")  # its first page is nobody's
    status, _, errors = call(capsys, "info", sequence)
    expected = f"error: {sequence}/rgb.txt: Input/output error; the disk or the connection"
    assert (status, errors[: len(expected)]) == (1, expected)


def test_a_signal_while_a_library_loads(capsys, monkeypatch, request) -> None:
    """GTSAM's loader turns what is raised in it into an ImportError."""

    def load(arguments: object) -> int:
        try:
            signal.raise_signal(number)
        except BaseException as error:
            raise ImportError("initialization failed") from error
        return 0

    monkeypatch.setattr(sequences, "_info", load)
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)  # Ray sets one where it was begun
    request.addfinalizer(lambda: signal.signal(signal.SIGTERM, before))
    for number, said in ((signal.SIGINT, "interrupted"), (signal.SIGTERM, "ended by SIGTERM")):
        assert call(capsys, "info", "x") == (128 + number, "", f"{said}\n")


def test_unknown_errors_keep_their_traceback(monkeypatch) -> None:
    def fail(arguments: object) -> int:
        raise ProcessLookupError(3, "No such process")

    monkeypatch.setattr(sequences, "_info", fail)
    with pytest.raises(ProcessLookupError):
        cli.main(["info", "x"])


def test_a_stopped_run_reports_it(capsys, monkeypatch, sequence: Path) -> None:
    import bmask_slam.offline.runner

    summary = RunSummary(Path("r"), [], 7, 2, signal.SIGTERM)
    monkeypatch.setattr(bmask_slam.offline.runner, "run", lambda options: summary)
    status, output, _ = call(capsys, "run", sequence)
    assert status == 143
    assert "Stopped by SIGTERM after 7 frames; all is saved" in output
    assert "2 broken frames were skipped" in output


def test_a_closed_output_pipe_is_not_an_error(sequence: Path) -> None:
    command = f"{sys.executable} -m bmask_slam info {sequence} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", ["info {sequence}", "--help", "run --help"])
@pytest.mark.parametrize(
    ("output", "status", "error"),
    [
        ("| true", 141, ""),
        ("> /dev/full", 1, "error: output: No space left on device; free some space\n"),
    ],
)
def test_output_that_cannot_be_written(sequence, words: str, output: str, status, error) -> None:
    """Python keeps what is printed to a pipe or file until the end, unless it is told not to."""
    command = f"{sys.executable} -m bmask_slam {words.format(sequence=sequence)} {output}"
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    script = ["bash", "-c", f"{command}; exit ${{PIPESTATUS[0]}}"]
    done = subprocess.run(script, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, error)


@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_a_command_without_standard_streams(sequence: Path, tmp_path: Path, closed: str) -> None:
    """As some services start programs: a bar has nowhere to go, and no file takes their numbers."""
    out = tmp_path / "out"
    command = f"{sys.executable} -m bmask_slam convert {sequence} {out} --max-frames 1 {closed}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (out / "camera.yaml").is_file()


@pytest.mark.parametrize("words", [["info", "büro"], ["info", "--json", "büro"]])
def test_output_that_holds_no_such_letter_has_its_code(tmp_path: Path, words: list[str]) -> None:
    """As with PYTHONIOENCODING=ascii; of a path that is no text with UTF-8 too."""
    make_sequence(tmp_path / "büro")
    command = [sys.executable, "-m", "bmask_slam", *words]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"b.(xfc|u00fc)ro", done.stdout)
