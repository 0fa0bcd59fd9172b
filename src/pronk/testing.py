"""Conformance checks of extensions; each raises PronkError and names the rule that is broken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike

from pronk.deploy.links.stream import Codec, Transport
from pronk.errors import HardwareError, LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import Reader
from pronk.identify.simulators.simulator import SETTABLE_PARAMETERS, Simulator
from pronk.robots.machine import Command, RefusedError, damping_command
from pronk.robots.robot import RobotSpec


def check_simulator(simulator: Simulator) -> None:
    """Check that a simulator keeps the `Simulator` protocol.

    Two runs of 0.2 s are simulated several times: shapes, rest at the first command, causality,
    independent runs, repeatability, locked joints, and an effect of every parameter that it sets.

    Raises:
        PronkError: A rule of the protocol is broken; the message names it.
    """
    info = simulator.info
    joints = tuple(simulator.joints)
    parameters = set(simulator.parameters)
    _require(info.timestep_s > 0.0 and info.decimation >= 1, "info: timestep and decimation > 0")
    _require(bool(info.engine), "info: engine is named")
    _require(len(joints) > 0 and len(set(joints)) == len(joints), "joints: unique names")
    unknown = parameters - set(SETTABLE_PARAMETERS)
    _require(not unknown, f"parameters: {', '.join(sorted(unknown))} unknown to pronk")
    _require({"stiffness", "damping"} <= parameters, "parameters: the gains")

    # Two runs from rest at random positions, each with a step of the command in its middle.
    steps = max(40, round(0.2 / info.timestep_s))
    middle = steps // 2
    generator = np.random.default_rng(0)
    start = 0.1 * generator.standard_normal((2, 1, len(joints)))
    command = np.repeat(start, steps, axis=1)
    command[:, middle:] += 0.05
    usual = {"stiffness": 20.0, "damping": 0.5, "armature": 0.01, "frictionloss": 0.1, "delay": 0.0}
    shape = (2, len(joints))
    values = {}
    for name in parameters:
        values[name] = np.full(shape, usual[name])
    command_before = command.copy()
    position = simulator.rollout(command, values)
    _require(np.shape(position) == command.shape, "rollout: the shape of the command is returned")
    _require(np.array_equal(command, command_before), "rollout: the command stays unchanged")
    _require(bool(np.isfinite(position).all()), "rollout: usual gains give finite positions")
    drift = np.abs(np.diff(position[:, steps // 4 : middle], axis=1)).max()
    _require(float(drift) < 1e-3, "rollout: rest at the first command")
    motion = np.abs(position[:, -1] - position[:, middle]).max(axis=0)
    _require(bool((motion > 1e-3).all()), "rollout: every joint follows its command")

    again = simulator.rollout(command, values)
    _require(np.allclose(again, position), "rollout: repeatable")
    first_values = {name: array[:1] for name, array in values.items()}
    first_run = simulator.rollout(command[:1], first_values)
    _require(np.allclose(first_run, position[:1], atol=1e-6), "rollout: runs are independent")
    later_command = command.copy()
    later_command[:, -5:] += 0.1
    before_change = simulator.rollout(later_command, values)[:, :-5]
    causal = np.allclose(before_change, position[:, :-5], atol=1e-9)
    _require(causal, "rollout: no response before its command")
    if len(joints) > 1:
        free_joint_alone = simulator.rollout(command, values, locked=joints[1:])
        free_motion = np.ptp(free_joint_alone[..., 0], axis=1).min()
        _require(bool(free_motion > 1e-3), "locked: the free joint moves")
        _require(bool(np.isfinite(free_joint_alone).all()), "locked: positions stay finite")

    other = {
        "stiffness": 10.0,
        "damping": 1.0,
        "armature": 0.05,
        "frictionloss": 0.5,
        "delay": 0.02,
    }
    for name in sorted(parameters):
        changed_values = {**values, name: np.full(shape, other[name])}
        effect = np.abs(simulator.rollout(command, changed_values) - position).max()
        _require(float(effect) > 1e-5, f"parameters: {name} has an effect")


def check_reader(
    reader: Reader,
    path: Path,
    *,
    robot: RobotSpec | None = None,
    options: ReadOptions | None = None,
) -> None:
    """Check a log reader on a file that it should read.

    The log has two samples or more, one command and one position a joint, finite and increasing
    timestamps in seconds, its source and hash; reading twice gives the same log; a missing
    and an empty file are refused with a LogError.

    Args:
        reader: The reader.
        path: The file.
        robot: The robot, which the reader gets.
        options: How the file is read; the defaults if None.

    Raises:
        PronkError: A rule of the protocol is broken; the message names it.
    """
    stated = ReadOptions() if options is None else options
    log = reader.read(path, robot, stated)
    _require(isinstance(log, JointLog), "read: a JointLog is returned")
    shape = (len(log.time), len(log.joints))
    _require(shape[0] >= 2 and shape[1] >= 1, "read: two samples and one joint or more")
    for name, values in (("command", log.command), ("position", log.position)):
        _require(np.shape(values) == shape, f"read: {name} has the shape (samples, joints)")
        _require(bool(np.isfinite(values).all()), f"read: {name} is finite")
    _require(bool((np.diff(log.time) > 0.0).all()), "read: timestamps increase")
    _require(log.source == str(path), "read: source is the path")
    _require(len(log.origin.sha256) == 64, "read: sha256 of the file")
    again = reader.read(path, robot, stated)
    _require(np.array_equal(again.position, log.position), "read: repeatable")
    with TemporaryDirectory() as folder:
        missing = Path(folder, f"missing{path.suffix}")
        empty = Path(folder, f"empty{path.suffix}")
        empty.touch()
        for file in (missing, empty):
            rule = f"read: a file that is {file.stem} is refused with a LogError"
            _require_refused(LogError, rule, partial(reader.read, file, robot, stated))


def check_link(
    robot: RobotSpec,
    codec: Codec,
    states: Sequence[bytes],
    transport: Callable[[], Transport] | None = None,
) -> None:
    """Check a link's codec, and its transport where one is given.

    States decode to finite numbers of the robot's joints; cut, empty and foreign bytes are refused;
    commands encode to the same bytes every time, and impossible ones are refused; without an
    interface the transport is local.

    Args:
        robot: The robot behind the link.
        codec: The codec.
        states: Two or more messages of a live robot.
        transport: Opens the wire as an address without an interface does.

    Raises:
        PronkError: A rule of the protocol is broken; the message names it.
    """
    joints = len(robot.joints)
    _require(len(states) >= 2, "states: two or more are given")
    for data in states:
        state = codec.decode(data)
        _require_finite("position", state.position, joints)
        _require_finite("velocity", state.velocity, joints)
        _require_finite("torque", state.torque, joints)
        _require_finite("gyro", state.gyro, 3)
        _require_finite("accelerometer", state.accelerometer, 3)
        _require_finite("orientation", state.orientation, 4)
        norm = float(np.linalg.norm(state.orientation))
        _require(abs(norm - 1.0) < 0.02, "decode: orientation has length 1")
    for data in (b"", states[0][:-1], b"\xff" * len(states[0])):
        rule = f"decode: {len(data)} bytes that are no state are refused"
        _require_refused(RefusedError, rule, partial(codec.decode, data))

    pose = np.array([joint.default_position for joint in robot.joints])
    command = Command(position=pose, stiffness=np.full(joints, 10.0), damping=np.ones(joints))
    message = codec.encode(command)
    damping_message = codec.encode(damping_command(joints))
    _require(codec.encode(command) == message, "encode: repeatable")
    _require(message != damping_message, "encode: commands differ")
    for value in (np.nan, np.inf):
        impossible = Command(
            position=pose + value, stiffness=np.zeros(joints), damping=np.zeros(joints)
        )
        rule = f"encode: a position of {value} is refused"
        _require_refused(HardwareError, rule, partial(codec.encode, impossible))
    _require(codec.state_rate_hz > 0.0, "state_rate_hz > 0")

    if transport is not None:
        wire = transport()
        try:
            _require(wire.local, "transport: local without an interface")
            _require(isinstance(wire.receive(0.0), list), "transport: receive returns a list")
        finally:
            wire.close()


def _require(satisfied: bool, rule: str) -> None:
    """Raise a PronkError if a rule of a protocol is broken."""
    if not satisfied:
        raise PronkError(f"the conformance check failed at: {rule}.")


def _require_finite(name: str, values: ArrayLike, size: int) -> None:
    """Raise unless a field of a decoded state has `size` finite numbers."""
    array = np.asarray(values)
    _require(array.shape == (size,), f"decode: {name} has shape ({size},)")
    _require(bool(np.isfinite(array).all()), f"decode: {name} is finite")


def _require_refused(error: type[PronkError], rule: str, call: Callable[[], object]) -> None:
    """Raise unless a call is refused with this error."""
    try:
        call()
    except error:
        return
    _require(False, rule)
