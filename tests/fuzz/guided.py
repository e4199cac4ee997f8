"""Broken files guided by coverage, by atheris:  python tests/fuzz/guided.py [--seconds 600]

Needs `pip install atheris`, which has wheels for Linux and some versions of Python only. Each
reader has a process of its own, and the good files of tests/fuzz/readers.py to begin with. What
raises anything but InputError, takes more than 10 s or 4 GB, or dies is a fault; its input is kept
in build/fuzz.
"""

from __future__ import annotations

import argparse
import logging
import os
import subprocess
import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "helpers")]
KEPT = Path(os.environ.get("FUZZ_OUT", "build/fuzz")).absolute()


def main() -> int:
    """Give all readers inputs, one after the other; 1 after a fault."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="for all readers (600)")
    parser.add_argument("--only", default="", help="readers whose name holds this")
    parser.add_argument("--reader", help=argparse.SUPPRESS)  # of a child
    arguments = parser.parse_args()
    if arguments.reader:
        serve(arguments.reader, arguments.seconds)
    from readers import all_readers

    with tempfile.TemporaryDirectory() as folder:
        names = [r.name for r in all_readers(Path(folder)) if arguments.only in r.name]
    faulty = 0
    for name in names:
        words = ["--reader", name, "--seconds", f"{arguments.seconds / len(names):.0f}"]
        command = [sys.executable, __file__, *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        told = [
            line for line in done.stderr.splitlines() if line.startswith(("Done ", "==", " ==="))
        ]
        print(f"{name:32} {' '.join(told)[:160] or done.stderr[-160:]!r}", flush=True)
        faulty += done.returncode != 0
    print(f"{len(names)} readers, {faulty} with a fault")
    return int(faulty > 0)


def serve(name: str, seconds: float) -> None:
    """Give one reader inputs in this process; never returns."""
    try:
        import atheris
    except ImportError:
        sys.exit("atheris is not installed: pip install atheris")
    with atheris.instrument_imports(include=["bmask_slam"]):
        from readers import all_readers

        from bmask_slam.graph.errors import InputError
    warnings.simplefilter("ignore")
    logging.disable()
    with tempfile.TemporaryDirectory() as folder:
        (reader,) = (r for r in all_readers(Path(folder) / "good") if r.name == name)
        corpus, place = Path(folder) / "corpus", Path(folder) / "tried"
        for path in (corpus, place, KEPT):
            path.mkdir(parents=True, exist_ok=True)
        for k, seed in enumerate(reader.seeds):
            (corpus / f"{k}").write_bytes(seed)

        def one(data: bytes) -> None:
            (place / reader.file).write_bytes(data)
            with suppress(InputError):
                reader.read(place / reader.file)

        bounds = [f"-max_total_time={seconds:.0f}", "-timeout=10", "-rss_limit_mb=4096"]
        where = f"-artifact_prefix={KEPT / name.replace('/', '_').replace(' ', '_')}-"
        atheris.Setup([sys.argv[0], *bounds, where, "-max_len=65536", str(corpus)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
