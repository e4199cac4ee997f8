"""Rendering in the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import pytest


@pytest.fixture(scope="package", autouse=True)
def coarse_light() -> Iterator[None]:
    """Light is computed at few places and with few rays: that takes most of a scene's time.

    The scenes are kept apart from those of other tests, which have all of their light.
    """
    from bmask_slam.rendering import sequence
    from bmask_slam.rendering.engine import lighting

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lighting, "_CELL_M", 0.4)
        patch.setattr(lighting, "_SKY_RAYS", 2)
        patch.setattr(sequence, "_built", lru_cache(maxsize=4)(sequence._built.__wrapped__))
        yield
