"""Unpacking of Apple's LZFSE, whose blocks are measured before the library is asked."""

from __future__ import annotations

import struct

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra

_END, _RAW, _LZVN, _LZFSE = b"bvx$", b"bvx-", b"bvxn", b"bvx2"
_BITS_20 = (1 << 20) - 1
MAX_BLOCKS = 1 << 16


def unpack_lzfse(data: bytes, size: int, where: str) -> bytes:
    """The ``size`` bytes that a stream unpacks to; one of raw blocks needs no library.

    The library gets only streams whose blocks say that they unpack to this size.

    Raises:
        InputError: a broken stream, one of another size, or the library is not installed.
    """
    try:
        blocks = _blocks(data)
    except (struct.error, ValueError) as error:
        raise InputError(f"{where}: no LZFSE stream ({error}); export it again") from error
    unpacked = sum(raw for _, _, raw in blocks)
    if unpacked != size:
        raise InputError(f"{where}: unpacks to {unpacked} bytes, not {size}; export it again")
    if all(magic == _RAW for magic, _, _ in blocks):
        return b"".join(data[begin + 8 : begin + 8 + raw] for _, begin, raw in blocks)
    library = import_extra("lzfse", where, "record3d")
    try:
        found = bytes(library.decompress(data))
    except (library.error, MemoryError) as error:  # it asks for more and more room, too
        raise InputError(f"{where}: the LZFSE stream is broken; export it again") from error
    if len(found) != size:
        raise InputError(f"{where}: unpacks to {len(found)} bytes, not {size}; export it again")
    return found


def _blocks(data: bytes) -> list[tuple[bytes, int, int]]:
    """Magic, begin and unpacked size of each block. Raises ValueError or struct.error."""
    found: list[tuple[bytes, int, int]] = []
    at = 0
    while (magic := data[at : at + 4]) != _END:
        (raw,) = struct.unpack_from("<I", data, at + 4)
        found.append((magic, at, raw))
        if magic == _RAW:
            at += 8 + raw
        elif magic == _LZVN:
            at += 12 + int(struct.unpack_from("<I", data, at + 8)[0])
        elif magic == _LZFSE:
            first, second, third = struct.unpack_from("<3Q", data, at + 8)
            literals, matches = (first >> 20) & _BITS_20, (second >> 40) & _BITS_20
            at += (third & 0xFFFFFFFF) + literals + matches
        else:
            raise ValueError(f"block {magic!r}")
        if at + 4 > len(data) or len(found) > MAX_BLOCKS:
            raise ValueError("it is cut off")
    return found
