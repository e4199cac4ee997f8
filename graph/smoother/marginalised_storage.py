"""Marginalised landmarks as arrays for the file of a saved graph, and back."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations, concatenate
from bmask_slam.graph.factors.marginalised_landmarks import Chunk, MarginalisedLandmarks, Summary

SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "archived_chunks": ("archived observation", ()),
    "archived_keyframe_ids": ("archived observation", ()),
    "archived_landmark_ids": ("archived observation", ()),
    "archived_measurements": ("archived observation", (3,)),
    "archived_sigmas_px": ("archived observation", (3,)),
    "archived_is_summary": ("archived observation", ()),
    "summary_landmark_ids": ("summary", ()),
    "summary_keyframe_ids": ("summary", ()),
    "summary_measurements": ("summary", (3,)),
    "summary_sigmas_px": ("summary", (3,)),
    "summary_returned": ("summary", ()),
    "pose_factor_chunks": ("pose factor", ()),
    "base_ids": ("base", ()),
}
"""Name, what its rows are, and the shape of one; ``pose_factor_chunks`` is the chunk that each
pose factor replaces, or -1."""


def marginalised_arrays(tables: FactorTables) -> Arrays:
    """Arrays of the marginalised landmarks, without what refers to removed keyframes."""
    marginalised, known = tables.marginalised, tables.keyframes
    chunks = sorted(marginalised.chunks.items())
    observations = concatenate([chunk.observations for _, chunk in chunks])
    number = np.repeat([n for n, _ in chunks], [len(c.observations) for _, c in chunks])
    is_summary = np.concatenate([np.zeros(0, bool), *(c.is_summary for _, c in chunks)])
    keep = known.contains(observations.keyframe_ids)
    observations = observations.select(keep)
    chunk_of = {n: number for number, chunk in chunks for n in chunk.numbers}
    summaries = sorted({**marginalised.summaries, **marginalised.returned}.items())
    hosts = np.array([s.keyframe_id for _, s in summaries], np.int64)
    ids = np.array([j for j, _ in summaries], np.int64)
    present = known.contains(hosts)
    return {
        "archived_chunks": number[keep].astype(np.int64),
        "archived_keyframe_ids": observations.keyframe_ids,
        "archived_landmark_ids": observations.landmark_ids,
        "archived_measurements": observations.measurements,
        "archived_sigmas_px": observations.sigmas_px,
        "archived_is_summary": is_summary[keep],
        "summary_landmark_ids": ids[present],
        "summary_keyframe_ids": hosts[present],
        "summary_measurements": np.array([s.measurement for _, s in summaries]).reshape(-1, 3)[
            present
        ],
        "summary_sigmas_px": np.array([s.sigmas_px for _, s in summaries]).reshape(-1, 3)[present],
        "summary_returned": np.isin(ids, sorted(marginalised.returned))[present],
        "base_ids": np.array(sorted(marginalised.bases), np.int64),
        "pose_factor_chunks": np.array(
            [chunk_of.get(n, -1) for n in sorted(tables.pose_factors)], np.int64
        ),
    }


def read_marginalised(arrays: Arrays) -> MarginalisedLandmarks:
    """The landmarks of arrays that were checked; pose factors are numbered 0, 1, ..."""
    marginalised = MarginalisedLandmarks(bases=set(arrays["base_ids"].tolist()))
    observations = Observations(
        arrays["archived_keyframe_ids"],
        arrays["archived_landmark_ids"],
        arrays["archived_measurements"],
        arrays["archived_sigmas_px"],
    )
    for number in np.unique(arrays["archived_chunks"]).tolist():
        rows = np.flatnonzero(arrays["archived_chunks"] == number)
        edges = np.flatnonzero(arrays["pose_factor_chunks"] == number)
        chunk = Chunk(
            observations.select(rows), arrays["archived_is_summary"][rows], tuple(edges.tolist())
        )
        marginalised.add(chunk, number)
    columns = (
        arrays["summary_landmark_ids"].tolist(),
        arrays["summary_keyframe_ids"].tolist(),
        arrays["summary_measurements"],
        arrays["summary_sigmas_px"],
        arrays["summary_returned"].tolist(),
    )
    for landmark, keyframe, measurement, sigmas_px, returned in zip(*columns, strict=True):
        summary_of = marginalised.returned if returned else marginalised.summaries
        summary_of[landmark] = Summary(keyframe, measurement, sigmas_px)
    return marginalised
