"""Dense mapping of a run: input, fusion of keyframes, folder of submaps, products."""

from bmask_slam.graph.extras import import_extra

import_extra("torch", "a dense map", "dense")
