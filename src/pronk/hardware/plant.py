"""The different machine: rotors behind compliant belts, driven by DC motors.

From the robot's own structure (`Robot.build_spec`) comes a plant in which every joint has two
degrees of freedom: the link, and the rotor with the inertia reflected through the gear. A belt
(spring and damper) couples them. Motor, encoder and friction sit on the rotor, as on the robot.
All of it is in joint coordinates.

The drive is MuJoCo's `dcmotor`, whose controller speaks volts. A drive that regulates current
asks for tau = stiffness (target - q) - damping qdot and believes in a motor constant K0; the motor
has K = torque_scale K0, in torque as in back-EMF (one magnetic flux). The voltage that drives the
current tau / K0 through R against the back-EMF is

    V = R tau / K0 + K qdot,    torque = K (V - K qdot) / R = torque_scale tau,

so the controller gains are R stiffness / K0 and R damping / K0 - K, and the clip of V at the bus
gives the torque-speed line of the true motor. Friction is LuGre with a Stribeck peak:
dz/dt = v - sigma0 |v| z / g(v), g = F_C + (F_S - F_C) exp(-(v/v_S)^2), torque sigma0 z +
sigma1 dz/dt, outside the limits of the motor.

Time stepping. MuJoCo's Euler step is symplectic: positions see the new speed, torques the old one.
With the drive's derivative torque explicit, q_{n+1} - 2 q_n + q_{n-1} = -(h/I) kd (q_n - q_{n-1})
+ ..., in which the backward difference stands for qdot - (h/2) qddot: the joint answers as if its
inertia were smaller by kd h / 2, an error of first order in the step h (0.13 dB at 0.25 ms). The
rotor is therefore given that much more inertia, which leaves an error of second order; passive
damping is implicit in MuJoCo, so its share has the other sign. The same effect, uncorrected and
at 5 ms, is what makes gains matched in the training simulator differ from those on the drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import RobotError
from pronk.hardware.truth import JointTruth, Truth
from pronk.robots.robot import Drive, Robot

Array = NDArray[np.float64]

# The rotor's inertia lives in the armature of its hinge; MuJoCo still wants a body with mass.
# 1e-9 kg on the joint's axis is nothing beside the lightest link.
_ROTOR_MASS = 1e-9
# Largest angular frequency of a spring times the step; the symplectic step is stable below 2.
_STABLE = 1.0
_STAND_AXES = {"stand_roll": (1, 0, 0), "stand_pitch": (0, 1, 0), "stand_yaw": (0, 0, 1)}

# Places in MuJoCo's parameter vectors of a dcmotor (MuJoCo 3.11).
_KP, _KD, _VMAX = 4, 6, 7


@dataclass(frozen=True, kw_only=True)
class MotorConstants:
    """A drive's motor as MuJoCo's `dcmotor` sees it: one constant, joint side.

    `constant` and `resistance` reproduce the stall torque and the no-load speed of the drive
    at its nominal bus voltage.
    """

    constant: float
    """Torque per ampere and volt per speed [N m/A = V s/rad]."""
    resistance: float
    """[ohm]"""

    @classmethod
    def of(cls, drive: Drive) -> MotorConstants:
        """The constants of a drive, as the drive itself believes them."""
        constant = drive.bus_voltage / drive.no_load_speed
        return cls(constant=constant, resistance=constant * drive.bus_voltage / drive.stall_torque)


@dataclass(frozen=True)
class Plant:
    """A compiled plant and where to find its parts. Arrays are in the order of `joints`."""

    model: Any
    """mujoco.MjModel"""
    joints: tuple[str, ...]
    """Joints that are in the plant, in file order."""
    rotor: NDArray[np.intp]
    """Index of each rotor in qpos and qvel (every joint of the plant is a hinge)."""
    link: NDArray[np.intp]
    """Index of each link in qpos and qvel."""
    actuator: NDArray[np.intp]
    """Index of each motor in ctrl."""
    current: NDArray[np.intp]
    """Index of each motor's current in act."""
    stand: NDArray[np.intp]
    """Indices of the stand's roll, pitch and yaw in qpos and qvel; empty if it is rigid."""
    constant: Array
    """True motor constants K [V s/rad]."""
    believed: Array
    """Motor constants K0 that the drives believe [V s/rad]."""
    resistance: Array
    """[ohm]"""
    effort_limit: Array
    """Largest torque that the motors give when the drives believe to be at theirs [N m]."""
    rotor_inertia: Array
    """True, reflected through the gear [kg m^2]."""
    viscous: Array
    """[N m s/rad]"""

    def set_gains(self, stiffness: Array, damping: Array) -> None:
        """Put gains on the drives, in force from the next physics step.

        Args:
            stiffness: [N m/rad], shape (joints,).
            damping: [N m s/rad], shape (joints,).
        """
        volts = self.resistance / self.believed
        self.model.actuator_gainprm[self.actuator, _KP] = volts * stiffness
        self.model.actuator_gainprm[self.actuator, _KD] = volts * damping - self.constant
        # Second-order time stepping; see the module's docstring.
        explicit = self.constant / self.believed * damping - self.viscous
        half_step = 0.5 * self.model.opt.timestep
        inertia = self.rotor_inertia + half_step * explicit
        self.model.dof_armature[self.rotor] = inertia
        # What MuJoCo reads in its place for a rotor whose parent cannot move.
        self.model.dof_M0[self.rotor] = inertia + _ROTOR_MASS

    def set_bus_voltage(self, voltage: float) -> None:
        """Set the voltage at which the inverters clip [V]."""
        self.model.actuator_gainprm[self.actuator, _VMAX] = voltage

    def motor_torque(self, act: Array) -> Array:
        """Torque of the motors without friction [N m], shape (joints,).

        Args:
            act: Activation of the plant; the currents are in it.
        """
        torque = self.constant * act[self.current]
        return np.minimum(np.maximum(torque, -self.effort_limit), self.effort_limit)

    def set_clamps(
        self, joints: tuple[str, ...], q: Array, stiffness: float, damping: float
    ) -> None:
        """Hold links where they are with a fixture; release all others.

        The fixture is a spring and damper between link and body, not a constraint: its
        stiffness has a unit that can be looked up, and it costs no solver iterations.

        Args:
            joints: Names of the joints whose links are held; () releases all.
            q: Generalized positions of the plant [rad].
            stiffness: [N m/rad]
            damping: [N m s/rad]
        """
        for name, index in zip(self.joints, self.link, strict=True):
            held = name in joints
            self.model.jnt_stiffness[index] = stiffness if held else 0.0
            self.model.dof_damping[index] = damping if held else 0.0
            self.model.qpos_spring[index] = q[index] if held else 0.0


def legs_of(robot: Robot) -> tuple[str, ...]:
    """Names of the robot's legs, the first part of its joints' names, in file order."""
    return tuple(dict.fromkeys(joint.name.split("_")[0] for joint in robot.joints))


def _body_of(spec: Any, joint: str) -> Any:
    hinge = spec.joint(joint)
    if hinge is None:
        raise RobotError(f"the robot's model has no joint {joint!r}.")
    return hinge.parent


def _fix_base(spec: Any, robot: Robot, truth: Truth) -> None:
    base = spec.body(robot.base_body)
    for joint in list(base.joints):
        spec.delete(joint)
    if math.isfinite(truth.machine.stand_stiffness):
        for name, axis in _STAND_AXES.items():
            base.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                stiffness=[truth.machine.stand_stiffness, 0, 0],
                damping=[truth.machine.stand_damping, 0, 0],
            )


def _drop_legs(spec: Any, robot: Robot, kept: set[str]) -> None:
    """Delete every subtree under the base that holds no kept joint."""
    for child in list(spec.body(robot.base_body).bodies):
        names = [joint.name for joint in child.find_all("joint")]
        names += [joint.name for joint in child.joints]
        if names and not any(name in kept for name in names):
            spec.delete(child)


def _discrete_lag(lag_s: float, timestep_s: float) -> float:
    """Time constant to give to MuJoCo so that torque is late by `lag_s` in all [s].

    MuJoCo integrates the current exactly over a step h with time constant t, and applies it in
    that very step: late by h / (exp(h / t) - 1) at low frequency. Solved for t.
    """
    return timestep_s / math.log1p(timestep_s / lag_s)


def _add_rotor(spec: Any, name: str, drive: Drive, true: JointTruth, lag_s: float) -> None:
    link_body = _body_of(spec, name)
    link = spec.joint(name)
    rotor_body = link_body.parent.add_body(
        name=f"{name}/rotor",
        pos=link_body.pos,
        quat=link_body.quat,
        mass=_ROTOR_MASS,
        inertia=[_ROTOR_MASS] * 3,
        ipos=link.pos,
        explicitinertial=True,
    )
    rotor_body.add_joint(
        name=f"{name}/rotor",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=link.axis,
        pos=link.pos,
        armature=true.rotor_inertia * drive.gear_ratio**2,
        damping=[true.viscous, 0, 0],
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
    )
    # Nothing of the training model's joint remains but its axis and its stops.
    link.armature = 0.0
    link.frictionloss = 0.0
    link.damping = [0.0, 0.0, 0.0]
    link.stiffness = [0.0, 0.0, 0.0]
    belt = spec.add_tendon(
        name=f"{name}/belt",
        stiffness=[true.belt_stiffness, 0, 0],
        damping=[true.belt_damping, 0, 0],
        springlength=[0.0, 0.0],
    )
    belt.wrap_joint(f"{name}/rotor", 1.0)
    belt.wrap_joint(name, -1.0)
    motor = MotorConstants.of(drive)
    constant = true.torque_scale * motor.constant
    spec.add_actuator(
        name=f"{name}/motor", target=f"{name}/rotor", trntype=mujoco.mjtTrn.mjTRN_JOINT
    ).set_to_dcmotor(
        # A second constant other than zero would silently become their geometric mean.
        motorconst=[constant, 0.0],
        resistance=motor.resistance,
        saturation=[true.torque_scale * drive.effort_limit, 0.0, 0.0],
        # kp, ki, kd, slew limit, integral limit, voltage limit; gains are set by set_gains().
        controller=[0.0, 0.0, 0.0, 0.0, 0.0, drive.bus_voltage],
        lugre=[
            true.presliding_stiffness,
            true.presliding_damping,
            true.coulomb,
            true.breakaway,
            true.stribeck_speed,
        ],
        # Inductance over resistance stands for all that delays torque inside the drive.
        inductance=[0.0, _discrete_lag(lag_s, spec.option.timestep)],
        input_mode=1,  # ctrl is a position
    )


def _check_springs(plant: Plant, truth: Truth) -> None:
    """Refuse springs that the physics step cannot follow.

    Raises:
        RobotError: Names the field and the largest value that would do.
    """
    model = plant.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    mobility = np.diag(np.linalg.inv(inertia))
    for k, name in enumerate(plant.joints):
        joint = truth.joints[name]
        rotor, link = mobility[plant.rotor[k]], mobility[plant.link[k]]
        for field, value, mobile in (
            ("belt_stiffness", joint.belt_stiffness, rotor + link),
            ("presliding_stiffness", joint.presliding_stiffness, rotor),
        ):
            most = (_STABLE / model.opt.timestep) ** 2 / mobile
            if value > most:
                raise RobotError(
                    f"joints.{name}.{field} is {value:g}; at a physics step of "
                    f"{model.opt.timestep:g} s at most {most:.3g} N m/rad can be simulated."
                )


def build_plant(robot: Robot, truth: Truth, legs: tuple[str, ...], timestep_s: float) -> Plant:
    """Build the plant on the bench: base on the stand, feet in the air, no contacts.

    Args:
        robot: Structure, masses and drives to start from.
        truth: In what the machine differs.
        legs: Legs to keep in the plant, of `legs_of(robot)`.
        timestep_s: Physics step [s].

    Raises:
        RobotError: The truth is of another robot, a joint is missing in the model or in the truth,
            or a spring is too stiff for the step.
    """
    if truth.robot != robot.name:
        raise RobotError(
            f"the truth is of {truth.robot!r}, the robot is {robot.name!r}; give a truth file "
            "written for that robot."
        )
    truth.check_joints(robot.joint_names)
    joints = tuple(joint for joint in robot.joints if joint.name.split("_")[0] in legs)
    spec = robot.build_spec()
    spec.option.timestep = timestep_s
    for key in list(spec.keys):
        spec.delete(key)
    _fix_base(spec, robot, truth)
    _drop_legs(spec, robot, {joint.name for joint in joints})
    for joint in joints:
        _add_rotor(
            spec, joint.name, joint.drive, truth.joints[joint.name], truth.machine.drive_lag_s
        )
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model = spec.compile()

    def addresses(suffix: str) -> NDArray[np.intp]:
        return np.array(
            [model.joint(f"{joint.name}{suffix}").dofadr[0] for joint in joints], dtype=np.intp
        )

    if model.nq != model.nv:
        raise RobotError(f"{robot.name}: the virtual robot knows hinge joints only.")
    # Mass and inertia by the same factor: a body that was possible stays possible.
    for joint in joints:
        body = int(model.jnt_bodyid[model.joint(joint.name).id])
        model.body_mass[body] *= truth.joints[joint.name].link_inertia_scale
        model.body_inertia[body] *= truth.joints[joint.name].link_inertia_scale
    mujoco.mj_setConst(model, mujoco.MjData(model))
    scale = np.array([truth.joints[joint.name].torque_scale for joint in joints])
    motors = [MotorConstants.of(joint.drive) for joint in joints]
    believed = np.array([motor.constant for motor in motors])
    rigid = not math.isfinite(truth.machine.stand_stiffness)
    plant = Plant(
        model=model,
        joints=tuple(joint.name for joint in joints),
        rotor=addresses("/rotor"),
        link=addresses(""),
        actuator=np.array([model.actuator(f"{j.name}/motor").id for j in joints], dtype=np.intp),
        # LuGre's bristle comes first among a motor's states, its current last.
        current=np.array(
            [
                model.actuator_actadr[motor] + model.actuator_actnum[motor] - 1
                for motor in (model.actuator(f"{joint.name}/motor").id for joint in joints)
            ],
            dtype=np.intp,
        ),
        stand=np.array(
            [] if rigid else [model.joint(name).dofadr[0] for name in _STAND_AXES], dtype=np.intp
        ),
        constant=scale * believed,
        believed=believed,
        resistance=np.array([motor.resistance for motor in motors]),
        effort_limit=scale * np.array([joint.drive.effort_limit for joint in joints]),
        rotor_inertia=np.array(
            [truth.joints[j.name].rotor_inertia * j.drive.gear_ratio**2 for j in joints]
        ),
        viscous=np.array([truth.joints[joint.name].viscous for joint in joints]),
    )
    _check_springs(plant, truth)
    return plant
