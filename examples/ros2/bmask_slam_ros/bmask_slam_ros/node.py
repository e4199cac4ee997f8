"""The node: `bmask-slam live ros2:`, carried by rclpy, with its options as parameters.

The parameter `options` is a list of options of `bmask-slam live`; the others are those of its
--ros2-params. Services and topics are those of docs/live.md.
"""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from bmask_slam.cli import make_parser
from bmask_slam.graph.errors import InputError
from bmask_slam.live.ros2.outputs import Ros2Frames
from bmask_slam_ros.transport import RclpyNode

THREADS = 6
"""Of the executor: three may wait for answers of services."""


def main(args: list[str] | None = None) -> int:
    """Run until the source ends or Ctrl-C; the run is saved."""
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)  # `live` has its own
    node = rclpy.create_node("bmask_slam", automatically_declare_parameters_from_overrides=True)
    executor = MultiThreadedExecutor(THREADS)
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin, daemon=True)
    spinning.start()
    try:
        return run(node)
    except InputError as error:
        node.get_logger().error(str(error))
        return 1
    finally:
        executor.shutdown(1.0)
        spinning.join(1.0)
        node.destroy_node()
        rclpy.try_shutdown()


def run(node: Any) -> int:
    """Run `bmask-slam live` on a node that is spun; returns its exit code."""
    known = {field.name for field in fields(Ros2Frames)}
    given = {name: one.value for name, one in node.get_parameters_by_prefix("").items()}
    words = list(given.get("options") or ())
    with tempfile.TemporaryDirectory(prefix="bmask-slam-") as folder:
        params = Path(folder) / "ros2.yaml"
        chosen = {name: value for name, value in given.items() if name in known}
        params.write_text(json.dumps(chosen, default=list), encoding="utf-8")
        words = ["live", "ros2:", "--quiet", "--ros2-params", str(params), *words]
        arguments = make_parser().parse_args(words)
        arguments.ros2_node = RclpyNode(node)
        return int(arguments.handler(arguments))


if __name__ == "__main__":
    sys.exit(main())
