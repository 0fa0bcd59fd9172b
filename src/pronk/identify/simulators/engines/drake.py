"""Drake, discrete with the SAP solver: `PdControllerGains` (law I1), or the actuation port (E)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.engines.engine import Drives, EngineSimulator
from pronk.identify.simulators.engines.links import Links
from pronk.robots.drive_law import DriveLaw


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
            inertia = drake.SpatialInertia.MakeFromCentralInertia(
                links.mass[i],
                links.centre[i],
                drake.RotationalInertia(*np.diag(moments), *moments[[0, 0, 1], [1, 2, 2]]),
            )
            body = plant.AddRigidBody(f"{name} link", instance, inertia)
            parent = bodies[up] if up >= 0 else plant.world_body()
            place = drake.RigidTransform(links.offset[i])
            at = plant.AddFrame(drake.FixedOffsetFrame(f"{name} hinge", parent, place))
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
        plant.SetPositions(context, start[np.argsort(places)])
        if explicit:
            port, value = plant.get_actuation_input_port(instance), np.zeros(len(joints))
        else:
            port, value = plant.get_desired_state_input_port(instance), np.zeros(2 * len(joints))
        fixed = port.FixValue(context, value)
        out = np.empty(command.shape)
        for row, target in zip(out, command, strict=True):
            row[:] = plant.GetPositions(context)[places]
            speed = plant.GetVelocities(context)[places]
            value[: len(joints)] = drives.torque(target, row, speed) if explicit else target
            fixed.GetMutableData().get_mutable_value().SetFromVector(value)
            after = plant.EvalUniquePeriodicDiscreteUpdate(context)
            # Taking the mutable state, each step, marks what depends on it as changed.
            context.get_mutable_discrete_state().SetFrom(after)
        return out


drive = partial(Drake, law=DriveLaw(kind="implicit"))
"""Drives with `PdControllerGains`."""
