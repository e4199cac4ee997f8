"""Measurements of the sensors beside the camera, by time: read from files or handed in."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.errors import InputError, finite_number
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.trajectory import check_quaternion, check_seconds

COLUMNS: dict[str, tuple[str, ...]] = {
    "odometry": ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    "accelerometer": ("timestamp", "ax", "ay", "az"),
    "position": ("timestamp", "x", "y", "z", "sigma"),
    "imu": ("timestamp", "wx", "wy", "wz", "ax", "ay", "az"),
    "markers": (
        *("timestamp", "id", "x0", "y0", "x1", "y1", "x2", "y2", "x3", "y3", "sigma"),
        *(f"{name}{corner}" for name in ("w", "sw") for corner in range(4)),
    ),
}
"""The sensors and their columns: seconds, metres, unit quaternions, m/s^2. Odometry is T_odom_base,
of which only the motion from one time to another is used; acceleration is specific force, which
points up at rest; a position is that of the antenna in a local frame with z up (ENU), its sigma
that of each coordinate; an IMU's rates w are in rad/s, its forces a in m/s^2. Markers are found in
images: their corners as `graph.sensors.markers.SeenCorners` has them."""
KEYS = {"markers": 2}
"""How many of the first columns name a row; 1 where it is the stamp."""
FILES = {s: f"{s}.txt" for s in COLUMNS if s != "markers"} | {"imu": "imu.csv"}
"""The file of each sensor beside rgb.txt. The stamps of imu.csv are in nanoseconds, as EuRoC's."""
UNITS_S = {"imu": 1e-9}
"""Of the stamps in a sensor's file, if they are not in seconds."""
OPTIONAL = {"position": 1}
"""How many of the last columns a line may lack: NaN, and the configuration says it."""
LOCAL_SPAN_M = 1e5
"""Positions farther from the first are no local frame's."""


@dataclass(frozen=True)
class Measurements:
    """Rows (N, C) of one sensor in its ``COLUMNS``, by rising time."""

    sensor: str
    rows: Array


def measurements(sensor: str, rows: ArrayLike, where: str = "") -> Measurements:
    """Checked measurements; a column that may be left out is added.

    Raises:
        InputError: an unknown sensor, another number of columns, what is no finite number, no
            rotation, no positive sigma, or stamps that do not rise.
    """
    where = where or f"add_{sensor}"
    if sensor not in FILES:
        raise InputError(f"{sensor!r} is no sensor; use one of {', '.join(FILES)}")
    names, table = COLUMNS[sensor], np.array(rows, float, ndmin=2)
    lacking = len(names) - table.shape[-1] if table.ndim == 2 else -1
    if not 0 <= lacking <= OPTIONAL.get(sensor, 0):
        raise InputError(f"{where}: shape {table.shape}; give rows of {' '.join(names)}")
    needed = len(names) - OPTIONAL.get(sensor, 0)
    table = np.pad(table, ((0, 0), (0, lacking)), constant_values=np.nan)
    for number, row in enumerate(table.tolist()):
        if not all(map(math.isfinite, row[:needed])) or math.isinf(row[-1]):
            raise InputError(f"{where}: row {number} has a value that is not finite; leave it out")
        _check_row(sensor, row, f"{where}: row {number}")
    if (np.diff(table[:, 0]) <= 0).any():
        row_number = int(np.argmax(np.diff(table[:, 0]) <= 0)) + 1
        raise InputError(f"{where}: the stamp of row {row_number} does not rise; sort the rows")
    return Measurements(sensor, table)


def read_measurements(path: Path, sensor: str) -> Measurements:
    """Read the lines of a sensor's file; they may be in any order, # begins a comment.

    Of lines with the same stamp the first is kept, as in TUM's recordings.

    Raises:
        InputError: no line, a wrong number of columns, what is no finite number, no rotation or no
            positive sigma, stamps that are not in seconds; it names file, line, value and cure.
    """
    names, optional = COLUMNS[sensor], OPTIONAL.get(sensor, 0)
    form = f"expected lines of '{' '.join(names)}'"
    rows = []
    for number, line in read_lines(path, form):
        where, words = f"{path}:{number}", line.replace(",", " ").split()
        if not len(names) - optional <= len(words) <= len(names):
            raise InputError(f"{where}: {len(words)} columns in {line[:60]!r}; {form}")
        row = [finite_number(word, where) for word in words]
        row[0] *= UNITS_S.get(sensor, 1.0)
        row += [math.nan] * (len(names) - len(row))
        _check_row(sensor, row, where)
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no measurement in the file; {form}, or remove the file")
    table = np.array(rows)
    stamps, first = np.unique(table[:, 0], return_index=True)
    if sensor in UNITS_S and len(stamps) > 1 and np.median(np.diff(stamps)) < 1e-7:
        raise InputError(f"{path}: stamps are not in nanoseconds, as EuRoC's; multiply them")
    check_seconds(stamps, path)
    if sensor == "position":
        _check_local(table, path)
    return Measurements(sensor, table[first])


def read_folder(folder: Path | None, sensors: tuple[str, ...]) -> list[Measurements]:
    """Those of the sensors whose file is in a folder, in their order; none for no folder.

    Raises:
        InputError: a file of them cannot be read; it names the setting that leaves the file out.
    """
    if folder is None:
        return []
    files = {sensor: folder / FILES[sensor] for sensor in sensors if sensor in FILES}
    found = []
    for sensor, file in files.items():
        if file.is_file():
            try:
                found.append(read_measurements(file, sensor))
            except InputError as error:
                way_out = f"sensors.{sensor}.enabled=false"
                raise InputError(f"{error} (--set {way_out} leaves the file out)") from error
    return found


def _check_row(sensor: str, row: list[float], where: str) -> None:
    if sensor == "odometry":
        check_quaternion(row[4:], where)
    if sensor == "position" and row[4] <= 0:
        raise InputError(f"{where}: sigma {row[4]:g} m is not positive; correct or leave it out")


def _check_local(table: Array, path: Path) -> None:
    far_m = np.linalg.norm(table[:, 1:4] - table[0, 1:4], axis=1)
    if (row := int(np.argmax(far_m))) and far_m[row] > LOCAL_SPAN_M:
        raise InputError(
            f"{path}: the position at {table[row, 0]:.3f} s is {far_m[row] / 1e3:.0f} km from the "
            "first; give metres in a local frame (east, north, up)"
        )


@dataclass
class SensorStreams:
    """The measurements of each sensor so far, (N, C) by rising time.

    Attributes:
        rows: by sensor.
    """

    rows: dict[str, Array] = field(default_factory=dict)
    _room: dict[str, Array] = field(default_factory=dict, repr=False, compare=False)

    def __bool__(self) -> bool:
        return bool(self.rows)

    def add(self, new: Measurements) -> None:
        """Add measurements; of those with a stamp that is known the older ones stay."""
        known = self.rows.get(new.sensor, new.rows[:0])
        if len(known) and len(new.rows) and new.rows[0, 0] > known[-1, 0]:
            self.rows[new.sensor] = self._appended(new.sensor, known, new.rows)
            return
        merged = np.concatenate([known, new.rows])
        keys = merged[:, : KEYS.get(new.sensor, 1)]
        _, first = np.unique(keys, axis=0, return_index=True)
        self.rows[new.sensor] = merged[first]

    def _appended(self, sensor: str, known: Array, later: Array) -> Array:
        """Rows and later ones, in an array with room for more: live they come a few at a time."""
        size = len(known) + len(later)
        room = self._room.get(sensor, later[:0])
        if known.base is not room or len(room) < size:
            room = self._room[sensor] = np.empty((2 * size, known.shape[1]))
            room[: len(known)] = known
        room[len(known) : size] = later
        return room[:size]

    def of(self, sensor: str) -> Array:
        """The rows (N, C) of a sensor; none if there are none."""
        return self.rows.get(sensor, np.zeros((0, len(COLUMNS[sensor]))))

    def within(self, sensor: str, begin_s: float, end_s: float) -> Array:
        """The rows (N, C) of a sensor from one time to another, both included."""
        rows = self.of(sensor)
        begin, end = np.searchsorted(rows[:, 0], [begin_s, np.nextafter(end_s, math.inf)])
        return rows[begin:end]

    def state(self) -> Arrays:
        """All rows by sensor; nothing without measurements."""
        return {sensor: self.rows[sensor] for sensor in sorted(self.rows)}

    def restore(self, state: Arrays) -> None:
        """Become the streams of a state."""
        self.rows = {sensor: state[sensor] for sensor in COLUMNS if sensor in state}
