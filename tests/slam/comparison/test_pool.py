"""Jobs in processes of their own: outcomes, killing, and records."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from repository import ROOT

from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.job import Job, Outcome, environment, finished, read_record, run_job
from bmask_slam.comparison.jobs.pool import LocalPool
from bmask_slam.graph.errors import InputError

POSES = "".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(5))


def job(folder: Path, name: str = "one", *arguments: str) -> Job:
    """A conversion of a small trajectory: the quickest command that makes a file."""
    (folder / "poses.txt").write_text(POSES)
    product = folder / f"{name}.kitti"
    words = ("export", str(folder / "poses.txt"), "--format", "kitti", "--out", str(product))
    record, log = folder / name / "record.json", folder / name / "log.txt"
    return Job(name, name, arguments or words, str(product), str(record), str(log), {"code": "1"})


def endless(folder: Path, name: str = "endless") -> Job:
    """A job that waits for a folder to grow."""
    return job(folder, name, "live", str(folder), "--follow", "--silence", "1000")


def is_running(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] not in "ZX"


def wait_for(condition, limit_s: float = 300) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_job_does_not_import_from_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "argparse.py").write_text("from pathlib import Path; Path('ran').touch()")
    monkeypatch.chdir(tmp_path)
    assert run_job(job(tmp_path)).status is CellStatus.DONE
    assert not (tmp_path / "ran").exists()


def test_a_recorded_job_is_finished_until_its_inputs_change(tmp_path):
    given = job(tmp_path)
    assert finished(given) is None
    outcome = run_job(given)
    assert outcome.status is CellStatus.DONE
    assert 0 < outcome.wall_s < 60
    assert finished(given) == outcome == read_record(Path(given.record))
    assert finished(replace(given, depends={"code": "2"})) is None
    Path(given.product).unlink()
    assert finished(given) is None


@pytest.mark.parametrize("text", ["", "{", "[]", '{"status": "odd"}', '{"stat": "done"}'])
def test_a_broken_record_is_ignored(tmp_path, text):
    (tmp_path / "record.json").write_text(text)
    assert read_record(tmp_path / "record.json") is None


def test_a_failure_is_recorded_with_its_reason(tmp_path):
    given = job(tmp_path, "one", "export", str(tmp_path / "nothing"), "--format", "kitti")
    given = replace(given, arguments=(*given.arguments, "--out", given.product))
    outcome = run_job(given)
    assert outcome.status is CellStatus.FAILED
    assert "no such" in outcome.error
    assert finished(given) is None
    assert "error: " in Path(given.log).read_text()


def test_threads_are_limited():
    found = environment(3)
    assert found["OMP_NUM_THREADS"] == found["OPENBLAS_NUM_THREADS"] == "3"


def test_a_pool_runs_all_and_passes_on_failures(tmp_path):
    good = [job(tmp_path, f"j{k}") for k in range(2)]
    bad = job(tmp_path, "bad", "info", str(tmp_path / "nothing"))
    found = {j.name: outcome.status for j, outcome in LocalPool(2).run([*good, bad])}
    done, failed = CellStatus.DONE, CellStatus.FAILED
    assert found == {"j0": done, "j1": done, "bad": failed}


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_closing_a_pool_kills_running_jobs(tmp_path):
    pids: list[int] = []

    class RecordingPool(LocalPool):
        def _started(self, process):
            pids.append(process.pid)
            super()._started(process)

    jobs = RecordingPool(2).run([job(tmp_path), endless(tmp_path)])
    assert next(jobs)[0].name == "one"
    wait_for(lambda: len(pids) == 2)
    jobs.close()
    wait_for(lambda: not any(is_running(pid) for pid in pids))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_a_job_ends_when_the_process_that_started_it_is_killed(tmp_path):
    code = (
        "import json, sys; from bmask_slam.comparison.jobs.job import Job, run_job\n"
        "run_job(Job(**json.loads(sys.argv[1])), started=lambda p: print(p.pid, flush=True))"
    )
    import json
    from dataclasses import asdict

    command = [sys.executable, "-c", code, json.dumps(asdict(endless(tmp_path)))]
    starter = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment(1), cwd=ROOT)
    with starter:
        pid = int(starter.stdout.readline())
        assert is_running(pid)
        starter.send_signal(signal.SIGKILL)
    wait_for(lambda: not is_running(pid))


def test_jobs_on_a_local_ray(tmp_path):
    pytest.importorskip("ray")
    from bmask_slam.comparison.jobs.pool import RayPool

    with RayPool("local") as pool:
        assert pool.workers == 1
        bad = job(tmp_path, "bad", "info", str(tmp_path / "nothing"))
        found = {j.name: outcome for j, outcome in pool.run([job(tmp_path), bad])}
    assert {name: o.status.value for name, o in found.items()} == {"one": "done", "bad": "failed"}
    assert isinstance(found["one"], Outcome)


def test_an_address_without_a_cluster_is_refused():
    pytest.importorskip("ray")
    from bmask_slam.comparison.jobs.pool import RayPool

    with pytest.raises(InputError, match="nothing answers there"):
        RayPool("127.0.0.1:1")
