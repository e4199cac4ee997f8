"""The process of a job of a comparison; it ends when the process that started it has ended.

Its standard input is a pipe from that process. When the pipe is closed, also because the starting
process was killed, this one ends, so that no job is left to write into a folder that is used again.
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
from bmask_slam.graph.files.whole_file import whole_file


def end_with_parent() -> None:
    """End this process at the end of standard input."""

    def wait_for_end() -> None:
        while os.read(0, 64):
            pass
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait_for_end, daemon=True).start()


def run(job: Job) -> int:
    """Run a job's command, then measure against the truth; return the exit status."""
    import cv2  # noqa: PLC0415 - after end_with_parent

    cv2.setNumThreads(int(os.environ["OMP_NUM_THREADS"]))
    figures_file(job).unlink(missing_ok=True)
    code = main(job.arguments)
    if code == 0 and job.sequence:
        from bmask_slam.comparison.jobs.truth_figures import truth_figures  # noqa: PLC0415 - as above

        figures = truth_figures(Path(job.run), Path(job.sequence))
        with whole_file(figures_file(job)) as temporary:
            temporary.write_text(json.dumps(figures), encoding="utf-8")
    return code


if __name__ == "__main__":
    end_with_parent()
    sys.exit(run(Job(**json.loads(sys.argv[1]))))
