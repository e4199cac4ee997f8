"""Training of the network: data, targets, losses, the loop, transfer to other labels."""

from bmask_slam.graph.extras import import_extra

import_extra("torch", "training", "semantics")
