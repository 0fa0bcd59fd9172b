"""The environment of the jump task, for any quadruped: walk, run and jump on command.

Legs `LEG` with three joints `LEG_*` each (hip roll, hip pitch, knee), foot sites `LEG_foot`, and
collision geoms `trunk_collision`, `LEG_thigh_collision`, `LEG_shank_collision`,
`LEG_foot_collision`. A robot's `env_cfgs.py` calls `jump_env_cfg` and changes what differs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import mujoco
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp import dr
from mjlab.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    TerminationTermCfg,
)
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.scene import SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.terrains import TerrainEntityCfg
from mjlab.viewer import ViewerConfig
from torch import Tensor

from pronk.errors import PronkError
from pronk.jump.train import phases
from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.mdp import actions, commands, events, observations, terminations
from pronk.jump.train.mdp.actuators import drive_cfgs
from pronk.jump.train.mdp.motion import mirror_joints
from pronk.jump.train.tasks.reward_weights import reward_weights
from pronk.jump.train.tasks.robot_scale import robot_scale
from pronk.policy.observation import ACTIONS, HISTORY
from pronk.robots.legged import legged
from pronk.robots.quadruped import require_quadruped
from pronk.robots.robot import RobotSpec

FOOT_CONTACT = (0.0105, 1.0)
"""Time constant [s] and damping ratio of a foot on the ground. With MuJoCo's .02 the feet of a
landing robot sink in by 19 to 28 mm, so that its shanks touch the floor; MuJoCo takes no less than
twice the physics step."""
EPISODE_S = 20.0
"""Longest episode at the nominal policy rate [s]."""
DELAY_STEPS = 1
"""Half-width of the command delay about the matched one [physics steps]. Not in the paper."""
DECIMATION_STEPS = 2
"""Half-width of the number of physics steps of a policy step about the nominal one (D1, A1); less
where a policy step would be left without one."""
LEAST_CONTACT_DAMPING = 0.4
"""Smallest share of the damping of the feet on the ground that is drawn for a robot. Not in the
paper: policies of one contact alone walked 0.04 to 0.30 m/s too fast or too slow at 2 m/s on the
virtual robot, whose contact is another one (docs/evidence/training.md, "Contact drawn in
training")."""


def jump_env_cfg(
    robot: RobotSpec,
    gains: TrainingGains,
    *,
    iterations: Mapping[str, int],
    gain_shape: events.Shape = "box",
    num_envs: int = 4096,
    seed: int = 0,
) -> ManagerBasedRlEnvCfg:
    """Configure the environment of all phases.

    Args:
        robot: The robot.
        gains: Nominal gains, their ranges and the command delay.
        iterations: PPO iterations of each phase.
        gain_shape: Whether gains are drawn in the box or in the ellipsoid of their ranges; those
            by joint are drawn in the ellipse of each joint.
        num_envs: Number of robots.
        seed: Seed of all draws.

    Raises:
        RobotError: The model lacks something that the task reads.
    """
    require_quadruped(robot)
    delay = round(gains.delay_s / robot.timestep_s)
    delay_steps = (max(0, delay - DELAY_STEPS), delay + DELAY_STEPS)
    delay_span = None
    if gains.delay_span_s is not None:
        shortest, longest = (end / robot.timestep_s for end in gains.delay_span_s)
        delay_span = (shortest, longest)
        delay_steps = (math.floor(shortest), math.ceil(longest))
    cfg = ManagerBasedRlEnvCfg(
        seed=seed,
        decimation=robot.decimation,
        scene=_scene(robot, gains, num_envs),
        sim=_simulation(robot),
        observations=_observations(),
        actions={
            actions.NAME: actions.DelayedJointPositionActionCfg(
                entity_name="robot",
                actuator_names=robot.joint_names,
                scale=0.35,
                use_default_offset=True,
                preserve_order=True,
                delay_steps=delay_steps,
                delay_span=delay_span,
            )
        },
        commands={commands.NAME: commands.MotionCommandCfg(robot=robot.source, gains=gains)},
        events=_events(robot, gains, gain_shape),
        rewards=reward_weights(robot_scale(legged(robot.source))),
        terminations={
            "time_out": TerminationTermCfg(
                func=terminations.time_out,
                time_out=True,
                params={"steps": round(EPISODE_S * robot.policy_rate_hz)},
            ),
            # 70 degrees; the trunk's lower face is 5 cm below its centre.
            "fell": TerminationTermCfg(
                func=terminations.fell, params={"tilt_cosine": 0.34, "height": 0.08}
            ),
            "non_finite": TerminationTermCfg(func=terminations.non_finite, params={"speed": 200.0}),
        },
        curriculum={
            phases.NAME: CurriculumTermCfg(
                func=phases.Curriculum,
                params={**iterations, "steps_per_iteration": phases.STEPS_PER_ITERATION},
            )
        },
        episode_length_s=EPISODE_S,
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="robot",
            body_name=robot.base_body,
            distance=2.0,
            elevation=-10.0,
        ),
    )
    set_contact_damping(cfg, LEAST_CONTACT_DAMPING)
    set_decimation_spread(cfg, min(DECIMATION_STEPS, robot.decimation - 1))
    return cfg


def without_randomization(cfg: ManagerBasedRlEnvCfg, *, noise: bool = False) -> None:
    """Leave the nominal robot, undisturbed; starts and commands are still drawn.

    Args:
        cfg: Configuration of the environment, which is changed.
        noise: Whether the noise of measurements, timing and delay stays.
    """
    events_that_stay = ["reset"]
    if noise:
        events_that_stay.append("decimation")
    gains_term = cfg.events.get("gains")
    if gains_term is not None and gains_term.func is events.randomize_drives:
        # Drives are built by group: their joints get gains of their own by this event.
        events_that_stay.append("gains")
        gains_term.params["nominal"] = True
    cfg.events = {name: term for name, term in cfg.events.items() if name in events_that_stay}
    if not noise:
        cfg.observations["measured"].enable_corruption = False
        delay_s = cfg.commands[commands.NAME].gains.delay_s
        middle = round(delay_s / cfg.sim.mujoco.timestep)
        action = cfg.actions[actions.NAME]
        action.delay_span = None
        action.delay_steps = (middle, middle)


def draw_weak_drives(cfg: ManagerBasedRlEnvCfg, weakest: float) -> None:
    """Draw the torque of each robot's drives from a share of nominal to all of it.

    Args:
        cfg: Configuration of the environment, which is changed.
        weakest: The share, above 0.
    """
    cfg.events["strength"] = EventTermCfg(
        func=events.randomize_strength, mode="startup", params={"weakest": weakest}
    )


def set_contact_damping(cfg: ManagerBasedRlEnvCfg, least: float) -> None:
    """Draw the damping of the feet of each robot on the ground from a share of it to all of it.

    Args:
        cfg: Configuration of the environment, which is changed.
        least: The share, above 0; with 1 nothing is drawn.
    """
    if least == 1.0:
        if contact_damping(cfg) < 1.0:
            del cfg.events["contact"]
        return
    feet = SceneEntityCfg("robot", geom_names=".*_foot_collision")
    cfg.events["contact"] = EventTermCfg(
        func=events.randomize_contact, mode="startup", params={"least": least, "feet": feet}
    )


def contact_damping(cfg: ManagerBasedRlEnvCfg) -> float:
    """Return the smallest share of the damping of the feet that is drawn; 1 if nothing is."""
    term = cfg.events.get("contact")
    if term is None or term.func is not events.randomize_contact:
        return 1.0
    return float(term.params["least"])


def set_decimation_spread(cfg: ManagerBasedRlEnvCfg, steps: int) -> None:
    """Draw the number of physics steps of each policy step about the nominal one (D1, A1).

    Args:
        cfg: Configuration of the environment, which is changed.
        steps: How many physics steps a policy step has more or less at most; with 0 all policy
            steps are alike.

    Raises:
        PronkError: A policy step could be left without a physics step.
    """
    if steps >= cfg.decimation:
        raise PronkError(
            f"a policy step of {cfg.decimation} physics steps cannot have {steps} fewer; expected "
            f"{cfg.decimation - 1} at most."
        )
    if steps == 0:
        if decimation_spread(cfg) > 0:
            del cfg.events["decimation"]
        return
    cfg.events["decimation"] = EventTermCfg(
        func=events.randomize_decimation,
        mode="step",
        params={"nominal": cfg.decimation, "added": (-steps, steps)},
    )


def decimation_spread(cfg: ManagerBasedRlEnvCfg) -> int:
    """Return how many physics steps a policy step has more or less at most; 0 if none is drawn."""
    term = cfg.events.get("decimation")
    if term is None or term.func is not events.randomize_decimation:
        return 0
    return int(term.params["added"][1])


def set_rotor_frequency(cfg: ManagerBasedRlEnvCfg, lowest_hz: float) -> None:
    """Measure joints on rotors behind belts whose stiffness is drawn for each joint group.

    Args:
        cfg: Configuration of the environment, which is changed.
        lowest_hz: Lowest natural frequency of a rotor while its link is held [Hz]; with 0 joints
            are measured on their links.

    Raises:
        PronkError: Joints without rotor inertia, whose rotors cannot swing on belts.
    """
    if lowest_hz == 0.0:
        if rotor_frequency(cfg) > 0.0:
            del cfg.events["rotors"]
        return
    articulation = cfg.scene.entities["robot"].articulation
    assert articulation is not None
    joints = []
    for drive in articulation.actuators:
        if not drive.armature:
            joints += drive.target_names_expr
    if joints:
        raise PronkError(
            f"the rotor inertia of {', '.join(joints)} is 0, so that a rotor has no natural "
            "frequency; give rotor_inertia or armature of these joints in the robot's robot.yaml."
        )
    cfg.events["rotors"] = EventTermCfg(
        func=events.randomize_rotors, mode="startup", params={"lowest_hz": lowest_hz}
    )


def rotor_frequency(cfg: ManagerBasedRlEnvCfg) -> float:
    """Return the lowest frequency that is drawn [Hz]; 0 if joints are measured on their links."""
    term = cfg.events.get("rotors")
    if term is None or term.func is not events.randomize_rotors:
        return 0.0
    return float(term.params["lowest_hz"])


def play_cfg(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    """Make the environment for mjlab's `play` of a training environment: one nominal robot."""
    without_randomization(cfg)
    cfg.scene.num_envs = 1
    cfg.episode_length_s = 1e6
    cfg.terminations = {name: term for name, term in cfg.terminations.items() if not term.time_out}
    cfg.curriculum = {}
    cfg.commands[commands.NAME].jump_fraction = 1.0
    return cfg


def _scene(robot: RobotSpec, gains: TrainingGains, num_envs: int) -> SceneCfg:
    """Put the robot on a plane, with sensors `feet` (force and contact) and `limbs` (contact)."""
    body = legged(robot.source)
    feet = tuple(f"{leg}_foot_collision" for leg in body.legs)
    limbs = ["trunk_collision"]
    for leg in body.legs:
        limbs.append(f"{leg}_thigh_collision")
        limbs.append(f"{leg}_shank_collision")
    ground = ContactMatch(mode="body", pattern="terrain")

    entity = EntityCfg(
        spec_fn=partial(_spec, robot, feet),
        init_state=EntityCfg.InitialStateCfg(
            pos=(0.0, 0.0, body.standing_height),
            joint_pos={joint.name: joint.default_position for joint in robot.joints},
            joint_vel={".*": 0.0},
        ),
        articulation=EntityArticulationInfoCfg(actuators=drive_cfgs(robot, gains)),
        sort_actuators=True,
    )
    return SceneCfg(
        terrain=TerrainEntityCfg(terrain_type="plane"),
        entities={"robot": entity},
        sensors=(
            ContactSensorCfg(
                name="feet",
                primary=ContactMatch(mode="geom", pattern=feet, entity="robot"),
                secondary=ground,
                fields=("found", "force"),
                reduce="netforce",
            ),
            ContactSensorCfg(
                name="limbs",
                primary=ContactMatch(mode="geom", pattern=tuple(limbs), entity="robot"),
                secondary=ground,
                fields=("found",),
                reduce="none",
            ),
        ),
        num_envs=num_envs,
        extent=2.0,
    )


def _spec(robot: RobotSpec, feet: tuple[str, ...]) -> mujoco.MjSpec:
    """Build the robot's model with the contact of its feet."""
    spec = robot.build_spec()
    for name in feet:
        spec.geom(name).solref = FOOT_CONTACT
    return spec


def _simulation(robot: RobotSpec) -> SimulationCfg:
    """Configure MuJoCo Warp, at the timestep that gains are matched for."""
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
            # All robots wait for the one that needs the most. mjlab's quadrupeds have ten; how far
            # eight are from the solution is in docs/evidence/training.md.
            iterations=8,
            ls_iterations=20,
        ),
    )


def _observations() -> dict[str, ObservationGroupCfg]:
    """Configure the groups; noise is uniform, with these half-widths (D7 to D10)."""
    return {
        "jump": _group(observations.jump_input),
        "critic": _group(observations.critic_state),
        "critic_jump": _group(observations.critic_jump_state),
        "estimator_target": _group(observations.estimator_target),
        "measured": ObservationGroupCfg(
            terms={
                "angular_velocity": _measured(observations.angular_velocity, 0.2),
                "projected_gravity": _measured(observations.gravity_direction, 0.05),
                "joint_position": _measured(observations.measured_joint_position, 0.05, HISTORY),
                "joint_velocity": _measured(observations.measured_joint_velocity, 0.5, HISTORY),
                "action": ObservationTermCfg(func=observations.last_action, history_length=ACTIONS),
                "command": ObservationTermCfg(func=observations.velocity_command),
            },
            enable_corruption=True,
        ),
    }


def _group(func: Callable[[Any], Tensor]) -> ObservationGroupCfg:
    """Configure a group of one term without noise."""
    return ObservationGroupCfg(terms={"all": ObservationTermCfg(func=func)})


def _measured(
    func: Callable[[Any], Tensor], half_width: float, history: int = 0
) -> ObservationTermCfg:
    """Configure a term with noise."""
    noise = events.UniformNoise(n_min=-half_width, n_max=half_width)
    return ObservationTermCfg(func=func, noise=noise, history_length=history)


def _events(
    robot: RobotSpec, gains: TrainingGains, gain_shape: events.Shape
) -> dict[str, EventTermCfg]:
    """Configure what is randomized, and when."""
    feet = SceneEntityCfg("robot", geom_names=".*_foot_collision", site_names=".*_foot")
    shanks = SceneEntityCfg("robot", geom_names=".*_shank_collision")
    base = SceneEntityCfg("robot", body_names=robot.base_body)
    body = legged(robot.source)
    draws = {joint.name: gains.of(joint) for joint in robot.joints}
    gains_event = EventTermCfg(  # D3, D4
        func=events.randomize_gains,
        mode="startup",
        params={"ranges": draws, "shape": gain_shape},
    )
    if gains.joints:
        gains_event = EventTermCfg(
            func=events.randomize_drives,
            mode="startup",
            params={
                "gains": draws,
                "friction": dict(gains.frictions),
                "mirror": mirror_joints(body),
            },
        )
    if gains.joints or gain_shape == "ellipsoid":
        for draw in draws.values():
            events.check_ellipsoid(draw)
    # D5, .18 to .20 m, and D6, -.4 to 1.6 kg, of the Mini Cheetah, in proportion.
    shank = (0.18 / 0.195 * body.shank_length, 0.20 / 0.195 * body.shank_length)
    added = (-0.4 / 12.0 * body.total_mass, 1.6 / 12.0 * body.total_mass)
    rated = robot.joints[0].drive.bus_voltage

    return {
        "reset": EventTermCfg(
            func=events.reset_state,
            mode="reset",
            params={"place": 0.5, "speed": 0.3, "heading": math.pi, "joints": 0.1},
        ),
        # D2, one for all feet, which have priority over the floor.
        "friction": EventTermCfg(
            func=dr.geom_friction,
            mode="startup",
            params={"ranges": (0.05, 3.0), "shared_random": True, "asset_cfg": feet},
        ),
        "gains": gains_event,
        "shank_length": EventTermCfg(
            func=events.randomize_shank_length,
            mode="startup",
            params={"span": shank, "feet": feet, "shanks": shanks},
        ),
        "base_mass": EventTermCfg(
            func=events.randomize_base_mass,
            mode="startup",
            params={"added": added, "base": base},
        ),
        # Lithium cells from 3.7 V (nominal, and all but empty) to 4.2 V (full); of six cells 5 to
        # 12 milliohm each, and plugs and wires. Not in the paper. A jump draws a kilowatt and more.
        "battery": EventTermCfg(
            func=events.randomize_battery,
            mode="startup",
            params={
                "voltage": (22.2 / 24.0 * rated, 25.2 / 24.0 * rated),
                "resistance": (0.03, 0.1),
                "rated": rated,
            },
        ),
        # Mild; the paper has none.
        "push": EventTermCfg(
            func=events.Pushes,
            mode="step",
            params={"interval_s": (5.0, 10.0), "speed": 0.3, "yaw_rate": 0.3},
        ),
    }
