"""Newton: joint drives in the solvers MuJoCo (law IF), Featherstone (E) and Steel (I1).

    python -m venv newton && newton/bin/pip install newton
    pronk match LOGS --robot ROBOT --simulator examples/engines/newton.py:drive \
        --simulator-python newton/bin/python

Newton needs MuJoCo 3.17, pronk 3.11, so it runs in another Python, on the processor in single
precision. Featherstone and Steel take passive damping explicitly (`DriveLaw.passive_damping`; no
law here has it with I1) and are used without dry friction.
"""

from __future__ import annotations

from typing import Any

import newton
import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec


class Newton(EngineSimulator):
    """The solver whose drives follow the law."""

    package = "newton"
    laws = ("explicit", "implicit_damping", "implicit")
    friction_laws = ("implicit_damping",)

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        model = self._model(links, drives, start)
        solver = self._solver(model)
        state = model.state()
        next_state = model.state()
        control = model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, state)
        positions = np.empty(command.shape)
        for step, target in enumerate(command):
            positions[step] = state.joint_q.numpy()
            control.joint_target_q.assign(target.astype(np.float32))
            solver.step(state, next_state, control, None, self.robot.timestep_s)
            state, next_state = next_state, state
        return positions

    def _solver(self, model: Any) -> Any:
        """Make the solver of the law."""
        if self.law.kind == "explicit":
            return newton.solvers.SolverFeatherstone(model, angular_damping=0.0)
        if self.law.kind == "implicit_damping":
            return newton.solvers.SolverMuJoCo(
                model, integrator="implicitfast", use_mujoco_cpu=True, disable_contacts=True
            )
        return newton.solvers.SolverSteel(model)

    def _model(self, links: Links, drives: EngineDrives, start: Array) -> Any:
        """Build a chain at its first positions."""
        builder = newton.ModelBuilder(gravity=tuple(links.gravity.tolist()))
        bodies: list[int] = []
        joints: list[int] = []
        for link, name in enumerate(links.joints):
            parent = -1
            if links.parent[link] >= 0:
                parent = bodies[links.parent[link]]
            body = builder.add_link(
                com=links.centre[link].tolist(),
                inertia=links.inertia[link].ravel().tolist(),
                mass=float(links.mass[link]),
                label=f"{name} link",
                lock_inertia=True,
            )
            joint = builder.add_joint_revolute(
                parent,
                body,
                parent_xform=(*links.offset[link].tolist(), 0.0, 0.0, 0.0, 1.0),
                axis=links.axis[link].tolist(),
                target_ke=float(drives.stiffness[link]),
                target_kd=float(drives.damping[link]),
                damping=float(drives.viscous_damping[link]),
                armature=float(drives.armature[link]),
                effort_limit=float(drives.effort_limit[link]),
                friction=float(drives.frictionloss[link]),
                actuator_mode=newton.JointTargetMode.POSITION,
                label=name,
            )
            bodies.append(body)
            joints.append(joint)
        builder.add_articulation(joints)
        builder.joint_q = start.tolist()
        return builder.finalize(device="cpu")


def drive(robot: RobotSpec) -> Newton:
    """Make joints with drives of SolverMuJoCo."""
    return Newton(robot, law=DriveLaw(kind="implicit_damping"))


def featherstone(robot: RobotSpec) -> Newton:
    """Make joints with drives of SolverFeatherstone."""
    return Newton(robot, law=DriveLaw())


def steel(robot: RobotSpec) -> Newton:
    """Make joints with drives of SolverSteel."""
    return Newton(robot, law=DriveLaw(kind="implicit"))
