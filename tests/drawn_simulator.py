"""Simulators with known laws, parameters and faults, drawn at random, for `pronk probe`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engine import delayed
from pronk.identify.simulators.factory import simulator_factory
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.links import links_of
from pronk.identify.simulators.mujoco import Chain
from pronk.identify.simulators.probe.result import Probe
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

EXAMPLES = Path(__file__).parents[1] / "examples"
ROBOTS = (
    (str(EXAMPLES / "pendulum"), "swing"),
    ("mini_cheetah", "FR_knee"),
    ("go2", "RL_knee"),
)
"""Robots that are drawn, and the joint of each that is probed."""
LAWS = (
    DriveLaw(),
    DriveLaw(kind="implicit_damping"),
    DriveLaw(kind="implicit", iterations=1),
    DriveLaw(kind="implicit", iterations=4),
    DriveLaw(kind="implicit", iterations=10),
)
"""Laws that are drawn."""


@dataclass(frozen=True, kw_only=True)
class DrawnEngine:
    """An engine of `examples/engines` in which simulators are drawn."""

    choice: str
    """The value of `--simulator`."""
    module: str
    """What is imported to see whether the engine is installed."""
    laws: tuple[DriveLaw, ...]
    """Laws that are drawn."""


ENGINES = {
    "Sapien": DrawnEngine(
        choice=f"{EXAMPLES}/engines/sapien.py:Sapien",
        module="sapien",
        laws=(LAWS[0], LAWS[2], LAWS[3], LAWS[4]),
    ),
    "Drake": DrawnEngine(
        choice=f"{EXAMPLES}/engines/drake.py:Drake", module="pydrake", laws=(LAWS[0], LAWS[2])
    ),
    "PyBullet": DrawnEngine(
        choice=f"{EXAMPLES}/engines/pybullet.py:PyBullet", module="pybullet", laws=(LAWS[0],)
    ),
}
FAULTS = ("ignored", "armature", "twice", "degrees", "law", "beside", "hold")
"""Words of `Probe.faults`; each second simulator has one of them."""
DEFAULT_ARMATURE = 0.1
"""Armature that Genesis gives a joint of a URDF that names none [kg m^2]."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What is drawn of one simulator."""

    kind: str
    """`numpy`, `mujoco`, or a name of `ENGINES`."""
    robot: RobotSpec
    joint: str
    law: DriveLaw
    """Law that acts."""
    stated: DriveLaw
    """Law that the simulator states."""
    armature: float
    """Armature that acts [kg m^2]."""
    frictionloss: float
    """Dry friction that acts [N m]."""
    delay_s: float
    """Delay of the command [s]."""
    hold: int
    """Steps that a command is held for."""
    scale: float
    """Gains that act over those that are set."""
    fault: str
    """One of `FAULTS`; empty for a simulator without a fault."""


class DrawnSimulator:
    """A `Simulator` of one joint as it was drawn."""

    def __init__(self, truth: Truth) -> None:
        robot = truth.robot
        self.truth = truth
        self.joints = robot.joint_names
        self.parameters = frozenset({"stiffness", "damping", "armature"})
        self.info = SimulatorInfo(
            engine="unknown",
            timestep_s=robot.timestep_s,
            decimation=robot.decimation,
            law=truth.stated.kind,
            iterations=truth.stated.iterations,
        )

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Positions of the joint; see `Simulator.rollout`."""
        truth = self.truth
        column = self.joints.index(truth.joint)
        assert truth.joint not in locked
        hold = np.arange(command.shape[1]) // truth.hold * truth.hold
        delay = np.full((len(command), len(self.joints)), truth.delay_s / self.info.timestep_s)
        delayed_command = delayed(command[:, hold], delay)
        stiffness = values["stiffness"][:, column] * truth.scale
        damping = values["damping"][:, column] * truth.scale
        armature = np.full(len(command), truth.robot.joint(truth.joint).drive.armature)
        if "armature" in values:
            armature = values["armature"][:, column].copy()
        if truth.fault == "ignored":
            armature[:] = truth.armature
        elif truth.fault == "armature":
            armature += DEFAULT_ARMATURE
        if truth.kind == "numpy":
            positions = self._by_numpy(delayed_command[..., column], stiffness, damping, armature)
        elif truth.kind == "mujoco":
            positions = self._by_mujoco(delayed_command[..., column], stiffness, damping, armature)
        else:
            positions = self._by_engine(delayed_command, stiffness, damping, armature)
        all_positions = np.repeat(command[:, :1], command.shape[1], axis=1)
        all_positions[..., column] = positions
        return all_positions

    def _by_numpy(self, command: Array, kp: Array, kd: Array, armature: Array) -> Array:
        """The laws of `pronk.robots.drive_law` with Coulomb friction, shape (B, T)."""
        truth = self.truth
        links = links_of(truth.robot, truth.joint)
        arm = np.cross(links.axis[0], links.centre[0])
        inertia = links.axis[0] @ links.inertia[0] @ links.axis[0] + links.mass[0] * arm @ arm
        inertia = inertia + armature
        # Of one hinge it is a sinusoid of the angle.
        gravity_at_zero = links.gravity_torque(np.zeros(1))[0]
        gravity_at_quarter = links.gravity_torque(np.full(1, 0.5 * np.pi))[0]
        law = truth.law
        h = truth.robot.timestep_s / law.iterations
        explicit = law.kind == "explicit" or truth.fault == "beside"
        viscous = truth.robot.joint(truth.joint).drive.viscous_damping
        q = command[:, 0].copy()
        v = np.zeros(len(command))
        positions = np.empty(command.shape)
        for step in range(command.shape[1]):
            target = command[:, step]
            positions[:, step] = q
            torque_before = np.zeros(len(command))
            if explicit:
                torque_before = kp * (target - q) - kd * v
            for _ in range(law.iterations):
                gravity = gravity_at_zero * np.cos(q) + gravity_at_quarter * np.sin(q)
                force = torque_before + gravity - viscous * v
                mass = inertia + h * viscous
                if law.kind != "explicit":
                    force = force + kp * (target - q) - kd * v
                    mass = mass + h * kd
                if law.kind == "implicit":
                    force = force - h * kp * v
                    mass = mass + h * h * kp
                v = v + h * force / mass
                v = np.sign(v) * np.maximum(np.abs(v) - h * truth.frictionloss / mass, 0.0)
                q = q + h * v
        return positions

    def _by_mujoco(self, command: Array, kp: Array, kd: Array, armature: Array) -> Array:
        """The training simulator with the law, shape (B, T)."""
        truth = self.truth
        robot = replace(truth.robot, law=truth.law)
        values = {
            "stiffness": kp[:, None],
            "damping": kd[:, None],
            "armature": armature[:, None],
            "frictionloss": np.full((len(command), 1), truth.frictionloss),
        }
        with Chain(robot, truth.joint, threads=1) as chain:
            return chain.rollout(command[..., None], values)[:, :-1, 0]

    def _by_engine(self, command: Array, kp: Array, kd: Array, armature: Array) -> Array:
        """An engine of `examples/engines`, shape (B, T); its command is that of all joints."""
        truth = self.truth
        column = self.joints.index(truth.joint)
        make = simulator_factory(ENGINES[truth.kind].choice)
        simulator = make(replace(truth.robot, law=truth.law))
        values = {}
        for name, joint_values in (("stiffness", kp), ("damping", kd), ("armature", armature)):
            values[name] = np.ones((len(command), len(self.joints)))
            values[name][:, column] = joint_values
        if "frictionloss" in simulator.parameters:
            values["frictionloss"] = np.full((len(command), len(self.joints)), truth.frictionloss)
        locked = [name for name in self.joints if name != truth.joint]
        return np.asarray(simulator.rollout(command, values, locked=locked)[..., column])


def draw_truth(generator: np.random.Generator, kind: str, fault: str) -> Truth:
    """Draw one simulator of a kind with a fault, or none."""
    robot_name, joint_name = ROBOTS[generator.integers(len(ROBOTS))]
    step = float(generator.choice([0.001, 0.002, 0.004, 0.005]))
    robot = replace(load_robot(robot_name), timestep_s=step, decimation=round(0.02 / step))
    laws = list(LAWS)
    if kind in ENGINES:
        laws = list(ENGINES[kind].laws)
    if fault == "beside":
        laws = [law for law in laws if law.kind != "explicit"]
    law = laws[generator.integers(len(laws))]
    stated = law
    if fault == "law":
        other_laws = [other for other in laws if other != law]
        if not other_laws:
            other_laws = [DriveLaw(kind="implicit_damping")]
        stated = other_laws[generator.integers(len(other_laws))]
    joint = robot.joint(joint_name)
    armature = joint.drive.armature * float(generator.uniform(0.6, 1.8))
    joint = replace(
        joint,
        drive=replace(joint.drive, rotor_inertia=armature / joint.drive.gear_ratio**2),
        stiffness=joint.stiffness * float(generator.uniform(0.6, 1.3)),
        damping=joint.damping * float(generator.uniform(0.5, 1.2)),
    )
    joints = [joint if other.name == joint_name else other for other in robot.joints]
    robot = replace(robot, joints=tuple(joints))
    scale = 1.0
    if fault == "degrees":
        scale = float(generator.choice([180.0 / np.pi, np.pi / 180.0]))
    elif fault == "twice":
        scale = 2.0
    acting_armature = joint.drive.armature
    if fault == "ignored":
        acting_armature = 0.0 if generator.random() < 0.5 else 0.5 * armature
    elif fault == "armature":
        acting_armature += DEFAULT_ARMATURE
    frictionloss = 0.0
    if kind not in ENGINES and scale >= 0.1:
        frictionloss = float(generator.choice([0.0, generator.uniform(0.02, 0.3)]))
    return Truth(
        kind=kind,
        robot=robot,
        joint=joint_name,
        law=law,
        stated=stated,
        armature=acting_armature,
        frictionloss=frictionloss,
        delay_s=float(generator.choice([0.0, generator.uniform(0.0, 0.02)])),
        hold=int(generator.choice([2, 4, 5])) if fault == "hold" else 1,
        scale=scale,
        fault=fault,
    )


def score(truth: Truth, probe: Probe) -> dict[str, float | bool | str]:
    """How far a probe is from the truth."""
    # A joint that is not stable with its gains is no fault that was drawn.
    named = set(probe.faults) - {"unstable"}
    delay_named = "delay" in named
    named.discard("delay")
    drive = truth.robot.joint(truth.joint).drive
    acting_armature = truth.armature
    if truth.kind == "PyBullet":
        # Explicit passive damping moves the joint as the implicit one of the laws does with so
        # much less armature.
        acting_armature -= truth.robot.timestep_s * drive.viscous_damping
    reference_armature = truth.armature if truth.armature > 0.0 else drive.armature
    armature_error = abs(probe.armature - acting_armature) / reference_armature
    delay_error = abs(probe.delay_s - truth.delay_s)
    beside_explicit = truth.fault == "beside"
    expected_faults = {truth.fault} if truth.fault else set()
    # A delay near the limit may be named or not.
    is_late = truth.delay_s > 0.1 * truth.robot.timestep_s
    may_be_named = truth.delay_s > 0.0
    delay_right_named = delay_named >= is_late and delay_named <= may_be_named
    return {
        "kind": truth.kind,
        "joint": truth.joint,
        "law": truth.law.label,
        "found": probe.law.drive.label,
        "law_right": probe.law.drive == truth.law and probe.law.beside_explicit == beside_explicit,
        "armature_error": armature_error,
        "armature_right": armature_error < 0.02,
        "delay_error_s": delay_error,
        "delay_right": delay_error < 5e-4 and delay_right_named,
        "friction_error": abs(probe.frictionloss - truth.frictionloss),
        "hold_right": probe.hold == truth.hold,
        "fault": truth.fault,
        "named": " ".join(sorted(named)),
        "fault_right": named == expected_faults,
        "residual": probe.residual,
    }
