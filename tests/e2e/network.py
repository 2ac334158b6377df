"""Hosts with separate addresses on one machine: network namespaces, with links that can be cut or
made unreliable.
"""

import fcntl
import heapq
import itertools
import os
import random
import select
import shutil
import struct
import subprocess
import threading
import time
import uuid
from pathlib import Path

import pytest

_TUN, _SET = Path("/dev/net/tun"), 0x400454CA  # Linux' TUNSETIFF
_FLAGS = 0x0001 | 0x1000  # whole IP packets, without a header of the driver's


def address(host: int) -> str:
    """The address of a network's host, counted from 0."""
    return f"10.77.0.{host + 1}"


def check_possible() -> None:
    """Skip the test where namespaces cannot be made."""
    if os.geteuid() != 0 or not shutil.which("ip"):
        pytest.skip("network namespaces need root and iproute2")


class Network:
    """Hosts on one switch; `hosts` are the namespaces' names."""

    def __init__(self, hosts: int) -> None:
        check_possible()
        self._tag = uuid.uuid4().hex[:6]
        self._switch = f"farm-s-{self._tag}"
        self.hosts = [f"farm-{i}-{self._tag}" for i in range(hosts)]
        _ip("netns", "add", self._switch)
        _ip("-n", self._switch, "link", "add", "switch", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "switch", "up")
        for i, host in enumerate(self.hosts):
            _ip("netns", "add", host)
            port = f"port{i}"
            _ip(
                "-n",
                self._switch,
                "link",
                "add",
                port,
                "type",
                "veth",
                "peer",
                "name",
                "wire",
                "netns",
                host,
            )
            _ip("-n", self._switch, "link", "set", port, "master", "switch", "up")
            _up(host, "wire", i)

    def cut(self, host: int) -> None:
        """Take a host off the network."""
        _ip("-n", self.hosts[host], "link", "set", "wire", "down")

    def heal(self, host: int) -> None:
        """Put it back."""
        _ip("-n", self.hosts[host], "link", "set", "wire", "up")

    def close(self) -> None:
        for host in (*self.hosts, self._switch):
            _ip("netns", "del", host)


class BadLink:
    """Two hosts between which packets come late, out of order, or not at all.

    The test itself is the wire: it carries packets between the hosts' TUN devices. (Not every
    kernel has netem.)
    """

    def __init__(self, *, delay: tuple[float, float], loss: float) -> None:
        """Delay is drawn from a range [s], loss is the share of packets that vanish."""
        check_possible()
        if not _TUN.exists():
            pytest.skip("a link that loses packets needs /dev/net/tun")
        self._delay, self._loss, self._draw = delay, loss, random.Random(0)
        self.carried = self.lost = 0
        tag = uuid.uuid4().hex[:6]
        self.hosts = [f"farm-{i}-{tag}" for i in range(2)]
        self._ends = [self._plug(i, f"ft{i}{tag}") for i in range(2)]
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _plug(self, host: int, device: str) -> int:
        end = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(end, _SET, struct.pack("16sH", device.encode(), _FLAGS))
        _ip("netns", "add", self.hosts[host])
        _ip("link", "set", device, "netns", self.hosts[host])
        _up(self.hosts[host], device, host)
        return end

    def _carry(self) -> None:
        due: list[tuple[float, int, int, bytes]] = []
        count = itertools.count()
        while not self._over.is_set():
            wait = max(0.0, due[0][0] - time.monotonic()) if due else 0.1
            readable, _, _ = select.select(self._ends, [], [], min(wait, 0.1))
            for end in readable:
                packet = os.read(end, 65536)
                if self._draw.random() < self._loss:
                    self.lost += 1
                    continue
                other = self._ends[1 - self._ends.index(end)]
                heapq.heappush(
                    due,
                    (
                        time.monotonic() + self._draw.uniform(*self._delay),
                        next(count),
                        other,
                        packet,
                    ),
                )
            while due and due[0][0] <= time.monotonic():
                _, _, end, packet = heapq.heappop(due)
                os.write(end, packet)
                self.carried += 1

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        for end in self._ends:
            os.close(end)
        for host in self.hosts:
            _ip("netns", "del", host)


def _up(host: str, device: str, number: int) -> None:
    _ip("-n", host, "addr", "add", f"{address(number)}/24", "dev", device)
    _ip("-n", host, "link", "set", device, "up")
    _ip("-n", host, "link", "set", "lo", "up")


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)
