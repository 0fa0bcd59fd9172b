"""Drake, discrete with the SAP solver: `PdControllerGains` (law I1), or the actuation port (E)."""

from __future__ import annotations

from typing import Any

import numpy as np

from pronk.actuator.law import DriveLaw
from pronk.arrays import Array
from pronk.robots.robot import RobotSpec
from pronk.simulators.engines.engine import Drives, EngineSimulator
from pronk.simulators.engines.links import Links


class Drake(EngineSimulator):
    """Laws explicit, and implicit with one iteration; Drake's joints have no dry friction."""

    extra, module, package = "drake", "pydrake.all", "drake"
    laws = ("explicit", "implicit")

    def simulate(self, links: Links, drives: Drives, command: Array, start: Array) -> Array:
        """See `EngineSimulator.simulate`."""
        drake, explicit = self.engine, self.law.kind == "explicit"
        plant = drake.MultibodyPlant(time_step=self.robot.timestep_s)
        plant.set_discrete_contact_approximation(drake.DiscreteContactApproximation.kSap)
        plant.SetUseSampledOutputPorts(False)
        plant.mutable_gravity_field().set_gravity_vector(links.gravity)
        instance = plant.AddModelInstance("chain")
        bodies: list[Any] = []
        joints: list[Any] = []
        for i, (name, up) in enumerate(zip(links.joints, links.parent, strict=True)):
            moments = links.inertia[i]
            body = plant.AddRigidBody(
                f"{name} link",
                instance,
                drake.SpatialInertia.MakeFromCentralInertia(
                    links.mass[i],
                    links.centre[i],
                    drake.RotationalInertia(*np.diag(moments), *moments[[0, 0, 1], [1, 2, 2]]),
                ),
            )
            parent = bodies[up] if up >= 0 else plant.world_body()
            at = plant.AddFrame(
                drake.FixedOffsetFrame(
                    f"{name} hinge", parent, drake.RigidTransform(links.offset[i])
                )
            )
            joint = plant.AddJoint(
                drake.RevoluteJoint(
                    name, at, body.body_frame(), links.axis[i], drives.viscous_damping[i]
                )
            )
            actuator = plant.AddJointActuator(name, joint, effort_limit=drives.effort_limit[i])
            actuator.set_default_rotor_inertia(drives.armature[i])
            actuator.set_default_gear_ratio(1.0)
            if not explicit:
                gains = {"p": drives.stiffness[i], "d": drives.damping[i]}
                actuator.set_controller_gains(drake.PdControllerGains(**gains))
            bodies.append(body)
            joints.append(joint)
        plant.Finalize()
        context = plant.CreateDefaultContext()
        places = [joint.position_start() for joint in joints]
        count = len(joints)
        position, speed, value = np.empty(count), np.empty(count), np.zeros(count)
        position[places] = start
        plant.SetPositions(context, position)
        port = (
            plant.get_actuation_input_port(instance)
            if explicit
            else plant.get_desired_state_input_port(instance)
        )
        fixed = port.FixValue(context, np.zeros(count if explicit else 2 * count))
        out = np.empty(command.shape)
        for row, target in zip(out, command, strict=True):
            position = plant.GetPositions(context)
            speed = plant.GetVelocities(context)
            row[:] = position[places]
            value[:] = drives.torque(target, row, speed[places]) if explicit else target
            data = value if explicit else np.concatenate([value, np.zeros(count)])
            fixed.GetMutableData().get_mutable_value().SetFromVector(data)
            after = plant.EvalUniquePeriodicDiscreteUpdate(context)
            # Taking the mutable state, each step, marks what depends on it as changed.
            context.get_mutable_discrete_state().SetFrom(after)
        return out


def drive(robot: RobotSpec) -> Drake:
    """Drives with `PdControllerGains`."""
    return Drake(robot, law=DriveLaw(kind="implicit"))
