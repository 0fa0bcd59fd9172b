"""MJX and MuJoCo of any version: position actuators with Euler (law E) or implicitfast (IF).

    pip install mujoco-mjx
    pronk match LOGS --robot ROBOT --simulator examples/engines/mjx.py:Mjx

Actuators have the effort limit, not the torque-speed line. Passive damping is implicit; with Euler,
flag eulerdamp turned off makes it explicit where the law has it so. Unlike
`pronk.identify.simulators.mujoco` this needs no model of the robot, so it also runs in another
Python, with another MuJoCo. MJX computes in double precision here.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec


class Mujoco(EngineSimulator):
    """Laws explicit and implicit_damping, in MuJoCo."""

    package = "mujoco"
    laws = ("explicit", "implicit_damping")
    friction_laws = ("explicit", "implicit_damping")

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        model = self._model(links, drives)
        data = mujoco.MjData(model)
        data.qpos[:] = start
        positions = np.empty(command.shape)
        for step, target in enumerate(command):
            positions[step] = data.qpos
            data.ctrl[:] = target
            mujoco.mj_step(model, data)
        return positions

    def _model(self, links: Links, drives: EngineDrives) -> Any:
        """Compile a chain; its joints and actuators are in the order of the links."""
        spec = mujoco.MjSpec()
        spec.option.timestep = self.robot.timestep_s
        spec.option.gravity = links.gravity
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if self.law.kind == "explicit":
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        if self.law.passive_damping == "explicit":
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        bodies: list[Any] = []
        for link, name in enumerate(links.joints):
            parent = spec.worldbody
            if links.parent[link] >= 0:
                parent = bodies[links.parent[link]]
            body = parent.add_body(pos=links.offset[link])
            body.explicitinertial = True
            body.mass = links.mass[link]
            body.ipos = links.centre[link]
            moments = links.inertia[link]
            body.fullinertia = [
                moments[0, 0],
                moments[1, 1],
                moments[2, 2],
                moments[0, 1],
                moments[0, 2],
                moments[1, 2],
            ]
            joint = body.add_joint(name=name, axis=links.axis[link], armature=drives.armature[link])
            joint.frictionloss = drives.frictionloss[link]
            # Later versions of MuJoCo have an array here, whose first value is the linear damping.
            joint.damping = drives.viscous_damping[link] * np.eye(len(joint.damping))[0]
            actuator = spec.add_actuator(
                name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
            )
            actuator.forcerange = [-drives.effort_limit[link], drives.effort_limit[link]]
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.gainprm[0] = drives.stiffness[link]
            actuator.biasprm[:3] = [0.0, -drives.stiffness[link], -drives.damping[link]]
            bodies.append(body)
        return spec.compile()


class Mjx(Mujoco):
    """The same in MJX."""

    package = "mujoco-mjx"

    def __init__(self, robot: RobotSpec, *, law: DriveLaw | None = None) -> None:
        """See `EngineSimulator`; PronkError also where MJX is not installed."""
        try:
            import jax
            import mujoco.mjx as mjx
        except ImportError as error:
            raise PronkError(
                f"MJX cannot be imported ({error}); pip install mujoco-mjx, or name a Python that "
                "has it with --simulator-python."
            ) from None
        super().__init__(robot, law=law)
        jax.config.update("jax_enable_x64", True)
        self._jax: Any = jax
        self._mjx: Any = mjx

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        model = self._model(links, drives)
        numpy = self._jax.numpy
        data = self._mjx.make_data(model).replace(qpos=numpy.array(start))
        run = compiled_run(self._jax, self._mjx)
        return np.array(run(self._mjx.put_model(model), data, numpy.array(command)))


@cache
def compiled_run(jax: Any, mjx: Any) -> Any:
    """Return a whole run, compiled once for all parameters of a chain."""

    def run(model: Any, data: Any, command: Any) -> Any:
        def step(data: Any, target: Any) -> Any:
            return mjx.step(model, data.replace(ctrl=target)), data.qpos

        return jax.lax.scan(step, data, command)[1]

    return jax.jit(run)


def position(robot: RobotSpec) -> Mujoco:
    """Make joints of MuJoCo with position actuators and implicitfast (law IF)."""
    return Mujoco(robot, law=DriveLaw(kind="implicit_damping"))


def mjx_position(robot: RobotSpec) -> Mjx:
    """Make joints of MJX with position actuators and implicitfast (law IF)."""
    return Mjx(robot, law=DriveLaw(kind="implicit_damping"))
