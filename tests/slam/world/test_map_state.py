"""The map's state as arrays and restored."""

import numpy as np
import pytest

from bmask_slam.world.map_state import world_of, world_state
from bmask_slam.world.world_map import WorldMap


def test_an_empty_map_is_restored() -> None:
    """Without keyframes and without culled ones."""
    restored = world_of(world_state(WorldMap()))
    assert restored.keyframes == {}
    assert restored.culled == {}


@pytest.mark.parametrize("count", [-1, 2**62])
def test_an_impossible_number_of_label_views_is_refused(count: int) -> None:
    """The next one would have the number of a keyframe, or none."""
    with pytest.raises(ValueError, match="label views"):
        world_of({**world_state(WorldMap()), "label_views": np.array(count)})
