"""``make fuzz``: broken files for every reader; prints a table, exit status 1 after a fault.

A faulty input is kept in build/fuzz. To try one again: python tests/fuzz/run.py --again READER FILE
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import warnings
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "helpers")]

from engine import fuzz, table  # noqa: E402
from readers import all_readers  # noqa: E402


def main() -> int:
    """Run as the arguments say."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=120.0, help="for all readers (120)")
    parser.add_argument("--inputs", type=int, default=10**9, help="largest number for a reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="readers whose name holds this")
    parser.add_argument("--again", nargs=2, metavar=("READER", "FILE"), help="give one input")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable()
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as folder:
        readers = [r for r in all_readers(Path(folder) / "good") if arguments.only in r.name]
        if arguments.again:
            return _again(readers, Path(folder), *arguments.again)
        counts = []
        for k, reader in enumerate(readers):
            place, seconds = Path(folder) / f"{k}", arguments.seconds / len(readers)
            counts.append(fuzz(reader, place, arguments.inputs, seconds, arguments.seed))
    print(f"seed {arguments.seed}\n{table(counts)}")
    return int(any(count.faulty for count in counts))


def _again(readers: list, folder: Path, name: str, file: str) -> int:
    """Give one input to a reader, with the whole traceback."""
    (reader,) = (r for r in readers if r.name == name)
    path = folder / "again" / reader.file
    path.parent.mkdir()
    path.write_bytes(Path(file).read_bytes())
    print(reader.read(path))
    return 0


if __name__ == "__main__":
    sys.exit(main())
