"""Broken inputs for readers of files: how they are made, given, and counted.

A reader may return, or raise InputError; anything else is a fault: another exception, a signal,
more than 10 s of the processor, or more than 2 GB of memory. Each reader runs in a child of its
own, so that one that takes the process with it is seen. The same seed gives the same inputs.
"""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import random
import re
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError

MAX_S, MAX_BYTES = 10.0, 2 << 30
BUSY_S = 5.0
"""That much longer a child is waited for, which may start late on a busy machine."""
WINDOW = 8192
REPORTED = 5
"""Faults of a reader that are kept, each of another place in the code."""
Make = Callable[[random.Random], bytes]
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
NUMBERS = (
    *(b"0", b"-1", b"1", b"1e999", b"nan", b"inf", b"-inf", b"1e308", b"1e-320", b"65536"),
    *(b"2147483648", b"9223372036854775807", b"9223372036854775808", b"1" + b"0" * 400),
    *(b"9" * 5000, b"0x10", b"1_0", "²".encode(), b"true", b"null", b"", b"1000000000000"),
)
TOKENS = (
    *(b"\0", b"\xff", b"\xfe\xff", b"\r", b"\n", b" ", b",", b"#", b'"', b"'", b"{", b"}", b"["),
    *(b"]", b":", b"- ", b"? ", b"&a ", b"*a", b"<<: ", b"!!int x", b"!!python/name:os.system "),
    *(
        b"../../victim",
        b"/etc/passwd",
        b"a" * 300,
        b"\xe2\x80\xa8",
        b"[" * 200,
        b"NaN",
        b"Infinity",
    ),
    *(b"%s%n", b"\x1b[31m", b"{}", b"[]", b"null", b"\x80\x04.", b"2026-99-99", b"1e999"),
)


@dataclass(frozen=True)
class Reader:
    """A reader and what it is given.

    Attributes:
        name: of the table.
        file: name of the file that is written.
        read: reads it.
        seeds: good files, from which broken ones are made.
        make: makes whole inputs, where changed bytes would mostly fail a checksum.
    """

    name: str
    file: str
    read: Callable[[Path], Any]
    seeds: tuple[bytes, ...] = ()
    make: Make | None = None


@dataclass
class Count:
    """What came of a reader's inputs."""

    reader: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    slowest_ms: float = 0.0
    peak_mb: float = 0.0
    faults: dict[str, str] = field(default_factory=dict)
    """A line of each fault, by its place in the code; the number of faults may be higher."""
    faulty: int = 0


# --- inputs --------------------------------------------------------------------------------------


def changed(seed: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """A good file after one to four changes."""
    data = bytearray(seed)
    for _ in range(rng.choice((1, 1, 2, 4))):
        rng.choice(CHANGES)(data, others, rng)
    return bytes(data)


def _flip(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _number(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    begin = rng.randrange(max(1, len(data) - WINDOW))  # of a large file a part will do
    found = list(NUMBER.finditer(data[begin : begin + WINDOW]))
    if found:
        place = rng.choice(found)
        data[begin + place.start() : begin + place.end()] = rng.choice(NUMBERS)


def _token(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    at = rng.randrange(len(data) + 1)
    data[at : at + rng.choice((0, 0, 1, 4))] = rng.choice(TOKENS)


def _bytes(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    at, size = rng.randrange(len(data) + 1), rng.choice((1, 2, 4, 8))
    data[at : at + size] = rng.choice((b"\0", b"\xff", b"\x7f", b"\x80")) * size


def _cut(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    at = rng.randrange(len(data) + 1)
    del data[at : rng.choice((len(data), at + rng.randrange(1, 64)))]


def _repeat(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    at = rng.randrange(len(data) + 1)
    part = bytes(data[at : at + rng.randrange(1, 80)])
    data[at:at] = part * rng.choice((1, 1, 2, 100))


def _line(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    begin = rng.randrange(max(1, len(data) - WINDOW))
    lines = bytes(data[begin : begin + WINDOW]).split(b"\n")
    k = rng.randrange(len(lines))
    lines.insert(rng.randrange(len(lines)), lines.pop(k) if rng.random() < 0.5 else lines[k])
    data[begin : begin + WINDOW] = b"\n".join(lines)


def _splice(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    other = rng.choice(others)
    data[rng.randrange(len(data) + 1) :] = other[rng.randrange(len(other) + 1) :]


CHANGES = (_flip, _number, _number, _token, _bytes, _cut, _repeat, _line, _splice)


def inputs(reader: Reader, seed: int) -> Iterator[bytes]:
    """Endless inputs for a reader: its good files, then broken ones."""
    yield from reader.seeds
    digest = hashlib.sha256(f"{reader.name} {seed}".encode()).digest()
    rng = random.Random(digest)
    while True:
        if reader.make is not None and (not reader.seeds or rng.random() < 0.6):
            yield reader.make(rng)
        else:
            yield changed(rng.choice(reader.seeds), reader.seeds, rng)


# --- one reader in a child -----------------------------------------------------------------------


class _HungError(BaseException):
    """A reader takes too long."""


def fuzz(reader: Reader, folder: Path, limit: int, seconds: float, seed: int = 0) -> Count:
    """Give a reader up to ``limit`` inputs in about so many seconds, in a forked child."""
    count = Count(reader.name)
    skip, end_s = 0, time.monotonic() + seconds
    while count.inputs < limit and time.monotonic() < end_s and count.faulty < 1000:
        path = folder / f"{skip}" / reader.file
        path.parent.mkdir(parents=True)
        ends = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ends[0])
            _serve(reader, path, ends[1], (skip, limit, end_s, seed))
        os.close(ends[1])
        died = _collect(count, ends[0], child)
        if died:
            count.inputs += 1
            _fault(count, died, died, path.read_bytes() if path.is_file() else b"")
        if not died:
            break
        skip = count.inputs
    return count


def _serve(reader: Reader, path: Path, out: int, bounds: tuple[int, int, float, int]) -> None:
    """The child: read input after input, report each by a line; never returns."""
    skip, limit, end_s, seed = bounds
    try:
        faulthandler.disable()
        signal.signal(signal.SIGPROF, _too_long)
        sys.setrecursionlimit(1000)
        # Some libraries hide that an allocation failed: they may take more, and it shows.
        memory = _memory_bytes("VmSize") + 3 * MAX_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        begin, peak = _memory_bytes("VmRSS"), 0
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        for k, data in enumerate(inputs(reader, seed)):
            if k >= limit or (k > skip and time.monotonic() > end_s):
                break
            if k >= skip:
                line, before = _tried(reader, path, data), peak
                peak = _memory_bytes("VmHWM") - begin
                if peak > max(MAX_BYTES, 1.05 * before) and not line["fault"]:
                    told = {"fault": f"takes {peak / 1e6:.0f} MB", "place": "memory"}
                    line |= told | {"result": "fault", "data": data.hex()}
                line["peak"] = peak
                os.write(out, json.dumps(line).encode() + b"\n")
    except BaseException:
        os.write(out, json.dumps({"broken": traceback.format_exc()}).encode() + b"\n")
    finally:
        os._exit(0)


def _too_long(number: int, frame: Any) -> None:
    raise _HungError


def _tried(reader: Reader, path: Path, data: bytes) -> dict[str, Any]:
    for other in path.parent.iterdir():  # a reader may have made files
        if other != path:
            _remove(other)
    path.write_bytes(data)
    start_s = time.perf_counter()
    signal.setitimer(signal.ITIMER_PROF, MAX_S)
    fault = place = ""
    try:
        reader.read(path)
        result = "accepted"
    except InputError:
        result = "refused"
    except BaseException as error:  # whatever it is, it is what is looked for
        result, fault = "fault", " ".join(f"{type(error).__name__}: {error}".split())[:200]
        place = _place(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    ms = 1e3 * (time.perf_counter() - start_s)
    kept = data.hex() if fault else ""
    return {"result": result, "ms": ms, "fault": fault, "place": place, "data": kept}


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def _place(error: BaseException) -> str:
    """The last line of this project's code in a traceback."""
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if "bmask_slam" in f.filename
    ] or traceback.extract_tb(error.__traceback__)
    file = "/".join(Path(frames[-1].filename).parts[-2:])
    return f"{type(error).__name__} at {file}:{frames[-1].lineno}"


def _memory_bytes(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    return 0


def _collect(count: Count, source: int, child: int) -> str:
    """Add a child's lines to the count until it ends; how it died, "" if it did not."""
    with os.fdopen(source, "rb") as lines:
        while select.select([lines], [], [], 3 * MAX_S + BUSY_S)[0] and (text := lines.readline()):
            line = json.loads(text)
            if "broken" in line:
                raise RuntimeError(f"the making of inputs for {count.reader}: {line['broken']}")
            count.inputs += 1
            count.slowest_ms = max(count.slowest_ms, line["ms"])
            count.peak_mb = max(count.peak_mb, line["peak"] / 1e6)
            if line["fault"]:
                _fault(count, line["place"], line["fault"], bytes.fromhex(line["data"]))
            else:
                setattr(count, line["result"], getattr(count, line["result"]) + 1)
    with suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL) if not _ended(child, 5.0) else None
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return f"ended by {signal.Signals(-status).name}" if status < 0 else ""


def _ended(child: int, seconds: float) -> bool:
    """Whether a child ends within some time; it stays to be waited for."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return True
        time.sleep(0.01)
    return False


def _fault(count: Count, place: str, text: str, data: bytes) -> None:
    count.faulty += 1
    if place not in count.faults and len(count.faults) < REPORTED:
        count.faults[place] = text
        keep(count.reader, place, data)


def keep(reader: str, place: str, data: bytes) -> Path:
    """Write an input that was faulty to build/fuzz, to be tried again."""
    folder = Path(os.environ.get("FUZZ_OUT", "build/fuzz"))
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w.-]+", "_", f"{reader}-{place}")[:120]
    (folder / name).write_bytes(data)
    return folder / name


# --- table ---------------------------------------------------------------------------------------

HEAD = ("reader", "inputs", "accepted", "refused", "faults", "slowest ms", "peak MB")


def table(counts: Sequence[Count]) -> str:
    """The counts as aligned text, with a line for their sums, and every fault below."""
    rows = [
        (c.reader, c.inputs, c.accepted, c.refused, c.faulty, f"{c.slowest_ms:.0f}",
         f"{c.peak_mb:.0f}") for c in counts
    ]  # fmt: skip
    sums = [sum(getattr(c, name) for c in counts) for name in SUMMED]
    slowest = max((c.slowest_ms for c in counts), default=0.0)
    peak = max((c.peak_mb for c in counts), default=0.0)
    rows.append(("all", *sums, f"{slowest:.0f}", f"{peak:.0f}"))
    texts = [tuple(map(str, row)) for row in (HEAD, *rows)]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in texts
    ]
    lines += [f"{c.reader}: {p}: {text}" for c in counts for p, text in c.faults.items()]
    return "\n".join(lines)


SUMMED = ("inputs", "accepted", "refused", "faulty")


def as_json(counts: Sequence[Count]) -> str:
    """The counts as JSON."""
    return json.dumps([asdict(count) for count in counts], indent=1)
