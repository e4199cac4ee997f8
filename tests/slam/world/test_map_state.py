"""The map's state as arrays and restored."""

from bmask_slam.world.map_state import world_of, world_state
from bmask_slam.world.world_map import WorldMap


def test_an_empty_map_is_restored() -> None:
    """Without keyframes and without culled ones."""
    restored = world_of(world_state(WorldMap()))
    assert restored.keyframes == {}
    assert restored.culled == {}
