"""Dense mapping of a run: input, fusion of keyframes, folder of submaps, products."""

from bmask_slam.graph.extras import DENSE_LIBRARIES, import_extra

for library in DENSE_LIBRARIES:
    import_extra(library, "a dense map", "dense")
