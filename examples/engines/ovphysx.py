"""ovphysx (PhysX 5, TGS): drives with a number of position iterations, or explicit torques.

    python -m venv physx && physx/bin/pip install ovphysx physx-usd-schemas
    pronk match LOGS --robot ROBOT --simulator examples/engines/ovphysx.py:drive \
        --simulator-python physx/bin/python

It is the PhysX of Isaac Lab 3.0, on the processor in single precision here, in another Python. The
package `physx-usd-schemas`, which defines the settings of PhysX in USD, must be installed beside
it. As in Isaac Lab, forces act once a step, and there are no velocity iterations. Dry friction is
not used, as it differs from MuJoCo's by the law. Law I of `pronk.robots.drive_law` holds for one
joint; in a chain, PhysX solves joint by joint.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import ovphysx
import ovstage
from ovphysx.samples.python_samples import schema_support

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links, along_x, principal, quaternion
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

SCENE = """#usda 1.0
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
LINK = """
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

    package = "ovphysx"
    laws = ("explicit", "implicit")

    def __init__(self, robot: RobotSpec, *, law: DriveLaw | None = None) -> None:
        """See `EngineSimulator`; PronkError also where `physx-usd-schemas` is missing."""
        super().__init__(robot, law=law)
        self.physx = started_physx()

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        stage = ovstage.Stage("pronk")
        ovstage.population.open_usd_from_string(
            stage,
            usd(links, self.law.iterations),
            ordinal=1,
            domains=ovstage.PopulationDomain.ALL,
        )
        stage.advance_write_floor(ordinal=1).wait()
        self.physx.wait_task(self.physx.attach_ovstage(stage, read_ordinal=1))
        try:
            self.physx.warmup()
            return self._stepped(drives, command, start)
        finally:
            self.physx.wait_task(self.physx.detach_ovstage())
            stage.destroy()

    def _stepped(self, drives: EngineDrives, command: Array, start: Array) -> Array:
        """Set the drives and step the attached scene; see `EngineSimulator.simulate`."""
        explicit = self.law.kind == "explicit"
        # Passive damping is a drive too: PhysX takes both implicitly.
        stiffness = np.zeros(len(start))
        damping = drives.viscous_damping
        if not explicit:
            stiffness = drives.stiffness
            damping = drives.damping + drives.viscous_damping
            # With explicit torques it would limit the sum of torque and passive damping.
            Column(self.physx, "MAX_FORCE").write(drives.effort_limit)
        Column(self.physx, "STIFFNESS").write(stiffness)
        Column(self.physx, "DAMPING").write(damping)
        Column(self.physx, "ARMATURE").write(drives.armature)
        position = Column(self.physx, "POSITION")
        position.write(start)
        speed = Column(self.physx, "VELOCITY")
        speed.write(np.zeros(len(start)))
        control = Column(self.physx, "ACTUATION_FORCE" if explicit else "POSITION_TARGET")
        positions = np.empty(command.shape)
        for step, target in enumerate(command):
            positions[step] = position.read()
            if explicit:
                control.write(drives.torque(target, positions[step], speed.read()))
            else:
                control.write(target)
            self.physx.step_sync(self.robot.timestep_s)
        return positions


class Column:
    """One quantity of the joints, in the order of the links; the engine has an order of its own."""

    def __init__(self, physx: Any, name: str) -> None:
        tensor_type = ovphysx.TensorType[f"ARTICULATION_DOF_{name}"]
        self._tensor = physx.create_tensor_binding("/robot", tensor_type=tensor_type)
        self._order = [int(joint.removeprefix("joint")) - 1 for joint in self._tensor.dof_names]
        # The array is kept, as another one for each step takes longer.
        self._values = np.empty(self._tensor.shape, np.float32)

    def read(self) -> Array:
        """Return the values of the joints, shape (n,)."""
        self._tensor.read(self._values)
        values = np.empty(len(self._order))
        values[self._order] = self._values[0]
        return values

    def write(self, values: Array) -> None:
        """Set the values of the joints, shape (n,)."""
        self._values[0] = values[self._order]
        self._tensor.write(self._values)


@cache
def started_physx() -> Any:
    """Start PhysX, once a process, as ending it takes 0.1 s."""
    try:
        ovstage.population.register_usd_schemas(schema_support.physx_schema_paths())
    except FileNotFoundError:
        raise PronkError(
            "ovphysx needs the package physx-usd-schemas; pip install it in the same Python."
        ) from None
    ovphysx.set_global_config(ovphysx.GlobalConfigKey.CPU_ONLY, True)
    # With threads, one robot takes 20 times as long.
    ovphysx.set_global_config(ovphysx.GlobalConfigKey.NUM_THREADS, 0)
    return ovphysx.PhysX()


def usd(links: Links, iterations: int) -> str:
    """Write a chain on a fixed base as USD; drives are set later, as its gains are per degree."""
    # Body 0 is the base, body k + 1 is link k.
    hinge = np.zeros((len(links.joints) + 1, 3))
    parts = []
    for link, parent in enumerate(links.parent):
        hinge[link + 1] = hinge[parent + 1] + links.offset[link]
        moments, axes = principal(links.inertia[link])
        parts.append(
            LINK.format(
                body=link + 1,
                parent=parent + 1,
                at=usd_tuple(hinge[link + 1]),
                mass=links.mass[link],
                centre=usd_tuple(links.centre[link]),
                moments=usd_tuple(moments),
                axes=usd_tuple(quaternion(axes)),
                offset=usd_tuple(links.offset[link]),
                turn=usd_tuple(quaternion(along_x(links.axis[link]))),
            )
        )
    gravity = float(np.linalg.norm(links.gravity))
    down = np.array([0.0, 0.0, -1.0])
    if gravity > 0.0:
        down = links.gravity / gravity
    return SCENE.format(
        down=usd_tuple(down), gravity=gravity, iterations=iterations, links="".join(parts)
    )


def usd_tuple(values: Iterable[float]) -> str:
    """Write numbers as a tuple of USD."""
    return f"({', '.join(str(float(value)) for value in values)})"


def drive(robot: RobotSpec) -> OvPhysx:
    """Make joints with drives of the 4 position iterations of Isaac Lab's robots."""
    return OvPhysx(robot, law=DriveLaw(kind="implicit", iterations=4))


def torque(robot: RobotSpec) -> OvPhysx:
    """Make joints with explicit torques."""
    return OvPhysx(robot, law=DriveLaw())
