"""The robot on a plane, as mjlab simulates it: entity, contact sensors, solver."""

from __future__ import annotations

from functools import partial

import mujoco
from mjlab.actuator import DcMotorActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.scene import SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec

BODY = legged("mini_cheetah")

FEET = tuple(f"{leg}_foot" for leg in BODY.legs)
"""Foot sites, in the order of every tensor of feet (FR, FL, HR, HL)."""
FOOT_GEOMS = tuple(f"{leg}_foot_collision" for leg in BODY.legs)
_LIMB_GEOMS = (
    "trunk_collision",
    *(f"{leg}_{link}_collision" for leg in BODY.legs for link in ("thigh", "shank")),
)


FOOT_CONTACT = (0.0105, 1.0)
"""Time constant [s] and damping ratio of a foot on the ground. MuJoCo's .02 lets the feet of a
landing robot sink by 19 to 28 mm, so that its shanks touch the floor; less than twice the physics
step MuJoCo does not take."""


def robot_entity(robot: RobotSpec, actuators: tuple[DcMotorActuatorCfg, ...]) -> EntityCfg:
    """The free robot in its default pose, with the drives of training.

    Args:
        robot: Which robot.
        actuators: Drives, from `pronk.train.mdp.drives.actuators`.
    """
    return EntityCfg(
        spec_fn=partial(_on_firm_feet, robot),
        init_state=EntityCfg.InitialStateCfg(
            pos=(0.0, 0.0, BODY.standing_height),
            joint_pos={joint.name: joint.default_position for joint in robot.joints},
            joint_vel={".*": 0.0},
        ),
        articulation=EntityArticulationInfoCfg(actuators=actuators),
        sort_actuators=True,
    )


def _on_firm_feet(robot: RobotSpec) -> mujoco.MjSpec:
    spec = robot.build_spec()
    for name in FOOT_GEOMS:
        spec.geom(name).solref = FOOT_CONTACT
    return spec


def scene(entity: EntityCfg, num_envs: int) -> SceneCfg:
    """The robot on a plane, with sensors `feet` (force and contact) and `limbs` (contact).

    Args:
        entity: From `robot_entity`.
        num_envs: How many robots, each in a world of its own.
    """
    ground = ContactMatch(mode="body", pattern="terrain")
    feet = ContactSensorCfg(
        name="feet",
        primary=ContactMatch(mode="geom", pattern=FOOT_GEOMS, entity="robot"),
        secondary=ground,
        fields=("found", "force"),
        reduce="netforce",
    )
    limbs = ContactSensorCfg(
        name="limbs",
        primary=ContactMatch(mode="geom", pattern=_LIMB_GEOMS, entity="robot"),
        secondary=ground,
        fields=("found",),
        reduce="none",
    )
    return SceneCfg(
        terrain=TerrainEntityCfg(terrain_type="plane"),
        entities={"robot": entity},
        sensors=(feet, limbs),
        num_envs=num_envs,
        extent=2.0,
    )


def simulation(robot: RobotSpec) -> SimulationCfg:
    """The training simulator: MuJoCo Warp at the timestep that gains are matched for."""
    return SimulationCfg(
        # At most 4 feet, 8 limb capsules with two points each and 4 trunk corners touch; each
        # point of condim 3 has three constraint rows, each joint a friction and a limit row.
        nconmax=24,
        njmax=104,
        mujoco=MujocoCfg(
            timestep=robot.timestep_s,
            integrator="implicitfast",
            # Elliptic, because the softness of a pyramid grows with the square of its friction:
            # with the 3.0 of D2 a standing robot sinks 2 cm into the floor.
            cone="elliptic",
            impratio=10.0,
            iterations=10,
            ls_iterations=20,
        ),
    )
