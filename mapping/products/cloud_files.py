"""Point clouds written block by block as PLY, and PCD if asked for: whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from filecmp import cmp
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Bytes
from bmask_slam.graph.files.whole_file import remove, whole_file
from bmask_slam.mapping.products.cloud import Cloud

_PLY_NAMES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort"}
_PCD_NAMES = {"f": "F", "u": "U"}
_PCD_COLUMNS = {f"n{axis}": f"normal_{axis}" for axis in "xyz"}
_PACKED = ("blue", "green", "red", "alpha")


class CloudWriter:
    """Writes blocks of a cloud as binary PLY, and as PCD, the files of ROS and PCL.

    A context manager: the files appear under their names only if its block ends without an error.

    Attributes:
        count: points written so far.
        changed: whether the PLY file is another one than before; set at the end.
    """

    def __init__(self, stem: Path, palette: Bytes | None = None, pcd: bool = False) -> None:
        """``stem`` is the path without suffix; with a ``palette`` (C, 3) points have the colours of
        their labels. Without ``pcd`` there is no such file, nor an old one of this name.
        """
        self.stem = stem
        self.count, self.changed = 0, False
        self._palette, self._pcd = palette, pcd
        self._body: IO[bytes] | None = None

    def __enter__(self) -> CloudWriter:
        self._body = tempfile.TemporaryFile(dir=self.stem.parent)
        return self

    def write(self, cloud: Cloud) -> None:
        """Append a block."""
        assert self._body is not None
        self._body.write(ply_rows(cloud, self._palette).tobytes())
        self.count += len(cloud)

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        assert self._body is not None
        with self._body as body:
            if error is None:
                self._finish(body, ".ply", _ply_header(self.count))
                remove(self.stem.with_suffix(".pcd"))
                if self._pcd:
                    self._finish(body, ".pcd", _pcd_header(self.count))

    def _finish(self, body: IO[bytes], suffix: str, header: str) -> None:
        path = self.stem.with_suffix(suffix)
        with whole_file(path) as temporary, temporary.open("wb") as out:
            out.write(header.encode("ascii"))
            body.seek(0)
            shutil.copyfileobj(body, out)
            out.flush()
            same = path.is_file() and cmp(temporary, path, shallow=False)
            self.changed |= suffix == ".ply" and not same


# PCD's rgb is a 32-bit number whose bytes are PLY's blue, green, red and alpha.
_LAYOUT = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in _PACKED),
        ("label", "<u2"),
        ("probability", "<f4"),
        ("sigma", "<f4"),
    ]
)


def ply_rows(cloud: Cloud, palette: Bytes | None = None) -> NDArray:
    """The points (N,) as rows of a PLY file; with a palette (C, 3) in the labels' colours."""
    rows = np.empty(len(cloud), _LAYOUT)
    colours = cloud.colours if palette is None else palette[cloud.labels]
    for names, values in (
        (("x", "y", "z"), cloud.points),
        (("nx", "ny", "nz"), cloud.normals),
        (("red", "green", "blue"), colours),
    ):
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    rows["alpha"] = 255
    rows["label"], rows["probability"] = cloud.labels, cloud.probabilities
    rows["sigma"] = cloud.sigmas_m
    return rows


def _columns() -> Sequence[tuple[str, np.dtype]]:
    assert _LAYOUT.fields is not None
    return [(name, _LAYOUT.fields[name][0]) for name in _LAYOUT.names or ()]


def ply_properties() -> list[str]:
    """The lines of a PLY header for ``ply_rows``."""
    return [f"property {_PLY_NAMES[kind.str]} {name}" for name, kind in _columns()]


def _ply_header(count: int) -> str:
    lines = ["ply", "format binary_little_endian 1.0", "comment bmask-slam, world frame, metres"]
    lines.append(f"element vertex {count}")
    lines += ply_properties()
    return "\n".join([*lines, "end_header\n"])


def _pcd_header(count: int) -> str:
    fields = [
        (_PCD_COLUMNS.get(n, n), k.itemsize, _PCD_NAMES[k.kind])
        for n, k in _columns()
        if n not in _PACKED
    ]
    fields.insert(6, ("rgb", 4, "U"))
    names, sizes, kinds = zip(*fields, strict=True)
    lines = [
        "# .PCD v0.7 - bmask-slam, world frame, metres",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(map(str, sizes)),
        "TYPE " + " ".join(kinds),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    ]
    return "\n".join(lines) + "\n"
