"""Newton: joint drives in the solvers MuJoCo (law IF), Featherstone (E) and Steel (I1).

Newton needs MuJoCo 3.17, pronk 3.11, so it runs in another Python (`--simulator-python`), on the
processor in single precision. Featherstone and Steel take passive damping explicitly
(`DriveLaw.passive_damping`; no law here has it with I1) and are used without dry friction.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links
from pronk.robots.drive_law import DriveLaw

_SOLVERS: dict[str, tuple[str, dict[str, Any]]] = {
    "explicit": ("SolverFeatherstone", {"angular_damping": 0.0}),
    "implicit_damping": (
        "SolverMuJoCo",
        {"integrator": "implicitfast", "use_mujoco_cpu": True, "disable_contacts": True},
    ),
    "implicit": ("SolverSteel", {}),
}
"""Solver of each law, and its options."""


class Newton(EngineSimulator):
    """The solver whose drives follow the law."""

    extra, module, package = "", "newton", "newton"
    laws, dry = tuple(_SOLVERS), ("implicit_damping",)

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        newton = self.engine
        builder = newton.ModelBuilder(gravity=tuple(links.gravity.tolist()))
        bodies: list[int] = []
        joints: list[int] = []
        for i, (name, up) in enumerate(zip(links.joints, links.parent, strict=True)):
            body = builder.add_link(
                com=links.centre[i].tolist(),
                inertia=links.inertia[i].ravel().tolist(),
                mass=float(links.mass[i]),
                label=f"{name} link",
                lock_inertia=True,
            )
            joints.append(
                builder.add_joint_revolute(
                    *(bodies[up] if up >= 0 else -1, body),
                    parent_xform=(*links.offset[i].tolist(), 0.0, 0.0, 0.0, 1.0),
                    axis=links.axis[i].tolist(),
                    target_ke=float(drives.stiffness[i]),
                    target_kd=float(drives.damping[i]),
                    damping=float(drives.viscous_damping[i]),
                    armature=float(drives.armature[i]),
                    effort_limit=float(drives.effort_limit[i]),
                    friction=float(drives.frictionloss[i]),
                    actuator_mode=newton.JointTargetMode.POSITION,
                    label=name,
                )
            )
            bodies.append(body)
        builder.add_articulation(joints)
        builder.joint_q = start.tolist()
        model = builder.finalize(device="cpu")
        name, options = _SOLVERS[self.law.kind]
        solver = getattr(newton.solvers, name)(model, **options)
        now, after, control = model.state(), model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, now)
        out = np.empty(command.shape)
        for row, target in zip(out, command, strict=True):
            row[:] = now.joint_q.numpy()
            control.joint_target_q.assign(target.astype(np.float32))
            solver.step(now, after, control, None, self.robot.timestep_s)
            now, after = after, now
        return out


solver = partial(Newton, law=DriveLaw(kind="implicit_damping"))
"""Drives in SolverMuJoCo."""
featherstone, steel = (partial(Newton, law=DriveLaw(kind=k)) for k in ("explicit", "implicit"))
