"""ROS 2 without ROS: its topics, types and qualities of service over DDS, by cyclonedds."""
