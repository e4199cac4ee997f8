"""Probability of moving: a binary Bayes filter for many landmarks at once, by their ids."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import check_ids
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.semantics.labels import UNKNOWN, LabelSet

_FIRST_CAPACITY = 1024


@dataclass(frozen=True)
class MovabilityConfig:
    """The weight of evidence.

    ``hit_rate`` is P(evidence says moving | moving) = P(evidence says static | static). Errors of
    consecutive frames are correlated, so that the likelihood of each is raised to the power
    ``frame_power``. All evidence together changes the log odds by at most ``max_evidence``, so that
    a change between moving and static is found.
    """

    hit_rate: float = 0.9
    frame_power: float = 0.25
    max_evidence: float = 2.7

    def __post_init__(self) -> None:
        if not 0.5 < self.hit_rate < 1:
            raise ValueError("hit_rate must be between 0.5 and 1")
        if not 0 < self.frame_power <= 1 or not 0 < self.max_evidence < np.inf:
            raise ValueError("frame_power must be in (0, 1], max_evidence positive")

    @property
    def step(self) -> float:
        """Log odds of one piece of evidence."""
        return float(np.log(self.hit_rate / (1 - self.hit_rate)))


class MovabilityFilter:
    """P(moving) of every id >= 0, as log odds of its prior plus those of the evidence.

    The two are stored separately, since a later label changes only the prior. ``unknown`` is the
    prior without a label.
    """

    def __init__(self, unknown: float, config: MovabilityConfig | None = None) -> None:
        self.config = config or MovabilityConfig()
        self._unknown = float(np.float32(log_odds(unknown)))  # as it is stored
        self._clear()

    def set_priors(self, ids: Ints, priors: Array) -> None:
        """Set the priors (N,) of ids (N,), by their classes."""
        self._reserve(ids)
        self._prior[ids] = log_odds(priors)

    def update(self, ids: Ints, moving: Mask, power: float = 1.0) -> None:
        """Add evidence about ids (N,), each at most once: moving or static (N,)."""
        self._reserve(ids)
        step = np.float32(power * self.config.step)
        limit = np.float32(self.config.max_evidence)
        gained = self._evidence[ids] + np.where(moving, step, -step)
        self._evidence[ids] = np.clip(gained, -limit, limit)

    def log_odds(self, ids: Ints) -> Array:
        """Log odds (N,) of moving for any ids (N,)."""
        found = np.full(len(ids), self._unknown)
        inside = ids < len(self._prior)
        found[inside] = self._prior[ids[inside]] + self._evidence[ids[inside]]
        return found

    def probabilities(self, ids: Ints) -> Array:
        """P(moving) (N,) for any ids (N,)."""
        return 1 / (1 + np.exp(-self.log_odds(ids)))

    def moving(self, ids: Ints) -> Mask:
        """Which of any ids (N,) are more likely moving than not."""
        return self.log_odds(ids) > 0

    def known_moving(self) -> Ints:
        """Ids (N,) with a prior or evidence that are more likely moving than not, ascending."""
        ids = np.flatnonzero(self._prior + self._evidence > 0)
        return ids[(self._evidence[ids] != 0) | (self._prior[ids] != self._unknown)]

    def known(self, without: Mask | None = None) -> Ints:
        """Ids (N,) with a prior or evidence, ascending, but for those of a mask (M,) of all ids."""
        known = (self._evidence != 0) | (self._prior != self._unknown)
        if without is not None:
            known[: len(without)] &= ~without[: len(known)]
        return np.flatnonzero(known)

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """Add the evidence of from_ids (N,) to that of to_ids (N,): each pair is one thing."""
        self._reserve(np.concatenate([from_ids, to_ids]))
        limit = np.float32(self.config.max_evidence)
        gained = self._evidence[from_ids]
        labelled = self._prior[from_ids] != self._unknown
        self._prior[to_ids[labelled]] = self._prior[from_ids[labelled]]
        self.drop(from_ids)
        np.add.at(self._evidence, to_ids, gained)
        self._evidence[to_ids] = np.clip(self._evidence[to_ids], -limit, limit)

    def drop(self, ids: Ints) -> None:
        """Reset ids (N,) to the prior without a label."""
        ids = ids[ids < len(self._prior)]
        self._evidence[ids] = 0.0
        self._prior[ids] = self._unknown

    def state(self) -> Arrays:
        """The filter as named arrays with one row for each known id."""
        ids = self.known()
        size = np.array(len(self._prior))
        return {
            "size": size,
            "ids": ids,
            "prior": self._prior[ids],
            "evidence": self._evidence[ids],
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        check_ids(state["ids"], int(state["size"]))
        self._clear()
        self._reserve(state["size"].reshape(1) - 1)
        self._prior[state["ids"]] = state["prior"]
        self._evidence[state["ids"]] = state["evidence"]

    def _clear(self) -> None:
        self._prior: Floats = np.full(_FIRST_CAPACITY, self._unknown, np.float32)
        self._evidence: Floats = np.zeros(_FIRST_CAPACITY, np.float32)

    def _reserve(self, ids: Ints) -> None:
        size, had = int(ids.max(initial=-1)) + 1, len(self._prior)
        if size > had:
            more = (1 << (size - 1).bit_length()) - had
            self._prior = np.concatenate([self._prior, np.full(more, self._unknown, np.float32)])
            self._evidence = np.concatenate([self._evidence, np.zeros(more, np.float32)])


@dataclass(frozen=True)
class MovabilityPriors:
    """P(moving) by class name; ``unknown`` without a label, ``other`` for all other classes."""

    by_name: Mapping[str, float]
    unknown: float
    other: float

    def of(self, labels: LabelSet) -> Array:
        """Priors (C,) of a label set's classes; label 0 is "unknown"."""
        named = [self.by_name.get(name, self.other) for name in labels.names[1:]]
        return np.array([self.unknown, *named])


def read_priors(name: str) -> MovabilityPriors:
    """Priors from a YAML file, or from the bare name of one in ``data/labels``.

    Raises:
        InputError: no such file, not a table of names and numbers, or a number outside (0, 1).
    """
    path = data_path("labels", f"{name}.yaml") if re.fullmatch(r"[\w-]+", name) else Path(name)
    content = read_yaml(path)
    if not isinstance(content, dict) or not {UNKNOWN, "other"} <= content.keys():
        raise InputError(f"{path}: needs lines 'class: prior', '{UNKNOWN}' and 'other' among them")
    for key, value in content.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not isinstance(key, str) or not number or not 0 < value < 1:
            raise InputError(f"{path}: {key}: {value!r} is no prior; give a number between 0 and 1")
    named = {key: float(value) for key, value in content.items() if key not in (UNKNOWN, "other")}
    return MovabilityPriors(named, float(content[UNKNOWN]), float(content["other"]))


def log_odds(p: float | Array) -> Array:
    """log(p / (1 - p)) of probabilities."""
    return np.log(np.asarray(p) / (1 - np.asarray(p)))
