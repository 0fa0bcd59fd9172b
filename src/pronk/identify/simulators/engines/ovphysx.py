"""ovphysx (PhysX 5, TGS): drives with a number of position iterations, or explicit torques.

It is the PhysX of Isaac Lab 3.0, on the processor in single precision here, in another Python
(`--simulator-python`). The package `physx-usd-schemas`, which defines the settings of PhysX in
USD, must be installed beside it. As in Isaac Lab, forces act once a step, and there are no
velocity iterations. Dry friction is not used, as it differs from MuJoCo's by the law. Law I of
`pronk.robots.drive_law` holds for one joint; in a chain, PhysX solves joint by joint.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from functools import cache, partial
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links, along_x, principal, quaternion
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

_SCENE = """#usda 1.0
(
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
)
def PhysicsScene "scene" (prepend apiSchemas = ["PhysxSceneAPI"])
{{
    vector3f physics:gravityDirection = {down}
    float physics:gravityMagnitude = {gravity}
    bool physxScene:enableExternalForcesEveryIteration = 0
    bool physxScene:disableSleeping = 1
    bool physxScene:enableGPUDynamics = 0
    token physxScene:broadphaseType = "MBP"
}}
def Xform "robot" (prepend apiSchemas = ["PhysicsArticulationRootAPI", "PhysxArticulationAPI"])
{{
    int physxArticulation:solverPositionIterationCount = {iterations}
    int physxArticulation:solverVelocityIterationCount = 0
    def Xform "body0" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])
    {{
        float physics:mass = 1
        float3 physics:diagonalInertia = (1, 1, 1)
    }}
    def PhysicsFixedJoint "fixed"
    {{
        rel physics:body1 = </robot/body0>
    }}
{links}}}
"""
"""A scene with a robot, whose base is body 0."""
_LINK = """
    def Xform "body{body}" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysxRigidBodyAPI"]
    )
    {{
        double3 xformOp:translate = {at}
        uniform token[] xformOpOrder = ["xformOp:translate"]
        float physics:mass = {mass}
        point3f physics:centerOfMass = {centre}
        float3 physics:diagonalInertia = {moments}
        quatf physics:principalAxes = {axes}
        float physxRigidBody:angularDamping = 0
        float physxRigidBody:maxAngularVelocity = 1e6
    }}
    def PhysicsRevoluteJoint "joint{body}" (prepend apiSchemas = ["PhysicsDriveAPI:angular"])
    {{
        rel physics:body0 = </robot/body{parent}>
        rel physics:body1 = </robot/body{body}>
        token physics:axis = "X"
        float physics:lowerLimit = -1e6
        float physics:upperLimit = 1e6
        point3f physics:localPos0 = {offset}
        quatf physics:localRot0 = {turn}
        quatf physics:localRot1 = {turn}
    }}
"""
"""A link and its joint. Speed [deg/s] and angles [deg] are limited above those of every joint.

A joint without limits would wrap at 360 degrees.
"""


class OvPhysx(EngineSimulator):
    """Laws explicit (actuation force), and implicit with 1 or more position iterations (drive)."""

    extra, module, package = "", "ovphysx", "ovphysx"
    laws = ("explicit", "implicit")

    def __init__(self, robot: RobotSpec, *, law: DriveLaw | None = None) -> None:
        """See `EngineSimulator`; PronkError also where `physx-usd-schemas` is missing."""
        super().__init__(robot, law=law)
        self.physx, self.ovstage = _started(self.engine)

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        stage = self.ovstage.Stage("pronk")
        text, every = usd(links, self.law.iterations), self.ovstage.PopulationDomain.ALL
        self.ovstage.population.open_usd_from_string(stage, text, ordinal=1, domains=every)
        stage.advance_write_floor(ordinal=1).wait()
        self.physx.wait_task(self.physx.attach_ovstage(stage, read_ordinal=1))
        try:
            self.physx.warmup()
            return self._run(drives, command, start)
        finally:
            self.physx.wait_task(self.physx.detach_ovstage())
            stage.destroy()

    def _run(self, drives: Drives, command: Array, start: Array) -> Array:
        """Set the drives and step the attached scene; see `EngineSimulator.simulate`."""

        def column(name: str) -> _Column:
            kind = self.engine.TensorType[f"ARTICULATION_DOF_{name}"]
            return _Column(self.physx.create_tensor_binding("/robot", tensor_type=kind))

        explicit = self.law.kind == "explicit"
        # Passive damping is a drive too: PhysX takes both implicitly.
        active = 0.0 if explicit else 1.0
        column("STIFFNESS").write(active * drives.stiffness)
        column("DAMPING").write(active * drives.damping + drives.viscous_damping)
        column("ARMATURE").write(drives.armature)
        if not explicit:  # It would limit the sum of torque and passive damping.
            column("MAX_FORCE").write(drives.effort_limit)
        position, speed = column("POSITION"), column("VELOCITY")
        position.write(start)
        speed.write(np.zeros(len(start)))
        control = column("ACTUATION_FORCE" if explicit else "POSITION_TARGET")
        out = np.empty(command.shape)
        for row, target in zip(out, command, strict=True):
            row[:] = position.read()
            control.write(drives.torque(target, row, speed.read()) if explicit else target)
            self.physx.step_sync(self.robot.timestep_s)
        return out


class _Column:
    """One quantity of the joints, in the order of the links; the engine has an order of its own."""

    def __init__(self, tensor: Any) -> None:
        self._tensor = tensor
        self._order = [int(name.removeprefix("joint")) - 1 for name in tensor.dof_names]
        self._values = np.empty(tensor.shape, np.float32)  # Kept: another one takes longer.

    def read(self) -> Array:
        self._tensor.read(self._values)
        out = np.empty(len(self._order))
        out[self._order] = self._values[0]
        return out

    def write(self, values: Array) -> None:
        self._values[0] = values[self._order]
        self._tensor.write(self._values)


@cache
def _started(engine: Any) -> tuple[Any, Any]:
    """PhysX and the module of its stages; once a process, as ending PhysX takes 0.1 s."""
    stages = importlib.import_module("ovstage")
    support = importlib.import_module("ovphysx.samples.python_samples.schema_support")
    try:
        stages.population.register_usd_schemas(support.physx_schema_paths())
    except FileNotFoundError:
        raise PronkError(
            "ovphysx needs the package physx-usd-schemas; pip install it in the same Python."
        ) from None
    engine.set_global_config(engine.GlobalConfigKey.CPU_ONLY, True)
    # With threads, one robot takes 20 times as long.
    engine.set_global_config(engine.GlobalConfigKey.NUM_THREADS, 0)
    return engine.PhysX(), stages


def usd(links: Links, iterations: int) -> str:
    """A chain on a fixed base as USD text; drives are set later, as its gains are per degree."""

    def text(values: Iterable[float]) -> str:
        return f"({', '.join(str(float(value)) for value in values)})"

    hinge = np.zeros((len(links.joints) + 1, 3))
    parts = []
    for i, parent in enumerate(links.parent):
        hinge[i + 1] = hinge[parent + 1] + links.offset[i]
        moments, axes = principal(links.inertia[i])
        parts.append(
            _LINK.format(
                body=i + 1,
                parent=parent + 1,
                at=text(hinge[i + 1]),
                mass=links.mass[i],
                centre=text(links.centre[i]),
                moments=text(moments),
                axes=text(quaternion(axes)),
                offset=text(links.offset[i]),
                turn=text(quaternion(along_x(links.axis[i]))),
            )
        )
    gravity = float(np.linalg.norm(links.gravity))
    return _SCENE.format(
        down=text(links.gravity / gravity if gravity else (0.0, 0.0, -1.0)),
        gravity=gravity,
        iterations=iterations,
        links="".join(parts),
    )


drive = partial(OvPhysx, law=DriveLaw(kind="implicit", iterations=4))
"""Drives with the 4 position iterations of Isaac Lab's robots."""
