"""Run a policy that was trained elsewhere, by its `deploy.yaml`."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.policy.deploy_yaml import COMMAND_TERMS, DeployFile, Term, shaped
from pronk.policy.observation import Measurement
from pronk.policy.rollout import measurement
from pronk.policy.runtime import open_session, read_network, run_once
from pronk.robots.machine import Command, State
from pronk.robots.robot import RobotSpec

_WRITER = "export the policy to ONNX, in one file"


class Driven(Protocol):
    """What `run_foreign` needs of a `Machine`."""

    def now(self) -> float:
        """Return the time of its clock [s]."""

    def latest(self) -> State:
        """Return the newest state."""

    def send(self, command: Command) -> None:
        """Put a command into force."""

    def wait(self, until: float) -> list[State]:
        """Let time pass to `until` [s] on its clock; return the states since the last call."""


class ForeignPolicy:
    """A network, how it is run, and the histories of the one robot that `step` runs."""

    def __init__(self, network: Callable[[Array], Array], deploy: DeployFile) -> None:
        """Wrap a network.

        Args:
            network: Returns the actions (joints,) for an observation (deploy.width,).
            deploy: How it is run.
        """
        self.deploy = deploy
        self.network = network
        self._places = np.array(deploy.joint_ids)
        self._default_position = np.array(deploy.default_position)
        self._scale = np.array(deploy.action_scale)
        self._offset = np.array(deploy.action_offset)
        self._lowest, self._highest = np.array(deploy.action_clip).T
        self._histories: list[deque[Array]] = []
        self._action = np.zeros(len(deploy.joint_ids))

    @property
    def stiffness(self) -> Array:
        """Stiffness of the drives, in the order of the robot's file [N m/rad]."""
        return np.array(self.deploy.stiffness)

    @property
    def damping(self) -> Array:
        """Damping of the drives, in the order of the robot's file [N m s/rad]."""
        return np.array(self.deploy.damping)

    @property
    def start_position(self) -> Array:
        """Targets at action zero, in the order of the robot's file [rad]."""
        return self._in_robot_order(self._offset)

    @property
    def action(self) -> Array:
        """Outputs of the network in the latest step, in the order of the robot's file."""
        return self._in_robot_order(self._action)

    def reset(self) -> None:
        """Begin anew: the next measurement fills the histories, the past action is zero."""
        self._histories = []
        self._action = np.zeros(len(self._places))

    def step(self, measured: Measurement, command: ArrayLike) -> Array:
        """Do one step and return joint position targets in the order of the robot's file [rad].

        Args:
            measured: The sensors now, joints in the order of the robot's file.
            command: Forward and left [m/s], yaw rate [rad/s].

        Raises:
            ArtefactError: The network returned a number that is not finite.
        """
        action = self.network(self._observation(measured, np.asarray(command, dtype=float)))
        if not np.isfinite(action).all():
            raise ArtefactError("the policy returned an action that is not finite.")
        self._action = action
        target = np.clip(self._offset + self._scale * action, self._lowest, self._highest)
        return self._in_robot_order(target)

    def _in_robot_order(self, values: Array) -> Array:
        """Return values of the joints of the network in the order of the robot's file."""
        ordered = np.empty(len(values))
        ordered[self._places] = values
        return ordered

    def _observation(self, measured: Measurement, command: Array) -> Array:
        """Return the observation with its histories, shape (width,)."""
        deploy = self.deploy
        samples: list[Array] = []
        for term in deploy.terms:
            samples.append(shaped(self._value(term, measured, command), term))
        if not self._histories:
            for term, sample in zip(deploy.terms, samples, strict=True):
                filled = [sample] * term.history_length
                self._histories.append(deque(filled, maxlen=term.history_length))
        rows = []
        for history, sample in zip(self._histories, samples, strict=True):
            history.append(sample)
            row = list(history)
            if deploy.newest_first:
                row.reverse()
            rows.append(row)
        parts: list[Array] = []
        if deploy.by_sample:
            for samples_of_time in zip(*rows, strict=True):
                parts += samples_of_time
        else:
            for row in rows:
                parts += row
        return np.concatenate(parts)

    def _value(self, term: Term, measured: Measurement, command: Array) -> Array:
        """Return the present value of a term, before it is clipped and scaled."""
        if term.name == "base_ang_vel":
            return np.array(measured.angular_velocity, dtype=np.float64)
        if term.name == "projected_gravity":
            gravity = np.array(measured.projected_gravity, dtype=np.float64)
            return self.deploy.gravity_sign * gravity
        if term.name in COMMAND_TERMS:
            return command
        if term.name == "last_action":
            return self._action
        if term.name in ("joint_vel", "joint_vel_rel"):
            velocity: Array = np.asarray(measured.velocity)[self._places]
            return velocity
        position: Array = np.asarray(measured.position)[self._places]
        if term.name == "joint_pos":
            return position
        relative: Array = position - self._default_position
        return relative


def load_foreign_network(path: Path, deploy: DeployFile) -> Callable[[Array], Array]:
    """Open the network of a policy that was trained elsewhere.

    Args:
        path: The ONNX file.
        deploy: Its `deploy.yaml`, whose widths the network must have.

    Returns:
        A function that returns the actions (joints,) for an observation (deploy.width,).

    Raises:
        ArtefactError: The file is missing or damaged, has a memory of its own, or other widths.
        PronkError: ONNX Runtime is not installed.
    """
    session = open_session(read_network(path, _WRITER), path, _WRITER)
    inputs = session.get_inputs()
    outputs = session.get_outputs()
    joints = len(deploy.joint_ids)
    if len(inputs) != 1:
        names = ", ".join(tensor.name for tensor in inputs) or "none"
        raise ArtefactError(
            f"{path}: the network has the inputs {names}; pronk runs networks with one, the "
            "observation. More than one are groups of observations, or the memory of a recurrent "
            "network."
        )
    input_width = _width(inputs[0], path, "input")
    output_width = _width(outputs[0], path, "output")
    if input_width != deploy.width:
        terms = ", ".join(
            f"{term.name} {len(term.scale)} x {term.history_length}" for term in deploy.terms
        )
        raise ArtefactError(
            f"{path}: the network's input {inputs[0].name} has {input_width} numbers, and "
            f"deploy.yaml describes {deploy.width}: {terms}.{_width_reason(input_width, deploy)}"
        )
    if output_width != joints:
        raise ArtefactError(
            f"{path}: the network's output {outputs[0].name} has {output_width} numbers; "
            f"deploy.yaml has {joints} joints."
        )
    name = inputs[0].name
    output = outputs[0].name
    run_once(session, {name: input_width}, [output], path)

    def network(observation: Array) -> Array:
        values = session.run([output], {name: observation.astype(np.float32)[None]})[0]
        return np.asarray(values[0], dtype=np.float64)

    return network


def _width(tensor: Any, path: Path, what: str) -> int:
    """Return the size of a tensor of shape (batch, size)."""
    shape = list(tensor.shape)
    if len(shape) != 2 or not isinstance(shape[1], int) or tensor.type != "tensor(float)":
        raise ArtefactError(
            f"{path}: the network's {what} {tensor.name} is {tensor.type} of shape {shape}; "
            "expected (1, size), float32."
        )
    return shape[1]


def _width_reason(width: int, deploy: DeployFile) -> str:
    """Name what would explain another width: another history length, or one term too many."""
    one_sample = sum(len(term.scale) for term in deploy.terms)
    reasons = []
    if width % one_sample == 0:
        reasons.append(f"a history_length of {width // one_sample} in every term")
    for term in deploy.terms:
        if deploy.width - term.size == width:
            reasons.append(f"no {term.name}")
    lengths = {term.history_length for term in deploy.terms}
    for length in sorted(lengths):
        if deploy.width + 3 * length == width:
            reasons.append("one more vector, as of base_lin_vel, which no robot measures")
    return f" It would fit with {' or '.join(reasons)}." if reasons else ""


def run_foreign(
    machine: Driven,
    policy: ForeignPolicy,
    source: Callable[[float], ArrayLike],
    *,
    seconds: float,
    running: Callable[[], bool] = lambda: True,
) -> float:
    """Run a policy on a connected machine; leave its last targets in force.

    Args:
        machine: The machine, connected, in the pose of the policy.
        policy: The policy.
        source: Gives the commanded velocity at a time since the policy started.
        seconds: How long it runs [s].
        running: Whether to go on, asked before each step.

    Returns:
        How long it ran [s].
    """
    policy.reset()
    begin = machine.now()
    step_s = policy.deploy.step_s
    tick = 0
    while tick * step_s < seconds - 1e-9 and running():
        state = machine.latest()
        command = Command(
            position=policy.step(measurement(state), source(tick * step_s)),
            stiffness=policy.stiffness,
            damping=policy.damping,
            sequence=tick,
            state_sequence=state.sequence,
            made=machine.now(),
        )
        machine.send(command)
        # A machine in real time may be past the next tick already.
        tick = max(tick + 1, math.ceil((machine.now() - begin) / step_s - 1e-6))
        machine.wait(begin + tick * step_s)
    return tick * step_s


def poses_out_of_range(deploy: DeployFile, robot: RobotSpec) -> list[str]:
    """List the joints whose pose in the file is outside of their range."""
    problems = []
    for index, value in zip(deploy.joint_ids, deploy.default_position, strict=True):
        joint = robot.joints[index]
        low, high = joint.range
        if not low <= value <= high:
            problems.append(
                f"default_joint_pos puts {joint.name} at {value:g} rad, outside its range of "
                f"{low:.3g} to {high:.3g}: the order of the joints is another one, or the robot"
            )
    return problems


def deploy_problems(deploy: DeployFile, robot: RobotSpec) -> list[str]:
    """List what contradicts the robot's file.

    Raises:
        ArtefactError: The policy has another number of joints.
    """
    joints = robot.joints
    if len(deploy.joint_ids) != len(joints):
        raise ArtefactError(
            f"deploy.yaml has {len(deploy.joint_ids)} joints; {robot.name} has {len(joints)}."
        )
    problems = poses_out_of_range(deploy, robot)
    named: dict[str, list[str]] = {}
    for joint, stiffness, damping in zip(joints, deploy.stiffness, deploy.damping, strict=True):
        same_stiffness = math.isclose(stiffness, joint.stiffness, rel_tol=1e-3)
        if same_stiffness and math.isclose(damping, joint.damping, rel_tol=1e-3):
            continue
        text = (
            f"{stiffness:g} N m/rad and {damping:g} N m s/rad in deploy.yaml; {robot.name}'s file "
            f"has {joint.stiffness:g} and {joint.damping:g}"
        )
        named.setdefault(text, []).append(joint.name)
    for text, names in named.items():
        problems.append(f"gains of {', '.join(names)}: {text}")
    return problems
