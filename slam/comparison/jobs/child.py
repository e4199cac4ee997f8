"""The process of a job: ends itself when the one that started it is gone.

A job is told to stop by closing its standard input, which also happens when the starting process
is killed, so that no job is left behind to write into a folder that is used again.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path

from bmask_slam.cli import main
from bmask_slam.comparison.jobs.job import Job, figures_file


def watch_parent() -> None:
    """End this process at the end of standard input."""

    def watch() -> None:
        while os.read(0, 64):
            pass
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def work(job: Job) -> int:
    """Run a job's command, then compare with the truth; the exit status."""
    import cv2  # noqa: PLC0415 - after the parent is watched

    cv2.setNumThreads(int(os.environ["OMP_NUM_THREADS"]))
    figures_file(job).unlink(missing_ok=True)
    code = main(job.arguments)
    if code == 0 and job.sequence:
        from bmask_slam.comparison.jobs.truth_figures import truth_figures  # noqa: PLC0415 - as above

        figures = truth_figures(Path(job.run), Path(job.sequence))
        figures_file(job).write_text(json.dumps(figures), encoding="utf-8")
    return code


if __name__ == "__main__":
    watch_parent()
    sys.exit(work(Job(**json.loads(sys.argv[1]))))
