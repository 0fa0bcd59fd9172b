"""Drake, discrete with the SAP solver: `PdControllerGains` (law I1), or the actuation port (E).

    pip install drake
    pronk match LOGS --robot ROBOT --simulator examples/engines/drake.py:drive

Drake's joints have no dry friction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pydrake.all as pydrake

from pronk.arrays import Array
from pronk.identify.simulators.engine import EngineDrives, EngineSimulator
from pronk.identify.simulators.links import Links
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec


class Drake(EngineSimulator):
    """Laws explicit, and implicit with one iteration."""

    package = "drake"
    laws = ("explicit", "implicit")

    def simulate(self, links: Links, drives: EngineDrives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        explicit = self.law.kind == "explicit"
        plant, instance, joints = self._plant(links, drives)
        context = plant.CreateDefaultContext()
        # Drake has an order of its own: `places[link]` is where the joint of a link stands in it.
        places = [joint.position_start() for joint in joints]
        plant.SetPositions(context, start[np.argsort(places)])
        if explicit:
            port = plant.get_actuation_input_port(instance)
            value = np.zeros(len(joints))
        else:
            port = plant.get_desired_state_input_port(instance)
            value = np.zeros(2 * len(joints))
        fixed = port.FixValue(context, value)
        positions = np.empty(command.shape)
        for step, target in enumerate(command):
            positions[step] = plant.GetPositions(context)[places]
            if explicit:
                speed = plant.GetVelocities(context)[places]
                value[:] = drives.torque(target, positions[step], speed)
            else:
                value[: len(joints)] = target
            fixed.GetMutableData().get_mutable_value().SetFromVector(value)
            after = plant.EvalUniquePeriodicDiscreteUpdate(context)
            # Taking the mutable state, each step, marks what depends on it as changed.
            context.get_mutable_discrete_state().SetFrom(after)
        return positions

    def _plant(self, links: Links, drives: EngineDrives) -> tuple[Any, Any, list[Any]]:
        """Build a chain; returns the plant, its model instance and the joints of the links."""
        plant = pydrake.MultibodyPlant(time_step=self.robot.timestep_s)
        plant.set_discrete_contact_approximation(pydrake.DiscreteContactApproximation.kSap)
        plant.SetUseSampledOutputPorts(False)
        plant.mutable_gravity_field().set_gravity_vector(links.gravity)
        instance = plant.AddModelInstance("chain")
        bodies: list[Any] = []
        joints: list[Any] = []
        for link, name in enumerate(links.joints):
            moments = links.inertia[link]
            rotational = pydrake.RotationalInertia(
                moments[0, 0],
                moments[1, 1],
                moments[2, 2],
                moments[0, 1],
                moments[0, 2],
                moments[1, 2],
            )
            inertia = pydrake.SpatialInertia.MakeFromCentralInertia(
                links.mass[link], links.centre[link], rotational
            )
            body = plant.AddRigidBody(f"{name} link", instance, inertia)
            parent = plant.world_body()
            if links.parent[link] >= 0:
                parent = bodies[links.parent[link]]
            place = pydrake.RigidTransform(links.offset[link])
            hinge = plant.AddFrame(pydrake.FixedOffsetFrame(f"{name} hinge", parent, place))
            joint = plant.AddJoint(
                pydrake.RevoluteJoint(
                    name,
                    hinge,
                    body.body_frame(),
                    links.axis[link],
                    drives.viscous_damping[link],
                )
            )
            actuator = plant.AddJointActuator(name, joint, effort_limit=drives.effort_limit[link])
            actuator.set_default_rotor_inertia(drives.armature[link])
            actuator.set_default_gear_ratio(1.0)
            if self.law.kind != "explicit":
                gains = pydrake.PdControllerGains(p=drives.stiffness[link], d=drives.damping[link])
                actuator.set_controller_gains(gains)
            bodies.append(body)
            joints.append(joint)
        plant.Finalize()
        return plant, instance, joints


def drive(robot: RobotSpec) -> Drake:
    """Make joints with drives of `PdControllerGains`."""
    return Drake(robot, law=DriveLaw(kind="implicit"))


def torque(robot: RobotSpec) -> Drake:
    """Make joints with explicit torques."""
    return Drake(robot, law=DriveLaw())
