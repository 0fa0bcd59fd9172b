"""MuJoCo of any version, and MJX: position actuators with Euler (law E) or implicitfast (IF).

Actuators have the effort limit, not the torque-speed line. Passive damping is implicit; with Euler,
flag eulerdamp turned off makes it explicit where the law has it so.
Unlike `pronk.identify.simulators.mujoco` it needs no robot's model, so it also runs in another
Python.
"""

from __future__ import annotations

import importlib
from functools import cache, partial
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links
from pronk.robots.drive_law import DriveLaw


class Mujoco(EngineSimulator):
    """Laws explicit and implicit_damping, in MuJoCo."""

    extra, module, package = "", "mujoco", "mujoco"
    laws = dry = ("explicit", "implicit_damping")

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        mujoco: Any = importlib.import_module("mujoco")
        spec = mujoco.MjSpec()
        spec.option.timestep = self.robot.timestep_s
        spec.option.gravity = links.gravity
        explicit = self.law.kind == "explicit"
        names = mujoco.mjtIntegrator
        spec.option.integrator = names.mjINT_EULER if explicit else names.mjINT_IMPLICITFAST
        if self.law.passive_damping == "explicit":
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        bodies: list[Any] = []
        for i, (name, up) in enumerate(zip(links.joints, links.parent, strict=True)):
            body = (bodies[up] if up >= 0 else spec.worldbody).add_body(pos=links.offset[i])
            body.explicitinertial = True
            body.mass, body.ipos = links.mass[i], links.centre[i]
            body.fullinertia = links.inertia[i][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            joint = body.add_joint(name=name, axis=links.axis[i], armature=drives.armature[i])
            joint.frictionloss = drives.frictionloss[i]
            joint.damping = drives.viscous_damping[i] * np.eye(len(joint.damping))[0]
            actuator = spec.add_actuator(
                name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
            )
            actuator.forcerange = drives.effort_limit[i] * np.array([-1.0, 1.0])
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.gainprm[0] = drives.stiffness[i]
            actuator.biasprm[:3] = [0.0, -drives.stiffness[i], -drives.damping[i]]
            bodies.append(body)
        return self._stepped(spec.compile(), command, start)

    def _stepped(self, model: Any, command: Array, start: Array) -> Array:
        """Positions at the start of each step; joints and actuators are in the links' order."""
        data = self.engine.MjData(model)
        data.qpos[:] = start
        out = np.empty(command.shape)
        for row, target in zip(out, command, strict=True):
            row[:], data.ctrl[:] = data.qpos, target
            self.engine.mj_step(model, data)
        return out


class Mjx(Mujoco):
    """The same in MJX, in double precision."""

    extra, module, package = "mjx", "mujoco.mjx", "mujoco-mjx"

    def _stepped(self, model: Any, command: Array, start: Array) -> Array:
        jax: Any = importlib.import_module("jax")
        jax.config.update("jax_enable_x64", True)
        data = self.engine.make_data(model).replace(qpos=jax.numpy.array(start))
        return np.array(_mjx_run()(self.engine.put_model(model), data, jax.numpy.array(command)))


@cache
def _mjx_run() -> Any:
    """The whole run, compiled once for all values of a chain."""
    jax: Any = importlib.import_module("jax")
    mjx: Any = importlib.import_module("mujoco.mjx")

    def run(model: Any, data: Any, command: Any) -> Any:
        def step(data: Any, target: Any) -> Any:
            return mjx.step(model, data.replace(ctrl=target)), data.qpos

        return jax.lax.scan(step, data, command)[1]

    return jax.jit(run)


position, mjx_position = (partial(e, law=DriveLaw(kind="implicit_damping")) for e in (Mujoco, Mjx))
"""Position actuators with implicitfast (law IF)."""
