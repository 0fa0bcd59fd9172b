"""A joint's drive in the plant: a rotor behind a belt, turned by a DC motor.

The drive is MuJoCo's `dcmotor`, whose controller speaks volts. A drive that regulates current
asks for tau = stiffness (target - q) - damping qdot and believes in a motor constant K0; the motor
has K = torque_scale K0, in torque as in back-EMF (one magnetic flux). The voltage that drives the
current tau / K0 through R against the back-EMF is

    V = R tau / K0 + K qdot,    torque = K (V - K qdot) / R = torque_scale tau,

so the controller gains are R stiffness / K0 and R damping / K0 - K, and the clip of V at the bus
gives the torque-speed line of the true motor. Friction is LuGre with a Stribeck peak:
dz/dt = v - sigma0 |v| z / g(v), g = F_C + (F_S - F_C) exp(-(v/v_S)^2), torque sigma0 z +
sigma1 dz/dt, outside the limits of the motor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco

from pronk.actuator.model import motor_constants
from pronk.errors import RobotError
from pronk.robots.robot import Drive
from pronk.virtual.sim_params import JointParams

ROTOR_MASS = 1e-9
"""The rotor's inertia lives in the armature of its hinge; MuJoCo still wants a body with mass, and
1e-9 kg on the joint's axis is nothing beside the lightest link."""

_STOP_S = 2e-3
"""Time in which a joint that has run into its stop is pushed back, 8 physics steps [s]."""


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
        constant, resistance = motor_constants(
            stall_torque=drive.stall_torque,
            no_load_speed=drive.no_load_speed,
            bus_voltage=drive.bus_voltage,
        )
        return cls(constant=constant, resistance=resistance)


def _discrete_lag(lag_s: float, timestep_s: float) -> float:
    """Time constant to give to MuJoCo so that torque is late by `lag_s` in all [s].

    MuJoCo integrates the current exactly over a step h with time constant t, and applies it in
    that very step: late by h / (exp(h / t) - 1) at low frequency. Solved for t.
    """
    return timestep_s / math.log1p(timestep_s / lag_s)


def add_rotor(spec: Any, name: str, drive: Drive, true: JointParams, lag_s: float) -> None:
    """Give a joint of a spec its rotor, belt and motor: `NAME/rotor`, `NAME/belt`, `NAME/motor`.

    Args:
        spec: mujoco.MjSpec to change.
        name: Of the joint.
        drive: With the constants that the drive believes.
        true: With the true ones.
        lag_s: By which torque is late [s].

    Raises:
        RobotError: The model has no such joint.
    """
    link_body = _body_of(spec, name)
    link = spec.joint(name)
    rotor_body = link_body.parent.add_body(
        name=f"{name}/rotor",
        pos=link_body.pos,
        quat=link_body.quat,
        mass=ROTOR_MASS,
        inertia=[ROTOR_MASS] * 3,
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
    # A mechanical stop is hard: the model's gives way by 0.4 rad under the weight of the trunk.
    link.solref_limit = [_STOP_S, 1.0]
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


def _body_of(spec: Any, joint: str) -> Any:
    hinge = spec.joint(joint)
    if hinge is None:
        raise RobotError(f"the robot's model has no joint {joint!r}.")
    return hinge.parent
