"""Stands in for rclpy, as far as examples/ros2/bmask_slam_ros uses it: one process, one bus.

What is published is kept by topic and handed to the subscriptions at once. It checks what ROS
checks: types that are known, bytes, qualities of service that fit.
"""

from __future__ import annotations

import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from bmask_slam.live.ros2.transport import typestore


class FakeNode:
    """The node under test; ``parameters`` are those of its YAML."""

    def __init__(self, parameters: dict[str, Any]) -> None:
        self.parameters = parameters
        self.topics: dict[str, str] = {}
        self.sent: dict[str, list[bytes]] = {}
        self.services: dict[str, tuple[str, Any]] = {}
        self.logged: list[str] = []
        self._listeners: dict[str, list[SimpleNamespace]] = {}
        self._lock = threading.Lock()

    def announce(self, topic: str, kind: str) -> None:
        """Another node publishes a topic."""
        self.topics[topic] = kind

    def hand_on(self, topic: str, data: bytes) -> None:
        """Another node publishes a message."""
        with self._lock:
            heard = list(self._listeners.get(topic, ()))
        for one in heard:
            one.callback(data)

    def call(self, service: str, **fields: Any) -> tuple[bool, str]:
        """Another node calls a service, as a thread of the executor does."""
        kind, callback = self.services[service]
        request = SimpleNamespace(**fields)
        answer = callback(request, SimpleNamespace(success=None, message=None))
        assert kind == ("std_srvs/srv/SetBool" if fields else "std_srvs/srv/Trigger")
        return answer.success, answer.message

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        assert qos.depth > 0
        self.topics[topic] = kind.name
        sent = self.sent.setdefault(topic, [])

        def publish(data: bytes) -> None:
            assert isinstance(data, bytes)
            sent.append(data)

        return SimpleNamespace(publish=publish)

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, *, callback_group: Any, raw: bool
    ) -> Any:
        assert raw
        assert self.topics[topic] == kind.name
        made = SimpleNamespace(callback=callback, topic=topic)
        with self._lock:
            self._listeners.setdefault(topic, []).append(made)
        return made

    def destroy_subscription(self, subscription: Any) -> None:
        with self._lock:
            self._listeners[subscription.topic].remove(subscription)

    def create_service(
        self, kind: Any, service: str, callback: Any, *, callback_group: Any
    ) -> None:
        self.services[service] = kind.name, callback

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(topic, [kind]) for topic, kind in self.topics.items()]

    def count_publishers(self, topic: str) -> int:
        return int(topic in self.topics)

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        assert prefix == ""
        return {name: SimpleNamespace(value=v) for name, v in self.parameters.items()}

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.logged.append, error=self.logged.append)

    def destroy_node(self) -> None:
        self.topics.clear()


class _Executor:
    """Spins until it is shut down."""

    def __init__(self, threads: int) -> None:
        assert threads > 3  # the services' callbacks wait
        self._ended = threading.Event()

    def add_node(self, node: FakeNode) -> None:
        assert isinstance(node, FakeNode)

    def spin(self) -> None:
        self._ended.wait()

    def shutdown(self, timeout_s: float) -> None:
        self._ended.set()


def _message(name: str) -> Any:
    """The class of a message; one that ROS lacks is an ImportError, as of a missing package."""
    if name not in typestore().fielddefs:
        raise ImportError(name)
    return SimpleNamespace(name=name)


def install(monkeypatch: pytest.MonkeyPatch, node: FakeNode, without: str = "") -> None:
    """Let ``import rclpy`` find this, with a node; the package ``without`` is not installed."""

    def get_message(name: str) -> Any:
        return _message("" if without and name.startswith(without) else name)

    def module(name: str, **content: Any) -> None:
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    reliability = SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort")
    durability = SimpleNamespace(TRANSIENT_LOCAL="latched", VOLATILE="volatile")
    module(
        "rclpy",
        init=lambda args=None, signal_handler_options=None: None,
        create_node=lambda name, automatically_declare_parameters_from_overrides: node,
        try_shutdown=lambda: None,
    )
    module("rclpy.node", Node=FakeNode)
    module("rclpy.callback_groups", ReentrantCallbackGroup=object)
    module("rclpy.executors", MultiThreadedExecutor=_Executor)
    module("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO=0))
    module(
        "rclpy.qos",
        QoSProfile=SimpleNamespace,
        ReliabilityPolicy=reliability,
        DurabilityPolicy=durability,
    )
    module("rosidl_runtime_py")
    service = lambda name: SimpleNamespace(name=name)  # noqa: E731
    module("rosidl_runtime_py.utilities", get_message=get_message, get_service=service)
