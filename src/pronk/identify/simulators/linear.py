"""The simulator's step linearized, with the drive in closed form.

The 5 ms step about the pose is differentiated by MuJoCo (`mjd_transitionFD`) with a torque in
place of the excited joint's drive. That gives the discrete transfer functions from torque to
position `P_q(z)` and speed `P_v(z)`; explicit PD then gives

    H(z) = kp P_q / (1 + kp P_q + kd P_v + c z P_v),    z = exp(j omega timestep)

for a whole grid of gains without simulating anything. Where damping is implicit
(`pronk.robots.drive_law`) it acts on the speed at the end of the step, `z P_v`.
`c = 4 f / (pi |speed|)` is the describing function of the joint's dry friction `f` (Gelb and
Vander Velde, *Multiple-Input Describing Functions*, 1968, table of appendix B: ideal relay) at
the amplitude of the response. What it leaves out (coupling through held joints that
slip, the estimator's leakage, friction near sticking) is a smooth ratio that simulations at the
optimum correct.
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

_EPS = 1e-6
"""Perturbation of the finite differences: the best of central differences in float64."""
_STEP = 1e-3  # step of `Plant.slope` in the logarithm of a gain


@dataclass(frozen=True, kw_only=True)
class Plant:
    """Torque at the excited joint to its position and speed, at some frequencies."""

    omega: Array
    """[rad/s], shape (f,)."""
    position: ComplexArray
    """P_q [rad/(N m)], shape (f,)."""
    speed: ComplexArray
    """P_v [rad/s/(N m)], shape (f,)."""
    timestep: float
    """Of the integration [s]."""
    frictionloss: float
    """Dry friction of the excited joint [N m]."""
    law: DriveLaw

    def response(
        self, stiffness: ArrayLike, damping: ArrayLike, *, amplitude: float = float("nan")
    ) -> ComplexArray:
        """Response from the held command to position, as in FrequencyResponse, shape (b, f).

        Gains [N m/rad, N m s/rad] are scalars or of shape (b,); without the amplitude of the
        command [rad] friction is left out.
        """
        kp, kd = (
            np.array(gain, dtype=np.float64, ndmin=1)[:, None] for gain in (stiffness, damping)
        )
        # The sampled command is a staircase of physics steps; take that hold out.
        half = self.omega * self.timestep / 2.0
        hold = np.exp(-1j * half) * np.sinc(half / np.pi)
        after = self.speed * np.exp(1j * self.omega * self.timestep)
        kd = self.law.damping(kp, kd, self.timestep)
        direct = kp * self.position
        open_loop = 1.0 + direct + kd * (self.speed if self.law.kind == "explicit" else after)
        closed = direct / open_loop
        if self.frictionloss > 0.0 and np.isfinite(amplitude):
            # MuJoCo's dry friction is implicit: it opposes the speed at the end of the step. The
            # amplitude `x` of that speed solves `|x open_loop + relay after| = forced`.
            relay = 4.0 * self.frictionloss / np.pi
            forced = amplitude * self.omega * np.abs(direct)
            square = open_loop.real**2 + open_loop.imag**2
            half = relay * (open_loop.real * after.real + open_loop.imag * after.imag)
            rest = square * ((relay * np.abs(after)) ** 2 - forced**2)
            speed = (np.sqrt(np.maximum(half**2 - rest, 0.0)) - half) / square
            closed = direct / (open_loop + relay / np.maximum(speed, 1e-9) * after)
        return np.asarray(closed / hold)

    def slope(self, stiffness: float, damping: float, *, amplitude: float) -> Array:
        """Derivative of the log gain by the log of stiffness and of damping, shape (f, 2)."""
        near = np.exp(np.log([stiffness, damping]) + _STEP * np.array([[0, 0], [1, 0], [0, 1]]))
        logs = np.log(np.abs(self.response(near[:, 0], near[:, 1], amplitude=amplitude)))
        return np.asarray((logs[1:] - logs[0]).T / _STEP)


def plant(rig: JointTestRig, pose: Array, omega: Array) -> Plant:
    """Linearize a rig about the pose of its chain [rad], at frequencies `omega` [rad/s]."""
    # The excited joint takes a torque in place of its drive, and has no dry friction.
    model, i = copy.copy(rig.model), rig.actuator
    model.actuator_gaintype[i] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[i] = mujoco.mjtBias.mjBIAS_NONE
    model.actuator_dyntype[i] = mujoco.mjtDyn.mjDYN_NONE
    model.actuator_gainprm[i] = np.eye(model.actuator_gainprm.shape[1])[0]
    model.actuator_ctrllimited[i] = model.actuator_forcelimited[i] = False
    model.dof_frictionloss[rig.index] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    data.ctrl[:] = rig.control(pose)
    mujoco.mj_forward(model, data)
    # Hold the joint against gravity, so that the linearization is about rest.
    data.ctrl[i] = data.qfrc_bias[rig.index]
    nx = 2 * model.nv + model.na
    a, b = np.zeros((nx, nx)), np.zeros((nx, model.nu))
    mujoco.mjd_transitionFD(model, data, _EPS, True, a, b, None, None)
    z = np.exp(1j * omega * model.opt.timestep)[:, None, None]
    states = np.linalg.solve(z * np.eye(nx) - a, b[:, i, None])[..., 0]
    return Plant(
        omega=omega,
        position=states[:, rig.index],
        speed=states[:, model.nv + rig.index],
        timestep=float(model.opt.timestep),
        frictionloss=float(rig.model.dof_frictionloss[rig.index]),
        law=rig.robot.law,
    )
