"""Live SLAM as a ROS 2 node that publishes T_world_camera as geometry_msgs/PoseStamped:

python examples/ros2_node.py --ros-args -r rgb:=/camera/color/image_raw \
    -r depth:=/camera/aligned_depth_to_color/image_raw -r camera_info:=/camera/color/camera_info

Depth must be registered to colour, and the images must not be rectified. The world frame is the
optical frame of the first keyframe (z forward), not ROS's map frame (z up). Ctrl-C ends the node
and saves the run in runs/ros2.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from bmask_slam import InputError, LiveOptions, LiveSlam
from bmask_slam.graph.geometry import quaternion_from_rotation
from bmask_slam.run_folder.open_files import free_run_path
from bmask_slam.sequences.bags import ros_images as ros
from bmask_slam.sequences.images import depth_in_metres


class Bridge:
    """Passes messages to ``slam``, which the first ones start, and publishes the poses."""

    def __init__(self, new_pose: Callable[[], Any], publish: Callable[[Any], None]) -> None:
        self.slam: LiveSlam | None = None
        self._new_pose, self._publish = new_pose, publish

    def track(self, rgb: Any, depth: Any, info: Any) -> None:
        """Track a colour and a depth image of one time; broken messages are skipped."""
        try:
            if self.slam is None:
                scale = ros.DEPTH_SCALES[ros.depth_encoding(depth, "depth")]
                camera = ros.camera_of(info, scale, rectified=False, where="camera_info")
                self.slam = LiveSlam(camera, options=LiveOptions(free_run_path("ros2")))
            depth_m = depth_in_metres(ros.depth_image(depth, "depth"), self.slam.camera)
            result = self.slam.track(ros.stamp_s(rgb.header), ros.colour_image(rgb, "rgb"), depth_m)
        except InputError as error:
            logging.getLogger(__name__).warning("%s", error)
            return
        if result.T_world_camera is None:
            return
        message = self._new_pose()
        message.header.stamp, message.header.frame_id = rgb.header.stamp, "slam_world"
        position, turn = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = map(float, result.T_world_camera[:3, 3])
        quaternion = quaternion_from_rotation(result.T_world_camera[:3, :3])
        turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
        self._publish(message)


def main() -> None:
    """Run the node until Ctrl-C."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from message_filters import ApproximateTimeSynchronizer, Subscriber
    from sensor_msgs.msg import CameraInfo, Image

    rclpy.init()
    node = rclpy.create_node("bmask_slam")
    bridge = Bridge(PoseStamped, node.create_publisher(PoseStamped, "pose", 10).publish)
    topics = (("rgb", Image), ("depth", Image), ("camera_info", CameraInfo))
    inputs = [Subscriber(node, kind, name) for name, kind in topics]
    ApproximateTimeSynchronizer(inputs, 10, 0.02).registerCallback(bridge.track)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        if bridge.slam is not None:
            bridge.slam.close()


if __name__ == "__main__":
    main()
