"""Sources of live frames: recordings, ROS bags, growing folders and cameras."""
