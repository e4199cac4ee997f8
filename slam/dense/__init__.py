"""Dense mapping of a run: input, fusion of keyframes, folder of submaps, products."""

from bmask_slam.graph.extras import import_dense

import_dense("a dense map")
