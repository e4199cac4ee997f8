"""A second process on a DDS domain that only listens.

Arguments: domain, file for the messages (JSON, by topic). It ends when it has heard a message on
each topic of ``HEARD``, or standard input is closed.
"""

from __future__ import annotations

import json
import select
import sys
import time
from pathlib import Path

from ros2_messages import HEARD, told

from bmask_slam.live.ros2.dds import DdsNode
from bmask_slam.live.ros2.messages import type_name


def main() -> None:
    """Listen."""
    node = DdsNode(int(sys.argv[1]))
    readers = {t: node.reader(t, type_name(k), q) for t, (k, q) in HEARD.items()}
    heard: dict[str, list] = {topic: [] for topic in HEARD}
    while not (all(heard.values()) or select.select([sys.stdin], [], [], 0)[0]):
        for topic, reader in readers.items():
            heard[topic] += map(told, reader.take())
        time.sleep(0.02)
    Path(sys.argv[2]).write_text(json.dumps(heard))


if __name__ == "__main__":
    main()
