"""Randomization, delays and batteries of the training environment."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chisquare, kstest

pytest.importorskip("mjlab")

import torch
from mjlab.envs import ManagerBasedRlEnv

import training_env
from pronk.errors import PronkError
from pronk.jump.train.mdp.actions import DelayedJointPositionActionCfg, joint_position_action
from pronk.jump.train.mdp.events import (
    randomize_base_mass,
    randomize_decimation,
    randomize_strength,
    reset_state,
)
from pronk.jump.train.mdp.observations import (
    joint_position,
    joint_velocity,
    measured_joint_position,
    measured_joint_velocity,
)
from pronk.jump.train.tasks.jump_env_cfg import (
    draw_weak_drives,
    set_contact_damping,
    set_rotor_frequency,
    without_randomization,
)
from pronk.robots.legged import legged
from training_env import MANY, MATCHED, ROBOT, N, drawn

pytestmark = pytest.mark.train

BODY = legged("mini_cheetah")
ALL = torch.arange(MANY)


@pytest.fixture
def env() -> Any:
    return training_env.fresh(training_env.randomized(), scripted=True)


def index(env: Any, element: str, name: str) -> int:
    return int(getattr(env.sim.mj_model, element)(f"robot/{name}").id)


def assert_uniform(values: Any, low: float, high: float) -> None:
    """Within the range, uniform, and each draw another."""
    values = np.float64(values)
    assert low - 1e-6 <= values.min()
    assert values.max() <= high + 1e-6
    assert kstest(values.ravel(), "uniform", args=(low, high - low)).pvalue > 1e-3
    assert len(np.unique(values)) > 0.99 * values.size


def test_draws_are_uniform_and_independent(env: Any) -> None:
    """Drawn again and again; nothing accumulates."""
    rounds = []
    for _ in range(10):
        env.event_manager.apply(mode="startup")
        rounds.append(drawn(env))
    draws = {}
    for name in rounds[0]:
        draws[name] = torch.cat([values[name] for values in rounds])
    ranges = {
        "friction": (0.05, 3.0),
        "base_mass": (BODY.base_mass - 0.4, BODY.base_mass + 1.6),
        "shank_length": (0.18, 0.20),
        "no_load": (22.2 / 24.0, 25.2 / 24.0),
        "drop": (1e3 * 4 * 0.03 / 24.0**2, 1e3 * 4 * 0.1 / 24.0**2),
    }
    for name, (low, high) in ranges.items():
        assert_uniform(draws[name], low, high)
    joints = np.hstack([draws["stiffness"], draws["damping"]])
    for i, joint in enumerate(ROBOT.joints):
        gains = MATCHED.groups[joint.group]
        softest = gains.stiffness - gains.stiffness_range
        stiffest = gains.stiffness + gains.stiffness_range
        assert_uniform(joints[:, i], softest, stiffest)
        least_damped = gains.damping - gains.damping_range
        most_damped = gains.damping + gains.damping_range
        assert_uniform(joints[:, 12 + i], least_damped, most_damped)
    columns = [joints]
    for name in ranges:
        columns.append(draws[name])
    correlation = np.corrcoef(np.hstack(columns), rowvar=False)
    upper = np.triu_indices(len(correlation), 1)
    assert np.abs(correlation[upper]).max() < 5.0 / math.sqrt(10 * MANY)


def test_a_robot_keeps_its_parameters(env: Any) -> None:
    before = drawn(env)
    for _ in range(3):
        env.step(torch.zeros(MANY, 12))
    env.reset()
    after = drawn(env)
    for name in before.keys() - {"delay", "voltage"}:
        assert torch.equal(after[name], before[name]), name


def test_contacts_have_the_friction_of_the_foot(env: Any) -> None:
    for _ in range(20):
        env.step(torch.zeros(MANY, 12))
    contact = env.sim.wp_data.contact
    n = int(env.sim.wp_data.nacon.numpy()[0])
    feet = [index(env, "geom", f"{leg}_foot_collision") for leg in BODY.legs]
    touching = np.isin(contact.geom.numpy()[:n], feet).any(axis=1)
    assert touching.sum() > MANY
    friction = drawn(env)["friction"][contact.worldid.numpy()[:n][touching]].numpy()
    expected = np.hstack([friction, friction, np.full_like(friction, 0.02)])
    contact_friction = contact.friction.numpy()[:n][touching][:, :3]
    np.testing.assert_allclose(contact_friction, expected, rtol=1e-6)


def contact_env(least: float) -> Any:
    """Return nominal robots but for the damping of their feet on the ground."""
    cfg = training_env.config(MANY, MATCHED)
    without_randomization(cfg)
    set_contact_damping(cfg, least)
    return ManagerBasedRlEnv(cfg, device="cpu")


def test_damping_of_the_contacts_is_drawn_and_stiffness_stays() -> None:
    env = contact_env(0.4)
    feet = [index(env, "geom", f"{leg}_foot_collision") for leg in BODY.legs]
    time_constant, damping_ratio = env.sim.mj_model.geom_solref[feet[0]]
    assert damping_ratio == 1.0
    contact = np.float64(env.sim.model.geom_solref[:, feet].cpu())
    np.testing.assert_allclose(contact[..., 0], -(time_constant**-2), rtol=1e-5)
    share = contact[..., 1] / (-2.0 / time_constant)
    assert_uniform(share[:, 0], 0.4, 1.0)
    np.testing.assert_array_equal(contact[..., 1], np.repeat(contact[:, :1, 1], 4, axis=1))
    # Robots that fall alike on their feet spring back the faster, the less they are damped.
    training_env.fresh(env, scripted=True)
    env.sim.data.qpos[:, 2] += 0.1
    env.sim.data.qpos[:] = env.sim.data.qpos[:1].clone()
    env.sim.data.qvel[:] = 0.0
    speed = torch.zeros(MANY)
    for _ in range(25):
        env.step(torch.zeros(MANY, 12))
        speed = torch.maximum(speed, env.sim.data.qvel[:, 2])
    assert np.corrcoef(share[:, 0], speed)[0, 1] < -0.6
    env.close()


@pytest.fixture(scope="module")
def rotor_robots() -> Iterator[Any]:
    """Nominal robots without noise, whose joints are measured on rotors of 40 to 160 Hz."""
    cfg = training_env.config(MANY, MATCHED)
    without_randomization(cfg)
    set_rotor_frequency(cfg, 40.0)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    yield env
    env.close()


@pytest.fixture
def rotor_env(rotor_robots: Any) -> Any:
    return training_env.fresh(rotor_robots, scripted=True)


def test_frequencies_of_the_rotors_are_drawn_for_each_joint_group(rotor_env: Any) -> None:
    frequency = joint_position_action(rotor_env).rotors.frequency_hz
    by_group: dict[str, list[Any]] = {}
    for index, joint in enumerate(ROBOT.joints):
        by_group.setdefault(joint.group, []).append(frequency[:, index].numpy())
    drawn_once = []
    for columns in by_group.values():
        for column in columns[1:]:
            np.testing.assert_array_equal(column, columns[0])
        drawn_once.append(columns[0])
    assert_uniform(np.log(drawn_once), math.log(40.0), math.log(160.0))


def test_joints_are_measured_on_the_rotors(rotor_env: Any) -> None:
    """At rest a belt is wound up by the torque that it carries; in motion its rotor swings."""
    rotors = joint_position_action(rotor_env).rotors
    for _ in range(100):
        rotor_env.step(torch.zeros(MANY, 12))
    offset = measured_joint_position(rotor_env) - joint_position(rotor_env)
    torque = rotor_env.scene["robot"].data.qfrc_actuator
    armatures = torch.tensor([joint.drive.armature for joint in ROBOT.joints])
    stiffness = armatures * (2.0 * math.pi * rotors.frequency_hz).square()
    knees = [index for index, joint in enumerate(ROBOT.joints) if joint.group == "knee"]
    expected = (torque / stiffness)[:, knees]
    assert torque[:, knees].abs().mean() > 3.0
    largest = float(expected.abs().max())
    np.testing.assert_allclose(offset[:, knees], expected, atol=0.05 * largest)
    swings = []
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        rotor_env.step(torch.randn(MANY, 12, generator=generator))
        swings.append(measured_joint_velocity(rotor_env) - joint_velocity(rotor_env))
        torch.testing.assert_close(swings[-1], rotors.speed, rtol=0.0, atol=1e-4)
    size = torch.stack(swings).square().mean(dim=0).sqrt()
    stiffest = rotors.frequency_hz > 120.0
    softest = rotors.frequency_hz < 50.0
    assert size[softest].mean() > 2.0 * size[stiffest].mean()
    # New episodes begin with rotors at rest.
    rotor_env.reset()
    assert not rotors.offset.any()
    assert not rotors.speed.any()


def test_joints_are_measured_on_the_links_unless_rotors_are_drawn() -> None:
    env = training_env.fresh(training_env.nominal(), scripted=True)
    env.step(torch.ones(N, 12))
    assert torch.equal(measured_joint_position(env), joint_position(env))
    assert torch.equal(measured_joint_velocity(env), joint_velocity(env))


def test_contacts_with_all_of_their_damping_are_those_of_the_model(nominal_heights: Any) -> None:
    env = contact_env(1.0)
    torch.testing.assert_close(heights_after_a_fall(env), nominal_heights, rtol=0.0, atol=1e-5)
    env.close()


def heights_after_a_fall(env: Any) -> Any:
    """Drop the robots from 0.1 m; returns the heights of their trunks step by step."""
    training_env.fresh(env, scripted=True)
    env.sim.data.qpos[:, 2] += 0.1
    heights = []
    for _ in range(15):
        env.step(torch.zeros(env.num_envs, 12))
        heights.append(float(env.sim.data.qpos[0, 2]))
    return torch.tensor(heights)


@pytest.fixture
def nominal_heights() -> Any:
    """Heights of a robot with the contacts of the model."""
    cfg = training_env.config(2, MATCHED)
    without_randomization(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    heights = heights_after_a_fall(env)
    env.close()
    return heights


def test_inertia_of_the_trunk_grows_with_its_mass(env: Any) -> None:
    trunk = index(env, "body", "trunk")
    model = env.sim.mj_model
    mass = drawn(env)["base_mass"].numpy()
    inertia = env.sim.model.body_inertia[:, trunk].numpy()
    expected = mass / BODY.base_mass * model.body_inertia[trunk]
    np.testing.assert_allclose(inertia, expected, rtol=1e-5)
    # Derived constants follow, and no other body changes.
    total_mass = env.sim.model.body_subtreemass[:, trunk].numpy()
    expected = mass[:, 0] + BODY.total_mass - BODY.base_mass
    np.testing.assert_allclose(total_mass, expected, rtol=1e-5)
    masses = np.delete(env.sim.model.body_mass.numpy(), trunk, axis=1)
    expected = np.delete(np.float32(model.body_mass), trunk)
    np.testing.assert_array_equal(masses, np.tile(expected, (MANY, 1)))
    base = env.event_manager.get_term_cfg("base_mass").params["base"]
    with pytest.raises(PronkError, match="base_mass"):
        randomize_base_mass(env, None, (-7.0, 1.0), base)


def test_shank_length_moves_foot_and_capsule(env: Any) -> None:
    data = env.sim.data
    model = env.sim.model
    data.qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    data.qpos[:, 7:] = env.scene["robot"].data.default_joint_pos[0]
    env.sim.forward()
    for leg, length in zip(BODY.legs, drawn(env)["shank_length"].T, strict=True):
        thigh = index(env, "body", f"{leg}_thigh")
        shank = index(env, "body", f"{leg}_shank")
        foot = index(env, "geom", f"{leg}_foot_collision")
        capsule = index(env, "geom", f"{leg}_shank_collision")
        site = data.site_xpos[:, index(env, "site", f"{leg}_foot")]
        torch.testing.assert_close(site, data.geom_xpos[:, foot], atol=1e-6, rtol=0.0)
        # Default pose: thigh .8 rad back, shank .8 rad forward, both from the vertical.
        drop = data.xpos[:, thigh, 2] - data.geom_xpos[:, foot, 2]
        legs = (BODY.thigh_length + length) * math.cos(0.8)
        # The capsule begins 2 cm below the knee and ends 3 cm above the foot; its bounds follow.
        centre = (data.geom_xpos[:, capsule] - data.xpos[:, shank]).norm(dim=-1)
        half = model.geom_size[:, capsule, 1]
        distances = [
            drop - legs,
            centre - half,
            centre + half - length,
            model.geom_rbound[:, capsule] - half,
            model.geom_aabb[:, capsule, 1, 2] - half,
        ]
        expected = torch.tensor([0.0, 0.02, -0.03, 0.01, 0.01])[:, None].expand(5, MANY)
        torch.testing.assert_close(torch.stack(distances), expected, atol=1e-5, rtol=0.0)


def test_episodes_begin_about_the_initial_state(env: Any) -> None:
    robot = env.scene["robot"].data
    data = env.sim.data
    spread = {"place": 0.5, "speed": 0.3, "heading": math.pi, "joints": 0.1}
    assert dict(env.event_manager.get_term_cfg("reset").params) == spread
    states = []
    for _ in range(10):
        reset_state(env, ALL, **spread)
        states.append(torch.cat([data.qpos.clone(), data.qvel.clone()], dim=1))
        states[-1][:, :3] -= env.scene.env_origins
    start = np.float64(torch.cat(states).numpy())
    np.testing.assert_allclose(start[:, 2], robot.default_root_state[0, 2], rtol=1e-6)
    np.testing.assert_array_equal(start[:, [4, 5, *range(21, 37)]], 0.0)
    np.testing.assert_allclose(np.linalg.norm(start[:, 3:7], axis=1), 1.0, rtol=1e-6)
    assert_uniform(2.0 * np.arctan2(start[:, 6], start[:, 3]), -math.pi, math.pi)
    for axis, half in ((0, 0.5), (1, 0.5), (19, 0.3), (20, 0.3)):
        assert_uniform(start[:, axis], -half, half)
    assert_uniform(start[:, 7:19] - robot.default_joint_pos[0].numpy(), -0.1, 0.1)
    before = data.qpos.clone()
    reset_state(env, ALL[::2], **spread)
    assert (data.qpos == before).all(dim=1).tolist() == [False, True] * (MANY // 2)


def test_pushes_change_the_velocity_at_intervals(env: Any) -> None:
    """Every 5 to 10 s, in the world's frame, whatever the attitude of the trunk."""
    term = env.event_manager.get_term_cfg("push")
    assert dict(term.params) == {"interval_s": (5.0, 10.0), "speed": 0.3, "yaw_rate": 0.3}
    data = env.sim.data
    # Turned so that each axis of the trunk is another axis of the world.
    attitude = torch.tensor([0.5, 0.5, 0.5, 0.5])
    data.qpos[:, 3:7] = attitude
    env.sim.forward()
    data.qvel[:] = 0.0
    pushed_at: list[list[float]] = [[] for _ in range(MANY)]
    velocities = []
    for step in range(2000):
        term.func(env, None, **term.params)
        for robot in (data.qvel[:, :6] != 0.0).any(dim=1).nonzero().flatten().tolist():
            pushed_at[robot].append(step * env.step_dt)
            velocities.append(data.qvel[robot].tolist())
        data.qvel[:] = 0.0
    intervals = np.concatenate([np.diff(times) for times in pushed_at])
    # A push waits for the end of a step.
    assert intervals.min() >= 5.0 - 1e-6
    assert intervals.max() <= 10.0 + env.step_dt + 1e-6
    jitter = np.random.default_rng(0).uniform(0.0, env.step_dt, intervals.shape)
    assert kstest(intervals - jitter, "uniform", args=(5.0, 5.0)).pvalue > 1e-3
    pushes = np.array(velocities)
    np.testing.assert_array_equal(pushes[:, 6:], 0.0)
    np.testing.assert_array_equal(pushes[:, 2], 0.0)
    assert_uniform(pushes[:, 0], -0.3, 0.3)
    assert_uniform(pushes[:, 1], -0.3, 0.3)
    rotation = Rotation.from_quat(attitude[[1, 2, 3, 0]].numpy())
    turns = rotation.apply(pushes[:, 3:6])  # in the world's frame
    np.testing.assert_allclose(turns[:, :2], 0.0, atol=1e-6)
    assert_uniform(turns[:, 2], -0.3, 0.3)


def test_length_of_the_policy_step_is_drawn_each_step(env: Any) -> None:
    """A resumed run restores the counter and has the same draw."""
    for _ in range(6):
        planned = env.cfg.decimation
        before = env.sim.data.time.clone()
        env.step(torch.zeros(MANY, 12))
        running = env.episode_length_buf > 0
        passed = env.sim.data.time[running] - before[running]
        torch.testing.assert_close(passed, torch.full_like(passed, 0.005 * planned))
    planned = env.cfg.decimation
    randomize_decimation(env, None, **env.event_manager.get_term_cfg("decimation").params)
    assert env.cfg.decimation == planned


@pytest.mark.parametrize("delay", [(0, 0), (0, 2), (1, 3), (2, 7)])
def test_targets_arrive_exactly_a_delay_later(env: Any, delay: tuple[int, int]) -> None:
    """Against a list of all targets, for policy steps of any length and a reset on the way."""
    term = DelayedJointPositionActionCfg(
        entity_name="robot", actuator_names=(".*",), scale=0.35, delay_steps=delay
    ).build(env)
    robot = env.scene["robot"].data
    default = robot.default_joint_pos
    term.reset()
    issued = [default.clone() for _ in range(delay[1] + 1)]
    """The newest target at each physics step so far."""
    generator = np.random.default_rng(3)
    for step in range(40):
        if step == 25:
            robot.joint_pos_target[ALL[::2]] = 0.0  # as a reset of the entity does
            term.reset(ALL[::2])
            for past in issued:
                past[::2] = default[::2]
        action = torch.tensor(generator.normal(size=(MANY, 12)), dtype=torch.float32)
        term.process_actions(action)
        for _ in range(generator.integers(1, 7)):
            issued.append(default + 0.35 * action)
            term.apply_actions()
            then = len(issued) - 1 - term.lag[:, 0]
            torch.testing.assert_close(robot.joint_pos_target, torch.stack(issued)[then, ALL])
    assert set(term.lag[:, 0].tolist()) == set(range(delay[0], delay[1] + 1))


def test_delays_are_drawn_per_episode_and_torques_follow_the_drawn_gains(env: Any) -> None:
    """5.5 ms is one physics step, +- 1; all joints of a robot have the same delay."""
    first = drawn(env)
    counts = Counter(first["delay"][:, 0].tolist())
    assert counts.keys() == {0, 1, 2}
    assert chisquare(list(counts.values())).pvalue > 1e-3
    robot = env.scene["robot"].data
    action = torch.rand(MANY, 12) - 0.5
    for step in range(4):
        env.cfg.decimation = 1
        position = robot.joint_pos.clone()
        velocity = robot.joint_vel.clone()
        env.step(action)
        target = robot.default_joint_pos + 0.35 * action * (first["delay"] <= step)
        torque = first["stiffness"] * (target - position) - first["damping"] * velocity
        torch.testing.assert_close(robot.qfrc_actuator, torque, rtol=0.0, atol=1e-4)
        assert torque.abs().max() < 17.0, "no limit is reached"
    env.reset(env_ids=ALL[::2])
    second = drawn(env)["delay"]
    assert torch.equal(second[1::2], first["delay"][1::2])
    assert 0.4 < (second[::2] != first["delay"][::2]).float().mean() < 0.95


# --- Gains by joint, and weak drives -------------------------------------------------------------


@pytest.fixture
def joints_env() -> Any:
    return training_env.fresh(training_env.drawn_by_joint(), scripted=True)


def frictions(env: Any) -> Any:
    """Dry friction of the joints of each robot, in the robot's order. (N, 12)"""
    joints = env.scene["robot"].indexing.joint_v_adr.long()
    return env.sim.model.dof_frictionloss[:, joints].clone()


def test_by_joint_a_robot_is_the_measured_one_or_its_mirror_image(joints_env: Any) -> None:
    """All of its joints together: pairs in their ellipses, friction in its interval."""
    gains = training_env.by_joint_gains()
    mirror = {"FR": "FL", "FL": "FR", "HR": "HL", "HL": "HR"}
    joints_env.event_manager.apply(mode="startup")
    stiffness, damping = drawn(joints_env)["stiffness"], drawn(joints_env)["damping"]
    friction = frictions(joints_env)
    fits = torch.ones(MANY, 2, dtype=torch.bool)
    for i, joint in enumerate(ROBOT.joints):
        leg, _, rest = joint.name.partition("_")
        for side, name in enumerate((joint.name, f"{mirror[leg]}_{rest}")):
            own = gains.joints[name]
            offset = torch.stack((stiffness[:, i] - own.stiffness, damping[:, i] - own.damping))
            inverse = torch.linalg.inv(torch.tensor(own.ellipsoid, dtype=torch.float64))
            distance = torch.einsum("in,ij,jn->n", offset.double(), inverse, offset.double())
            low, high = gains.frictions[name]
            is_within = (low - 1e-6 <= friction[:, i]) & (friction[:, i] <= high + 1e-6)
            fits[:, side] &= (distance <= 1.001) & is_within
    assert (fits.sum(dim=1) == 1).all(), "one or the other, not a bit of both"
    assert 0.25 < fits[:, 1].float().mean() < 0.75


def test_by_joint_stiffness_and_damping_are_correlated_as_measured(joints_env: Any) -> None:
    offsets = []
    for _ in range(10):
        joints_env.event_manager.apply(mode="startup")
        for name in ("stiffness", "damping"):
            # Of the measured robots: right front hips are softer than left ones, by 3 and .03.
            offsets.append(drawn(joints_env)[name][:, 0])
    stiffness, damping = torch.cat(offsets[::2]), torch.cat(offsets[1::2])
    measured = stiffness < 17.0
    stiffness, damping = stiffness[measured].double(), damping[measured].double()
    correlation = np.corrcoef(stiffness, damping)[0, 1]
    assert correlation == pytest.approx(0.75, abs=0.08)  # 6e-4 / sqrt(.04 16e-6)
    # Uniform in an ellipse: a quarter of the squared half-width along each axis.
    assert float(stiffness.std()) == pytest.approx(0.1, rel=0.15)
    assert float(stiffness.mean()) == pytest.approx(16.0, abs=0.03)


def test_by_joint_a_delay_keeps_its_mean_between_two_physics_steps(joints_env: Any) -> None:
    """5.5 to 6.5 ms: one or two steps of 5 ms, 1.2 in the mean."""
    lags = []
    for _ in range(20):
        joints_env.reset()
        lags.append(drawn(joints_env)["delay"])
    lag = torch.cat(lags).float()
    assert set(lag.unique().tolist()) == {1.0, 2.0}
    assert float(lag.mean()) == pytest.approx(1.2, abs=5 * 0.4 / math.sqrt(lag.numel()))


def test_by_joint_the_undisturbed_robot_is_the_measured_one() -> None:
    gains = training_env.by_joint_gains()
    cfg = training_env.config(2, gains)
    without_randomization(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset(seed=0)
    parameters = drawn(env)
    for i, joint in enumerate(ROBOT.joints):
        own = gains.joints[joint.name]
        assert parameters["stiffness"][:, i].tolist() == pytest.approx([own.stiffness] * 2)
        assert parameters["damping"][:, i].tolist() == pytest.approx([own.damping] * 2)
        assert frictions(env)[:, i].tolist() == pytest.approx([0.1025 + 0.01 * i] * 2)
    assert parameters["delay"].tolist() == [[1], [1]]


def test_weak_drives_give_their_share_of_everything(joints_env: Any) -> None:
    """Drawn again and again, nothing accumulates; the line is that of a weaker magnet."""
    cfg = joints_env.cfg
    battery = joint_position_action(joints_env).battery
    for _ in range(3):
        joints_env.event_manager.apply(mode="startup")
        before = drawn(joints_env)["stiffness"]
        randomize_strength(joints_env, None, weakest=0.7)
    parameters = drawn(joints_env)
    share = parameters["stiffness"] / before
    strength = share[:, :1]
    assert_uniform(strength, 0.7, 1.0)
    torch.testing.assert_close(share, strength.expand(-1, 12), rtol=1e-5, atol=0.0)
    for drive in joints_env.scene["robot"].actuators:
        rated = ROBOT.joint(drive.target_names[0]).drive
        voltage = battery.voltage
        expected = [
            (drive.force_limit, rated.effort_limit * strength),
            (drive.saturation_effort, rated.stall_torque * strength * voltage),
            (drive.velocity_limit_motor, rated.no_load_speed / strength * voltage),
        ]
        for value, of_drive in expected:
            torch.testing.assert_close(value, of_drive.expand_as(value), rtol=1e-4, atol=0.0)
    randomize_strength(joints_env, None, weakest=1.0)
    joints_env.event_manager.apply(mode="startup")
    training_cfg = training_env.config(2, MATCHED)
    draw_weak_drives(training_cfg, 0.7)
    assert list(training_cfg.events)[-1] == "strength", "after the gains"
    assert "strength" not in cfg.events


@pytest.fixture
def batteries() -> Any:
    """Nominal robots; a test gives them batteries."""
    env = training_env.fresh(training_env.nominal(), scripted=True)
    battery = joint_position_action(env).battery
    assert battery.ideal
    yield env, battery
    battery.set(torch.full((N, 1), 24.0), torch.zeros(N, 1), rated=24.0)
    battery.ideal = True


def give(battery: Any, volts: float, ohms: float) -> None:
    """Give the first robot an ideal battery and all others a battery with a resistance."""
    voltage = torch.full((N, 1), volts)
    resistance = torch.full((N, 1), ohms)
    voltage[0] = 24.0
    resistance[0] = 0.0
    battery.set(voltage, resistance, rated=24.0)


@pytest.mark.parametrize(("torque", "speed"), [(10.0, 5.0), (-8.0, -3.0), (6.0, -9.0), (0.0, 20.0)])
def test_voltage_is_the_fixed_point_of_the_power(
    batteries: Any, torque: float, speed: float
) -> None:
    """V = U - R P / V, with P of brushed motors with K = 2 gear kt and the winding's resistance."""
    env, battery = batteries
    give(battery, 25.0, 0.08)
    for _ in range(100):
        env.sim.data.qfrc_actuator[:, 6:] = torque
        env.sim.data.qvel[:, 6:] = speed
        battery.advance()
    power = 0.0
    for joint in ROBOT.joints:
        constant = 2.0 * joint.drive.gear_ratio * 0.05
        winding = 0.173 * 2.0 / 1.5
        power += torque * speed + winding * (torque / constant) ** 2
    volts = 12.5 + math.sqrt(12.5**2 - 0.08 * power)
    assert float(battery.voltage[1]) * 24.0 == pytest.approx(volts, rel=1e-4)
    assert float(battery.voltage[0]) == pytest.approx(1.0, rel=1e-6)
    # Beyond the greatest power half of the voltage is left.
    for _ in range(100):
        env.sim.data.qfrc_actuator[:, 6:] = 26.0
        env.sim.data.qvel[:, 6:] = 20.0
        battery.advance()
    assert float(battery.voltage[1]) * 24.0 == pytest.approx(12.5, rel=1e-4)


def test_stall_torque_is_in_proportion_to_the_voltage(batteries: Any) -> None:
    env, battery = batteries
    give(battery, 18.0, 0.0)
    for drive in env.scene["robot"].actuators:
        rated = ROBOT.joint(drive.target_names[0]).drive
        stall = drive.saturation_effort[:2, 0].tolist()
        assert stall == pytest.approx([rated.stall_torque, 0.75 * rated.stall_torque], rel=1e-5)
        # The torque lost to speed is the same, so the no-load speed falls alike.
        no_load = drive.velocity_limit_motor[:2, 0].tolist()
        assert no_load == pytest.approx([rated.no_load_speed, 0.75 * rated.no_load_speed], rel=1e-5)


def test_physics_gone_wrong_leaves_a_battery(env: Any) -> None:
    """A power that is not finite must not stay in the voltage, nor in the drives' limits."""
    battery = joint_position_action(env).battery
    still = torch.zeros(MANY, 12)
    env.step(still)
    env.sim.data.qvel[3, 7] = float("nan")
    env.step(still)
    assert env.termination_manager.get_term("non_finite")[3]
    assert float(battery.voltage[3]) == pytest.approx(float(battery.no_load[3]))
    env.step(still)
    for drive in env.scene["robot"].actuators:
        assert torch.isfinite(drive.saturation_effort).all()
    assert 0.7 < float(battery.voltage[3]) < 1.1
