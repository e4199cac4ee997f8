"""An IMU: which of its readings become factors between which keyframes.

What is in the graph is known by the graph's tables. A chain of factors begins where gravity is
known, or anew after a gap; a keyframe that is culled leaves a gap that the next update closes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.inertial.preintegration import moved
from bmask_slam.graph.inertial.tables import (
    InertialFactor,
    InertialState,
    InertialTables,
    InertialUpdate,
)
from bmask_slam.graph.sensors.imu import ImuConfig, begin, readings_between
from bmask_slam.graph.sensors.odometry import Motion
from bmask_slam.graph.sensors.streams import SensorStreams
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

MIN_KEYFRAMES = 3
"""Gravity is not found from fewer."""


@dataclass(frozen=True)
class _Link:
    """Two keyframes in a row, and the readings (N, 10) between them."""

    a: Keyframe
    b: Keyframe
    readings: Array


def inertial_update(
    keyframes: Sequence[Keyframe], tables: InertialTables, streams: SensorStreams, config: ImuConfig
) -> InertialUpdate:
    """The factors that can be made now between the keyframes of one segment, in their order.

    Those of another mounting are made anew.
    """
    if not config.enabled or not len(streams.of("imu")):
        return InertialUpdate()
    links, model = [], config.model
    numbers = model.numbers
    for a, b in pairwise(keyframes):
        factor = tables.factors.get((a.id, b.id))
        known = factor is not None and np.array_equal(factor.model.numbers, numbers)
        if not known and b.timestamp_s - a.timestamp_s <= config.max_apart_s:
            readings = readings_between(streams, a.timestamp_s, b.timestamp_s, config)
            if readings is not None:
                links.append(_Link(a, b, readings))
    segment = keyframes[0].segment if keyframes else 0
    if not links:
        return InertialUpdate()
    down, states = {}, {}
    if segment not in tables.down:
        chain = _longest(links)
        if chain[-1].b.timestamp_s - chain[0].a.timestamp_s < config.begin_s:
            return InertialUpdate()
        ends = [chain[0].a, *(link.b for link in chain)]
        poses = np.array([k.T_world_camera for k in ends])
        found = begin(poses, [link.readings for link in chain], config)
        if len(ends) < MIN_KEYFRAMES or found is None:
            return InertialUpdate()
        down = {segment: found.down}
        states = {k.id: state for k, state in zip(ends, found.states, strict=True)}
    states |= _restarts(links, tables, states)
    factors = [InertialFactor(k.a.id, k.b.id, segment, k.readings, model) for k in links]
    return InertialUpdate(tuple(factors), states=states, down=down)


def _longest(links: Sequence[_Link]) -> list[_Link]:
    """The chain of links without a gap that spans most time."""
    chains: list[list[_Link]] = []
    for link in links:
        if chains and chains[-1][-1].b.id == link.a.id:
            chains[-1].append(link)
        else:
            chains.append([link])
    return max(chains, key=lambda chain: chain[-1].b.timestamp_s - chain[0].a.timestamp_s)


def _restarts(
    links: Sequence[_Link], tables: InertialTables, states: dict[int, Array]
) -> dict[int, Array]:
    """States where a chain begins after a gap: the way over the time, and the last known biases."""
    known = {*tables.states, *states}
    latest = list(states.values()) or list(tables.states.values())
    found = {}
    for link in links:
        if link.a.id not in known:
            step = link.b.T_world_camera[:3, 3] - link.a.T_world_camera[:3, 3]
            velocity = step / (link.b.timestamp_s - link.a.timestamp_s)
            found[link.a.id] = np.concatenate([velocity, latest[-1][3:]])
        known |= {link.a.id, link.b.id}
    return found


def newest_state(
    keyframes: Sequence[Keyframe], tables: FactorTables, mounting: Array
) -> InertialState | None:
    """What the graph knows of the motion at the newest of these keyframes that an IMU led to.

    ``mounting`` (8,) and the delay, where they were estimated; else empty.
    """
    inertial = tables.inertial
    known = [k for k in keyframes if k.id in inertial.states]
    if not known:
        return None
    keyframe = max(known, key=lambda k: k.id)
    state, down = inertial.states[keyframe.id], inertial.down.get(keyframe.segment)
    if down is None:
        return None
    R = keyframe.T_world_camera[:3, :3].T
    motion = R @ state[:3], R @ down, state[3:]
    return InertialState(keyframe.id, keyframe.timestamp_s, *motion, mounting)


def motion_by_imu(
    streams: SensorStreams, state: InertialState, begin_s: float, end_s: float, config: ImuConfig
) -> Motion | None:
    """The camera's motion between two times after a keyframe; None where the IMU lacks them."""
    if end_s - begin_s > config.max_blackout_s or not state.timestamp_s <= begin_s:
        return None
    if begin_s - state.timestamp_s > config.max_apart_s:
        return None
    before = None
    if begin_s > state.timestamp_s:
        before = readings_between(streams, state.timestamp_s, begin_s, config)
        if before is None:
            return None
    readings = readings_between(streams, begin_s, end_s, config, config.max_gap_s)
    return None if readings is None else Motion(*moved(state, before, readings, config.model))


def carried(old: FactorTables, world: WorldMap) -> InertialUpdate:
    """The inertial part of a graph for one that is built anew, after segments were moved."""
    inertial = old.inertial
    inertial.prune(np.array([k for k in old.keyframes.ids.tolist() if k in world.keyframes]))
    turns = {}
    for k in inertial.states:
        (T_old,) = old.keyframes.get(np.array([k]))
        turns[k] = world.keyframes[k].T_world_camera[:3, :3] @ T_old[:3, :3].T
    states = {k: np.r_[turns[k] @ s[:3], s[3:]] for k, s in inertial.states.items()}
    factors, down = [], {}
    for (a, _), factor in sorted(inertial.factors.items()):
        segment = world.keyframes[a].segment
        factors.append(replace(factor, segment=segment))
        if segment not in down or factor.segment == segment:
            down[segment] = turns[a] @ inertial.down[factor.segment]
    return InertialUpdate(tuple(factors), states=states, down=down)
