"""Another program at the wire of a robot: receives every command, and sends its own."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pronk.jump.virtual.robot import hold_of
from pronk.robots import load_robot
from pronk.robots.machine import Command

ROBOT = load_robot("mini_cheetah")
OTHER = replace(hold_of(ROBOT), position=hold_of(ROBOT).position + 0.01)
"""What it commands; like the virtual robot's own rival, every 10 ms."""


class Wire:
    """Records every command on a wire, and sends on it as another program would."""

    def __init__(
        self,
        publish: Callable[[], None],
        listen: Callable[[], list[tuple[float, bytes]]],
        decode: Callable[[bytes], Command],
    ) -> None:
        self.began = math.nan
        """When it spoke first [s]."""
        self._publish = publish
        self._listen = listen
        self._decode = decode
        self._messages: list[tuple[float, bytes]] = []
        self._ended = threading.Event()
        self._speaking = threading.Event()
        self._threads = (
            threading.Thread(target=self._hear),
            threading.Thread(target=self._speak),
        )

    def __enter__(self) -> Wire:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def speak(self) -> None:
        self.began = time.monotonic()
        self._publish()
        self._speaking.set()

    def hush(self) -> None:
        self._speaking.clear()

    def received(self) -> tuple[np.ndarray, np.ndarray]:
        """When each command that is not its own came [s], and whether it damps."""
        times = []
        damps = []
        for arrival, data in list(self._messages):
            command = self._decode(data)
            if not np.allclose(command.position, OTHER.position, atol=1e-5):
                times.append(arrival)
                damps.append(not command.stiffness.any())
        return np.array(times), np.array(damps)

    def _speak(self) -> None:
        while not self._ended.wait(0.01):
            if self._speaking.is_set():
                self._publish()

    def _hear(self) -> None:
        while not self._ended.is_set():
            self._messages += self._listen()


def over_lcm(port: int) -> Wire:
    import lcm

    from pronk.deploy.links.lcm.codec import decode_lcm_command, encode_lcm_command
    from pronk.deploy.links.lcm.layouts import CHEETAH
    from pronk.deploy.links.lcm.link import url_of

    sender = lcm.LCM(url_of(port=port))
    listener = lcm.LCM(url_of(port=port))
    received: list[tuple[float, bytes]] = []

    def receive(_: str, data: bytes) -> None:
        received.append((time.monotonic(), data))

    def listen() -> list[tuple[float, bytes]]:
        listener.handle_timeout(20)
        messages = received.copy()
        received.clear()
        return messages

    listener.subscribe(CHEETAH.command.channel, receive).set_queue_capacity(500)
    data = encode_lcm_command(CHEETAH, OTHER)
    return Wire(
        lambda: sender.publish(CHEETAH.command.channel, data),
        listen,
        lambda data: decode_lcm_command(CHEETAH, data),
    )


def over_dds(domain: int) -> Wire:
    from pronk.deploy.links.dds.codec import decode_dds_command, encode_dds_command, joint_map
    from pronk.deploy.links.dds.link import (
        COMMANDS,
        DdsNetwork,
        Participant,
        take_samples,
        write_bytes,
    )
    from pronk.deploy.links.dds.messages import LowCmd

    joints = joint_map(ROBOT)
    participant = Participant(DdsNetwork(domain=domain))
    sender = participant.writer(COMMANDS, LowCmd)
    listener = participant.reader(COMMANDS, LowCmd, include_local=False)
    counts: Counter[str] = Counter()
    # Every sample says when it was written, by the wall clock.
    wall = time.time() - time.monotonic()

    def listen() -> list[tuple[float, bytes]]:
        time.sleep(0.002)
        messages = []
        for sample in take_samples(listener, counts):
            written_s = sample.sample_info.source_timestamp * 1e-9 - wall
            messages.append((written_s, sample.data))
        return messages

    data = encode_dds_command(joints, OTHER)
    return Wire(
        lambda: write_bytes(sender, data, counts),
        listen,
        lambda data: decode_dds_command(joints, data),
    )
