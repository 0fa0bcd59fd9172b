"""Listening to Unitree's DDS topics `rt/lowstate` and `rt/lowcmd`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from cyclonedds import core

from pronk.deploy.links.dds import messages
from pronk.deploy.links.dds.codec import (
    POS_STOP,
    VEL_STOP,
    DdsStateDecoder,
    JointMap,
    joint_map,
)
from pronk.deploy.links.dds.image import deserialize_image
from pronk.deploy.links.dds.link import (
    COMMANDS,
    STATES,
    DdsNetwork,
    Participant,
    take_samples,
)
from pronk.deploy.links.listener import HeardMessage, Listener, WireCommand
from pronk.robots.machine import RefusedError
from pronk.robots.robot import RobotSpec

_QUEUE = 5000
"""Messages kept between two reads: ten seconds at 500 Hz, so that a busy computer loses none."""


def read_low_cmd(joints: JointMap, data: bytes) -> WireCommand:
    """Decode a `LowCmd` as it was sent, whatever it commands.

    Args:
        joints: How the robot's joints and the motors correspond.
        data: The message.

    Raises:
        RefusedError: As of `deserialize_image`, or `not finite`.
    """
    record = deserialize_image(messages.LowCmd, data)
    motors = record["motor_cmd"][0, : len(joints.sign)]
    numbers = {}
    for name in ("q", "dq", "tau", "kp", "kd"):
        if not np.isfinite(motors[name]).all():
            raise RefusedError("not finite", f"{name} of a LowCmd is not a finite number.")
        numbers[name] = motors[name].astype(np.float64)
    on = motors["mode"] != 0
    stiffness = numbers["kp"] * on * (motors["q"] != np.float32(POS_STOP))
    damping = numbers["kd"] * on * (motors["dq"] != VEL_STOP)
    return WireCommand(
        position=np.where(stiffness > 0.0, joints.sign * numbers["q"], 0.0),
        velocity=np.where(damping > 0.0, joints.sign * numbers["dq"], 0.0),
        stiffness=stiffness,
        damping=damping,
        torque=joints.sign * numbers["tau"] * on,
    )


class DdsListener(Listener):
    """Listens to a robot with twelve joints behind Unitree's messages."""

    torque_kind = "measured"
    state_topic = STATES
    command_topic = COMMANDS

    def __init__(
        self, robot: RobotSpec, *, interface: str | None = None, domain: int | None = None
    ) -> None:
        """Describe the wire.

        Args:
            robot: The robot.
            interface: Network interface to a real robot, None for loopback only.
            domain: Number of the domain, as of `DdsNetwork`.
        """
        super().__init__(robot)
        self._joints = joint_map(robot)
        self._network = DdsNetwork(interface=interface, domain=domain)
        self.state_topic = f"{STATES} in {self._network}"
        self.command_topic = f"{COMMANDS} in {self._network}"

    def open(self) -> None:
        """Join the domain with two readers and no writer."""
        self._decoder = DdsStateDecoder(self._joints, self.counts)
        self._participant = Participant(self._network)
        self._states = self._participant.reader(STATES, messages.LowState, depth=_QUEUE)
        self._commands = self._participant.reader(COMMANDS, messages.LowCmd, depth=_QUEUE)
        any_sample = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        self._samples_come = core.WaitSet(self._participant.entity)
        for reader in (self._states, self._commands):
            self._samples_come.attach(core.ReadCondition(reader, any_sample))

    def receive(self, timeout_s: float) -> list[HeardMessage]:
        """Return the states and commands that have come."""
        self._samples_come.wait(int(timeout_s * 1e9))
        heard = []
        arrived = time.monotonic()
        for sample in self._taken(self._states):
            state = self.decoded_state(self._decoder.take, sample.data, arrived)
            if state is not None:
                heard.append(HeardMessage(arrived=arrived, sent=self._sent(sample), content=state))
        self.virtual = self._decoder.virtual
        for sample in self._taken(self._commands):
            command = self.decoded_command(
                lambda data: read_low_cmd(self._joints, data), sample.data
            )
            if command is not None:
                self.command_senders.add(sample.sample_info.publication_handle)
                heard.append(
                    HeardMessage(arrived=arrived, sent=self._sent(sample), content=command)
                )
        return heard

    def close(self) -> None:
        """Leave the domain."""
        del self._samples_come, self._states, self._commands, self._participant

    def _taken(self, reader: Any) -> list[Any]:
        """Take every sample that a reader keeps."""
        taken = []
        while True:
            samples = take_samples(reader, self.counts)
            taken += samples
            if not samples or len(taken) >= _QUEUE:
                return taken

    def _sent(self, sample: Any) -> float:
        """When a sample was written, on the writer's clock [s]."""
        return float(sample.sample_info.source_timestamp) * 1e-9
