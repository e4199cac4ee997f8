"""A slow and lossy network on one machine: two namespaces, and a link that drops packets.

What Linux has for this (tc netem) is not in every kernel. Here each namespace has a TUN device, and
this process hands IP packets from one to the other: each after a delay, a share of them never. TCP
at both ends is the kernel's. Needs root; nothing outside the two namespaces is changed.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path

ROBOT, WORKSTATION = "10.77.0.1", "10.77.0.2"
_TUNSETIFF, _TUN, _NO_HEADER = 0x400454CA, 0x0001, 0x1000
_CLONE_NEWNET = 0x40000000


@dataclass(frozen=True)
class LinkOptions:
    """Of a link.

    Attributes:
        delay_s: of each packet, one way.
        loss: share of packets that are dropped, each way.
        seed: of which.
    """

    delay_s: float = 0.01
    loss: float = 0.01
    seed: int = 0


class SlowLink:
    """Two namespaces and the link between them; ``run`` starts a program in one of them."""

    def __init__(self, options: LinkOptions) -> None:
        self.options, self.packets, self.lost = options, 0, 0
        self.up = True
        self._names = [f"bmask-{os.getpid()}-{k}" for k in range(2)]
        self._ends: list[int] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._hand_on, daemon=True)

    def __enter__(self) -> SlowLink:
        for name, own, other in zip(
            self._names, (ROBOT, WORKSTATION), (WORKSTATION, ROBOT), strict=True
        ):
            subprocess.run(["ip", "netns", "add", name], check=True)
            self._ends.append(_tun_in(name))
            for words in (
                ["link", "set", "lo", "up"],
                ["addr", "add", own, "peer", other, "dev", "link0"],
                ["link", "set", "link0", "up"],
            ):
                subprocess.run(["ip", "-n", name, *words], check=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(5)
        for end in self._ends:
            os.close(end)
        for name in self._names:
            subprocess.run(["ip", "netns", "del", name], check=False)

    def words(self, place: str, command: list[str]) -> list[str]:
        """A command that runs at ROBOT or WORKSTATION."""
        return ["ip", "netns", "exec", self._names[place == WORKSTATION], *command]

    def _hand_on(self) -> None:
        """Hand packets on, each when it is due."""
        rng, number = random.Random(self.options.seed), 0
        waiting: list[tuple[float, int, int, bytes]] = []
        while not self._ended.is_set():
            now_s = time.monotonic()
            while waiting and waiting[0][0] <= now_s:
                _, _, to, packet = heapq.heappop(waiting)
                os.write(to, packet)
            left_s = min(waiting[0][0] - now_s, 0.1) if waiting else 0.1
            for end in select.select(self._ends, [], [], max(left_s, 0.0))[0]:
                packet = os.read(end, 65536)
                self.packets += 1
                if not self.up or rng.random() < self.options.loss:
                    self.lost += 1
                    continue
                number += 1
                to = self._ends[end == self._ends[0]]
                due_s = time.monotonic() + self.options.delay_s
                heapq.heappush(waiting, (due_s, number, to, packet))


def _tun_in(name: str) -> int:
    """The descriptor of a TUN device that lies in a namespace."""
    found: list[int] = []

    def make() -> None:  # a thread of its own has a namespace of its own
        libc = ctypes.CDLL(None, use_errno=True)
        with Path(f"/run/netns/{name}").open() as space:
            if libc.setns(space.fileno(), _CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), "setns")
        end = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(end, _TUNSETIFF, struct.pack("16sH", b"link0", _TUN | _NO_HEADER))
        found.append(end)

    thread = threading.Thread(target=make)
    thread.start()
    thread.join()
    return found[0]
