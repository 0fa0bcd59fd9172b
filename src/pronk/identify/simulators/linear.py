"""The simulator's step linearized, with the drive in closed form.

The 5 ms step about the pose is differentiated by MuJoCo (`mjd_transitionFD`) with a torque in
place of the excited joint's drive. That gives the discrete transfer functions from torque to
position `P_q(z)` and speed `P_v(z)`; explicit PD then gives

    H(z) = kp P_q / (1 + kp P_q + kd P_v + c z P_v),    z = exp(j omega timestep)

for any gains without simulating anything. Gains are translated between drive laws by it. Where
damping is implicit (`pronk.robots.drive_law`) it acts on the speed at the end of the step, `z P_v`.
`c = 4 f / (pi |speed|)` is the describing function of the joint's dry friction `f` (Gelb and
Vander Velde, *Multiple-Input Describing Functions*, 1968, table of appendix B: ideal relay) at
the amplitude of the response. The closed form does not have the dry friction of held joints, and
friction near sticking.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array, ComplexArray
from pronk.identify.simulators.mujoco import JointTestRig
from pronk.robots.drive_law import DriveLaw

_PERTURBATION = 1e-6
"""Perturbation of the finite differences: the best of central differences in float64."""

_STUCK_INERTIA = 1e5
"""Inertia of a joint that sticks over the largest one of the chain."""


@dataclass(frozen=True, kw_only=True)
class LinearJoint:
    """Responses of an excited joint without its drive, at f frequencies."""

    omega: Array
    """Frequencies [rad/s], shape (f,)."""
    position: ComplexArray
    """P_q, from torque at the joint to its position [rad/(N m)], shape (f,)."""
    speed: ComplexArray
    """P_v, from torque at the joint to its speed [rad/s/(N m)], shape (f,)."""
    timestep: float
    """Step of the integration [s]."""
    frictionloss: float
    """Dry friction of the joint [N m]."""
    law: DriveLaw
    """Law of the drive that closes the loop."""

    def response(
        self, stiffness: ArrayLike, damping: ArrayLike, *, amplitude: float = float("nan")
    ) -> ComplexArray:
        """Compute the response from the held command to position, as in FrequencyResponse.

        Args:
            stiffness: Stiffness of the drive [N m/rad], a number or of shape (b,).
            damping: Damping of the drive [N m s/rad], a number or of shape (b,).
            amplitude: Amplitude of the command [rad]; without it friction is left out.

        Returns:
            The response, shape (b, f).
        """
        kp = np.array(stiffness, dtype=np.float64, ndmin=1)[:, None]
        kd = np.array(damping, dtype=np.float64, ndmin=1)[:, None]
        # The sampled command is a staircase of physics steps; take that hold out.
        half_turn = self.omega * self.timestep / 2.0
        hold = np.exp(-1j * half_turn) * np.sinc(half_turn / np.pi)
        next_speed = self.speed * np.exp(1j * self.omega * self.timestep)
        kd = self.law.damping(kp, kd, self.timestep)
        direct = kp * self.position
        damped_speed = self.speed if self.law.kind == "explicit" else next_speed
        open_loop = 1.0 + direct + kd * damped_speed
        closed = direct / open_loop
        if self.frictionloss > 0.0 and np.isfinite(amplitude):
            # MuJoCo's dry friction is implicit: it opposes the speed at the end of the step. The
            # amplitude `x` of that speed solves `|x open_loop + relay next_speed| = forced`.
            relay = 4.0 * self.frictionloss / np.pi
            forced = amplitude * self.omega * np.abs(direct)
            square = open_loop.real**2 + open_loop.imag**2
            half = relay * (open_loop.real * next_speed.real + open_loop.imag * next_speed.imag)
            constant = square * ((relay * np.abs(next_speed)) ** 2 - forced**2)
            speed = (np.sqrt(np.maximum(half**2 - constant, 0.0)) - half) / square
            closed = direct / (open_loop + relay / np.maximum(speed, 1e-9) * next_speed)
        return np.asarray(closed / hold)


def linearize(
    rig: JointTestRig, pose: Array, omega: Array, *, others_stick: bool = False
) -> LinearJoint:
    """Linearize the joint of a rig.

    Args:
        rig: The rig.
        pose: Pose of its chain [rad], shape (n,).
        omega: Frequencies [rad/s], shape (f,).
        others_stick: Whether dry friction holds the other joints of the chain where they are.
    """
    # The excited joint takes a torque in place of its drive. No joint has dry friction: MuJoCo's
    # friction is a stiff damper where a joint sticks and a constant where it slips, so that a held
    # joint near its breakaway would give derivatives that hold for no motion at all. A stop that
    # the pose touches and a contact are as stiff.
    model = copy.copy(rig.model)
    actuator = rig.actuator
    model.actuator_gaintype[actuator] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_NONE
    model.actuator_dyntype[actuator] = mujoco.mjtDyn.mjDYN_NONE
    model.actuator_gainprm[actuator] = 0.0
    model.actuator_gainprm[actuator, 0] = 1.0
    model.actuator_ctrllimited[actuator] = False
    model.actuator_forcelimited[actuator] = False
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
        | mujoco.mjtDisableBit.mjDSBL_LIMIT
        | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    if others_stick:
        others = np.arange(model.nv) != rig.index
        model.dof_armature[others] += _STUCK_INERTIA * float(model.dof_M0.max())
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    data.ctrl[:] = rig.control(pose)
    mujoco.mj_forward(model, data)
    # Hold the joint against gravity, so that the linearization is about rest.
    data.ctrl[actuator] = data.qfrc_bias[rig.index]
    size = 2 * model.nv + model.na
    a = np.zeros((size, size))
    b = np.zeros((size, model.nu))
    mujoco.mjd_transitionFD(model, data, _PERTURBATION, True, a, b, None, None)
    z = np.exp(1j * omega * model.opt.timestep)[:, None, None]
    states = np.linalg.solve(z * np.eye(size) - a, b[:, actuator, None])[..., 0]
    return LinearJoint(
        omega=omega,
        position=states[:, rig.index],
        speed=states[:, model.nv + rig.index],
        timestep=float(model.opt.timestep),
        frictionloss=float(rig.model.dof_frictionloss[rig.index]),
        law=rig.robot.law,
    )
