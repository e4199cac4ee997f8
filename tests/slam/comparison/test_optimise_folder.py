"""``bmask-slam optimise`` over a folder: each graph once, a broken one does not stop the others."""

from pathlib import Path

import pytest

from bmask_slam import cli
from bmask_slam.comparison import optimise_folder
from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.job import Job, Outcome, write_record

GRAPH = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"


class InThisProcess:
    """A pool that runs each job's command here."""

    workers = 1

    def __enter__(self) -> "InThisProcess":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: list[Job]):
        for job in jobs:
            Path(job.record).parent.mkdir(parents=True, exist_ok=True)
            Path(job.log).write_text("final cost     0.25\nvertices       2\n")
            code = cli.main(job.arguments)
            status = CellStatus.FAILED if code else CellStatus.DONE
            outcome = Outcome(status, "why" if code else "", 1.0, {}, job.depends)
            write_record(Path(job.record), outcome)
            yield job, outcome


@pytest.fixture
def pools(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int | None, str | None]]:
    asked: list[tuple[int | None, str | None]] = []

    def pool(workers: int | None, ray: str | None) -> InThisProcess:
        asked.append((workers, ray))
        return InThisProcess()

    monkeypatch.setattr(optimise_folder, "job_pool", pool)
    return asked


def test_each_graph_is_optimised_once(capsys, pools, tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    (folder / "a.g2o").write_text(GRAPH)
    (folder / "b.graph").write_text("EDGE2 0 1 1 0\n")
    (folder / "notes.txt").write_text("no graph")
    words = ["optimise", str(folder), "--out", str(out), "--ray", "auto"]
    assert cli.main(words) == 1
    lines = capsys.readouterr().out.splitlines()[-2:]
    assert lines == ["a.g2o    done in 1.0 s; final cost 0.25", "b.graph  failed: why"]
    assert pools == [(None, "auto")]
    assert "VERTEX_SE2 1 1 0 0" in (out / "a.g2o").read_text()
    (folder / "b.graph").write_text("EDGE2 0 1 1 0 0\n")
    (out / "a.g2o").write_text("kept")
    assert cli.main(words) == 0
    assert (out / "a.g2o").read_text() == "kept"
    assert "VERTEX_SE2 1 1 0 0" in (out / "b.graph").read_text()
    assert cli.main([*words, "--repair"]) == 0
    assert "VERTEX_SE2 1 1 0 0" in (out / "a.g2o").read_text()


def test_folders_and_options_that_do_not_fit(capsys, tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text(GRAPH)
    words = ["optimise", str(tmp_path), "--out"]
    assert cli.main([*words, str(tmp_path)]) == 1
    assert "choose another --out" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert cli.main(["optimise", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 1
    assert "no run folder" in capsys.readouterr().err
    assert cli.main(["optimise", str(tmp_path / "a.g2o"), "--out", "x.g2o", "--jobs", "2"]) == 1
    assert "--jobs" in capsys.readouterr().err


@pytest.mark.parametrize("jobs", ["0", "-3"])
def test_less_than_one_job_at_a_time_is_refused(capsys, pools, tmp_path: Path, jobs: str) -> None:
    (tmp_path / "a.g2o").write_text(GRAPH)
    words = ["--out", str(tmp_path / "out"), "--jobs", jobs]
    assert cli.main(["optimise", str(tmp_path), *words]) == 1
    assert f"--jobs {jobs}: must be at least 1" in capsys.readouterr().err
    assert cli.main(["optimise", str(tmp_path / "a.g2o"), *words]) == 1
    assert "--ray, --jobs: are for a folder" in capsys.readouterr().err
    assert not pools
    assert not (tmp_path / "out").exists()
