"""Memory of the map as it grows: memory by keyframes, and the arrays of each structure.

    python -m benchmarks.live.map_memory SEQUENCE [--frames 1000] [--every 3] [--structures 14]

Every third frame becomes a keyframe and stays in the map, as in a place that is always new. The
system is that of an offline run, or of the map's process; a copy of the map is kept up to date by
deltas, as in the tracking process of the live loop. Arrays that lie on the disk are not counted.
"""

from __future__ import annotations

import argparse
import gc
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import own_mb
from bmask_slam.config.configuration import resolve
from bmask_slam.live.replica import DeltaMaker, apply_delta
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

ROWS = 8
DEPTH = 12


def settings(every: int) -> tuple[str, ...]:
    """Options with which every n-th frame becomes a keyframe and stays one."""
    return (
        "semantics.segmenter.name=none",
        f"keyframes.min_interval_frames={every}",
        f"keyframes.max_interval_frames={every}",
        "keyframes.max_shared=2.0",
        "mapping.redundant_share=1.1",
    )


def array_bytes(root: Any) -> Counter[str]:
    """Bytes of arrays in memory that an object holds, by the path of attributes to them."""
    found: Counter[str] = Counter()
    seen: set[int] = set()

    def walk(value: Any, path: str, depth: int) -> None:
        if id(value) in seen or depth > DEPTH:
            return
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            base = value
            while isinstance(base.base, np.ndarray):
                base = base.base
            if id(base) not in seen or base is value:
                seen.add(id(base))
                found[path] += base.nbytes if base.flags.owndata else 0
        elif isinstance(value, dict):
            for key, item in value.items():
                walk(item, f"{path}.{key}" if isinstance(key, str) else path, depth + 1)
        elif isinstance(value, (list, tuple, set)):
            for item in value:
                walk(item, path, depth + 1)
        else:
            names = [*getattr(value, "__dict__", {}), *getattr(type(value), "__slots__", ())]
            for name in names:
                if hasattr(value, name):
                    walk(getattr(value, name), f"{path}.{name}", depth + 1)

    walk(root, "", 0)
    return found


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--structures", type=int, default=14)
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    system = SlamSystem(sequence.camera, resolve(SystemConfig, None, settings(arguments.every)))
    maker, copy, history = DeltaMaker(), WorldMap(), FrameHistory()
    parts = {"map": system, "deltas": maker, "copy": copy}
    table, frames = [], min(arguments.frames, len(sequence))
    world = system.mapper.world
    for index in range(frames):
        made = world.next_keyframe_id
        system.process(sequence.load(index))
        world = system.mapper.world
        if world.next_keyframe_id > made:
            apply_delta(maker.delta(world, system.mapper.history), copy, history)
        if (index + 1) % max(frames // ROWS, 1) == 0:
            sizes = {name: sum(array_bytes(part).values()) / 1e6 for name, part in parts.items()}
            counts = len(world.keyframes), int(world.landmarks.in_map.sum())
            table.append([*counts, settled_mb(), *sizes.values()])
    titles = ("keyframes", "landmarks", "RssAnon MB", *(f"{name} MB" for name in parts))
    print("".join(f"{title:>12}" for title in titles))
    for row in table:
        print("".join(f"{cell:12.0f}" if cell > 99 else f"{cell:12.1f}" for cell in row))
    later = np.array(table[len(table) // 2 :], float)
    slopes = [1e3 * np.polyfit(later[:, 0], column, 1)[0] for column in later[:, 2:].T]
    print(f"{'second half, kB a keyframe':24}" + "".join(f"{slope:12.0f}" for slope in slopes))
    isam2_mb = memory_of_isam2(system)
    print(f"ISAM2: {isam2_mb:.0f} MB, {1e3 * isam2_mb / len(world.keyframes):.0f} kB a keyframe")
    found = Counter(
        {f"{n}{p}": b for n, part in parts.items() for p, b in array_bytes(part).items()}
    )
    print(f"\n{'arrays':60}{'MB':>8}{'kB/kf':>8}")
    for path, size in found.most_common(arguments.structures):
        print(f"{path[-60:]:60}{size / 1e6:8.2f}{size / 1e3 / len(world.keyframes):8.1f}")


def memory_of_isam2(system: SlamSystem) -> float:
    """What is freed when ISAM2 is discarded, in MB."""
    before = settled_mb()
    system.mapper.smoother.restart()
    return before - settled_mb()


def settled_mb() -> float:
    """Memory of this process, without what is free, in MB."""
    gc.collect()
    give_back_memory()
    return own_mb("self")


if __name__ == "__main__":
    main()
