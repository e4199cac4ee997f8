"""The saved map of a run after its graph was adjusted offline."""

from __future__ import annotations

from pathlib import Path

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.batch.bundle_adjustment import Adjustment
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.graph.smoother.storage import graph_arrays
from bmask_slam.world.map_state import world_of, world_state

_WORLD, _GRAPH, _LOOPS = "mapper.world.", "mapper.graph.", "mapper.loops."


def optimised_map(
    state: Arrays, tables: FactorTables, adjustment: Adjustment, camera: Camera, path: Path
) -> Arrays:
    """A map's state, as ``read_map`` gives it, with the adjusted graph in place of its own.

    As at the end of a run: landmarks that left the graph stay in the map, and those outside it move
    with the keyframes that made them. Loops that were found wrong are forgotten.

    Raises:
        InputError: the graph does not fit the map; ``path`` names it.
    """
    graph = graph_arrays(tables)
    smoother = Smoother(camera)
    smoother.restore(graph, path)
    world = world_of(part(state, _WORLD[:-1]))
    read_back(world, smoother.estimate())
    loops = part(state, _LOOPS[:-1])
    wrong = set(map(tuple, adjustment.wrong_loops.tolist()))
    kept = [ends not in wrong for ends in map(tuple, loops["closed"].tolist())]
    loops |= {name: loops[name][kept] for name in ("closed", "believed")}
    others = {
        name: array
        for name, array in state.items()
        if not name.startswith((_WORLD, _GRAPH, _LOOPS))
    }
    mapper = nested(world=world_state(world), graph=graph, loops=loops)
    return others | nested(mapper=mapper)
