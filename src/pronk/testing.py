"""Conformance checks of extensions; each raises PronkError and names the rule that is broken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pronk.deploy.links.link import Codec, Transport
from pronk.errors import HardwareError, LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import Reader
from pronk.identify.simulators.simulator import PARAMETERS, Simulator
from pronk.robots.machine import Command, RefusedError, damping_command
from pronk.robots.robot import RobotSpec


def check_simulator(simulator: Simulator) -> None:
    """Check that a simulator keeps the `Simulator` protocol.

    Two runs of 0.2 s are simulated several times: shapes, rest at the first command, causality,
    independent runs, repeatability, locked joints, and an effect of every parameter that it sets.
    """
    info, joints = simulator.info, tuple(simulator.joints)
    _require(info.timestep_s > 0.0 and info.decimation >= 1, "info: timestep and decimation > 0")
    _require(bool(info.engine), "info: engine is named")
    _require(len(joints) > 0 and len(set(joints)) == len(joints), "joints: unique names")
    unknown = set(simulator.parameters) - set(PARAMETERS)
    _require(not unknown, f"parameters: {', '.join(sorted(unknown))} unknown to pronk")
    _require({"stiffness", "damping"} <= set(simulator.parameters), "parameters: the gains")
    steps = max(40, round(0.2 / info.timestep_s))
    rng = np.random.default_rng(0)
    command = 0.1 * rng.standard_normal((2, 1, len(joints))) * np.ones((2, steps, 1))
    command[:, steps // 2 :] += 0.05
    usual = {"stiffness": 20.0, "damping": 0.5, "armature": 0.01, "frictionloss": 0.1, "delay": 0.0}
    shape = (2, len(joints))
    values = {n: np.full(shape, v) for n, v in usual.items() if n in simulator.parameters}
    before = command.copy()
    out = simulator.rollout(command, values)
    _require(np.shape(out) == command.shape, "rollout: the shape of the command is returned")
    _require(np.array_equal(command, before), "rollout: the command is left unchanged")
    _require(bool(np.isfinite(out).all()), "rollout: usual gains give finite positions")
    quarter = slice(steps // 4, steps // 2)
    drift = np.abs(np.diff(out[:, quarter], axis=1)).max()
    _require(float(drift) < 1e-3, "rollout: rest at the first command")
    moved = np.abs(out[:, -1] - out[:, steps // 2]).max(axis=0)
    _require(bool((moved > 1e-3).all()), "rollout: every joint follows its command")
    _require(np.allclose(simulator.rollout(command, values), out), "rollout: repeatable")
    single = simulator.rollout(command[:1], {k: v[:1] for k, v in values.items()})
    _require(np.allclose(single, out[:1], atol=1e-6), "rollout: runs are independent")
    later = command.copy()
    later[:, -5:] += 0.1
    early = simulator.rollout(later, values)[:, :-5]
    _require(np.allclose(early, out[:, :-5], atol=1e-9), "rollout: no response before its command")
    if len(joints) > 1:
        held = simulator.rollout(command, values, locked=joints[1:])
        _require(bool(np.ptp(held[..., 0], axis=1).min() > 1e-3), "locked: the free joint moves")
        _require(bool(np.isfinite(held).all()), "locked: positions stay finite")
    other = {"stiffness": 10.0, "damping": 1.0, "armature": 0.05, "frictionloss": 0.5}
    for name in sorted(simulator.parameters):
        changed = {**values, name: np.full(shape, other.get(name, 0.02))}
        effect = np.abs(simulator.rollout(command, changed) - out).max()
        _require(float(effect) > 1e-5, f"parameters: {name} has an effect")


def check_reader(
    chosen: Reader, path: Path, *, robot: RobotSpec | None = None, **options: Any
) -> None:
    """Check a log reader on a file that it should read.

    The log has two samples or more, one command and one position a joint, finite and increasing
    timestamps in seconds, its source and hash; reading twice gives the same log; a missing
    and an empty file are refused with a LogError. `options` are passed to the reader.
    """
    log = chosen.read(path, robot=robot, **options)
    _require(isinstance(log, JointLog), "read: a JointLog is returned")
    shape = (len(log.time), len(log.joints))
    _require(shape[0] >= 2 and shape[1] >= 1, "read: two samples and one joint or more")
    for name in ("command", "position"):
        values = np.asarray(getattr(log, name))
        _require(values.shape == shape, f"read: {name} has the shape (samples, joints)")
        _require(bool(np.isfinite(values).all()), f"read: {name} is finite")
    _require(bool((np.diff(log.time) > 0.0).all()), "read: timestamps increase")
    _require(log.source == str(path), "read: source is the path")
    _require(len(log.origin.sha256) == 64, "read: sha256 of the file")
    again = chosen.read(path, robot=robot, **options)
    _require(np.array_equal(again.position, log.position), "read: repeatable")
    with TemporaryDirectory() as folder:
        missing, empty = Path(folder, f"missing{path.suffix}"), Path(folder, f"empty{path.suffix}")
        empty.touch()
        for wrong in (missing, empty):
            rule = f"read: a file that is {wrong.stem} is refused with a LogError"
            _refused(LogError, rule, partial(chosen.read, wrong, robot=robot, **options))


def check_link(
    robot: RobotSpec,
    codec: Codec,
    states: Sequence[bytes],
    transport: Callable[[], Transport] | None = None,
) -> None:
    """Check a link's codec, and its transport where one is given.

    States decode to finite numbers of the robot's joints; cut, empty and foreign bytes are refused;
    commands encode to the same bytes every time, and impossible ones are refused; without an
    interface the transport is local. `states` are two or more messages of a live robot; `transport`
    opens the wire as an address without an interface does.
    """
    joints = len(robot.joints)
    _require(len(states) >= 2, "states: two or more are given")
    for data in states:
        state = codec.decode(data)
        sizes = dict.fromkeys(("position", "velocity", "torque"), joints)
        for name, size in {**sizes, "gyro": 3, "accelerometer": 3, "orientation": 4}.items():
            values = np.asarray(getattr(state, name))
            _require(values.shape == (size,), f"decode: {name} has shape ({size},)")
            _require(bool(np.isfinite(values).all()), f"decode: {name} is finite")
        norm = float(np.linalg.norm(state.orientation))
        _require(abs(norm - 1.0) < 0.02, "decode: orientation has length 1")
    for data in (b"", states[0][:-1], b"\xff" * len(states[0])):
        rule = f"decode: {len(data)} bytes that are no state are refused"
        _refused(RefusedError, rule, partial(codec.decode, data))
    pose = np.array([joint.default_position for joint in robot.joints])
    command = Command(position=pose, stiffness=np.full(joints, 10.0), damping=np.ones(joints))
    encoded, damped = codec.encode(command), codec.encode(damping_command(joints))
    _require(codec.encode(command) == encoded, "encode: repeatable")
    _require(encoded != damped, "encode: commands differ")
    for value in (np.nan, np.inf):
        wrong = Command(position=pose + value, stiffness=pose * 0, damping=pose * 0)
        rule = f"encode: a position of {value} is refused"
        _refused(HardwareError, rule, partial(codec.encode, wrong))
    _require(codec.state_rate_hz > 0.0, "state_rate_hz > 0")
    if transport is not None:
        wire = transport()
        try:
            _require(wire.local, "transport: local without an interface")
            _require(isinstance(wire.receive(0.0), list), "transport: receive returns a list")
        finally:
            wire.close()


def _require(kept: bool, rule: str) -> None:
    """Raise if a rule of a protocol is not kept."""
    if not kept:
        raise PronkError(f"the conformance check failed at: {rule}.")


def _refused(error: type[PronkError], rule: str, call: Callable[[], object]) -> None:
    """Raise unless a call is refused with this error."""
    try:
        call()
    except error:
        return
    _require(False, rule)
