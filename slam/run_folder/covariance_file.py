"""covariances.txt: covariances of keyframes, computed from the graph, written and read back."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import InputError, finite_number, is_whole
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.files.whole_file import whole_file

if TYPE_CHECKING:
    from bmask_slam.graph.smoother.isam2 import SolverError
    from bmask_slam.graph.smoother.smoother import Smoother

logger = logging.getLogger(__name__)

COVARIANCES = "covariances.txt"
HEADER = """\
# covariances of keyframe poses: keyframe_id timestamp_s c11 c12 .. c16 c22 .. c66 (upper triangle)
# of xi = [rotation x y z rad, translation x y z m] in the camera's frame, on the right side:
# T_world_camera_true = T_world_camera @ exp(xi); units rad^2, rad m, m^2
# relative to the world, which the prior on the first keyframe fixes: that one's own is the prior's
"""
_UPPER = np.triu_indices(6)
_COLUMNS = 2 + len(_UPPER[0])


@dataclass(frozen=True)
class KeyframeCovariances:
    """Keyframe ids (K,), stamps (K,) in seconds, covariances (K, 6, 6) ``[rad, m]``."""

    keyframe_ids: Ints
    timestamps_s: Array
    covariances: Array


def find_covariances(smoother: Smoother, stamps_s: dict[int, float]) -> KeyframeCovariances:
    """Covariances of the keyframes with these stamps, by the graph.

    Empty, with an error in the log, if the graph is singular.
    """
    from bmask_slam.graph.smoother.isam2 import SolverError  # noqa: PLC0415 - loads GTSAM

    try:
        found = smoother.marginals()
    except SolverError as error:
        logger.error("no covariances of the graph: %s", why_singular(error))
        return KeyframeCovariances(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 6, 6)))
    rows = np.flatnonzero(np.isin(found.keyframe_ids, list(stamps_s)))
    ids = found.keyframe_ids[rows]
    stamps = np.array([stamps_s[i] for i in ids.tolist()])
    return KeyframeCovariances(ids, stamps, found.keyframes[rows])


def why_singular(error: SolverError) -> str:
    """What a graph without covariances does not determine, and what helps."""
    what = " ".join(map(str, error.variable or ("every variable",)))
    reason = str(error).partition("\n")[0]
    cure = f"add factors that determine {what}, such as a prior, or remove it"
    return f"it is singular ({reason}) and does not determine {what}; {cure}"


def write_covariances(path: Path, found: KeyframeCovariances) -> None:
    """Write the file; it appears complete or not at all."""
    rows = zip(
        found.keyframe_ids.tolist(),
        found.timestamps_s.tolist(),
        found.covariances[:, *_UPPER].tolist(),
        strict=True,
    )
    lines = [
        f"{i} {stamp:.6f} " + " ".join(f"{value:.9e}" for value in row) for i, stamp, row in rows
    ]
    with whole_file(path) as temporary:
        temporary.write_text(HEADER + "\n".join(lines) + "\n", encoding="ascii", newline="\n")


def read_covariances(path: Path) -> KeyframeCovariances:
    """Read what `write_covariances` wrote.

    Raises:
        InputError: no such file, an empty file, a wrong number of columns, a value that is not a
            finite number, an id that is not a whole number, or a matrix that is not positive
            definite.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; run with --covariances to get it")
    rows = [_row(s, f"{path}:{n}") for n, s in read_lines(path, "run with --covariances again")]
    if not rows:
        why = "the run has no keyframe, or its graph was singular: log.txt says where, and a cure"
        raise InputError(f"{path}: no covariance in the file; {why}")
    table = np.array(rows)
    covariances = np.zeros((len(table), 6, 6))
    covariances[:, *_UPPER] = table[:, 2:]
    covariances += np.triu(covariances, 1).swapaxes(1, 2)
    bad = np.linalg.eigvalsh(covariances)[:, 0] <= 0
    if bad.any():
        k = int(table[bad][0, 0])
        raise InputError(
            f"{path}: the matrix of keyframe {k} is not positive definite; correct its line"
        )
    return KeyframeCovariances(table[:, 0].astype(np.int64), table[:, 1], covariances)


def _row(line: str, where: str) -> list[float]:
    words = line.split()
    if len(words) != _COLUMNS:
        raise InputError(f"{where}: {len(words)} columns, expected {_COLUMNS}; correct the line")
    if not is_whole(words[0]):
        raise InputError(f"{where}: {words[0][:40]!r} is not a keyframe id; correct the line")
    return [finite_number(word, where) for word in words]


def rows_of(wanted: Ints, ids: Ints, values: Array) -> Array:
    """Rows (N, ...) of the wanted ids (N,) from those of ids (M,); NaN for an unknown id."""
    found = np.full((len(wanted), *values.shape[1:]), np.nan)
    order = np.argsort(ids)
    at = np.searchsorted(ids[order], wanted)
    known = np.flatnonzero(at < len(ids))
    known = known[ids[order][at[known]] == wanted[known]]
    found[known] = values[order][at[known]]
    return found
