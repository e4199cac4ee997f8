"""Shared memory of two processes: round trip, and errors if it is full."""

from __future__ import annotations

import os

import numpy as np

from bmask_slam.live.shared_memory import Ring, anonymous_file


def ends(size: int) -> tuple[Ring, Ring]:
    descriptor = anonymous_file(64 + size)
    try:
        return Ring(descriptor), Ring(descriptor)
    finally:
        os.close(descriptor)


def data(rng: np.random.Generator, size: int) -> bytes:
    return rng.integers(0, 256, size, np.uint8).tobytes()


def test_data_is_preserved_when_the_ring_wraps_around() -> None:
    rng, (writer, reader) = np.random.default_rng(0), ends(10_000)
    waiting: list[tuple[int, bytes]] = []
    refused = received = 0
    for _ in range(3000):
        if rng.random() < 0.55:
            sent = data(rng, int(rng.integers(1, 4000)))
            begin = writer.write(memoryview(sent))
            if begin is None:
                refused += 1
            else:
                waiting.append((begin, sent))
        elif waiting:
            begin, sent = waiting.pop(0)
            assert reader.read(begin, len(sent)) == sent
            received += 1
    assert refused > 100
    assert received > 500


def test_data_larger_than_the_ring_is_rejected() -> None:
    writer, reader = ends(1024)
    assert writer.write(memoryview(bytes(1025))) is None
    begin = writer.write(memoryview(bytes(range(256)) * 4))
    assert begin is not None
    assert writer.write(memoryview(b"x")) is None
    assert reader.read(begin, 1024) == bytes(range(256)) * 4
    assert writer.write(memoryview(b"x")) is not None


def test_received_bytes_are_a_writable_copy() -> None:
    writer, reader = ends(1024)
    first = writer.write(memoryview(b"first"))
    assert first is not None
    received = reader.read(first, 5)
    for _ in range(40):
        begin = writer.write(memoryview(b"other" * 10))
        assert begin is not None
        reader.read(begin, 50)
    assert received == b"first"
    np.frombuffer(received, np.uint8)[0] = 0
