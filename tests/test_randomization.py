"""Drives and draws of the training environment, on Warp's CPU device."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import chirp
from scipy.stats import chisquare, kstest

from pronk.errors import PronkError, RobotError
from pronk.match.gains import GroupGains
from pronk.robots import load_robot
from pronk.robots.legged import legged
from pronk.robots.model import bench_spec
from pronk.simulators.command_trace import CommandTrace
from pronk.simulators.mujoco import simulate
from pronk.train.gains import TrainingGains, training_gains

BODY = legged("mini_cheetah")

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch
from mjlab.actuator import DcMotorActuator
from mjlab.actuator.actuator import ActuatorCmd
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs.mdp import reset_scene_to_default
from mjlab.managers.event_manager import EventTermCfg
from mjlab.scene import SceneCfg
from mjlab.terrains import TerrainEntityCfg

from pronk.train.mdp import draws as drawing
from pronk.train.mdp.actions import HeldJointPositionCfg
from pronk.train.mdp.drives import PositionDrive, actuators
from pronk.train.mdp.randomization import Randomization, delay_steps, events, noise
from pronk.train.mdp.scene import robot_entity, simulation

Array = NDArray[np.float64]
CHEETAH = load_robot("mini_cheetah")
ROBOTS = 64
MATCHED = TrainingGains(
    name="matched",
    robot="mini_cheetah",
    groups={
        "hip_roll": GroupGains(
            stiffness=20.0, damping=0.45, stiffness_range=2.0, damping_range=0.1
        ),
        "hip_pitch": GroupGains(
            stiffness=17.5, damping=0.4, stiffness_range=1.5, damping_range=0.05
        ),
        "knee": GroupGains(
            stiffness=21.5,
            damping=0.55,
            stiffness_range=1.0,
            damping_range=0.05,
            ellipsoid=((0.5, 0.008), (0.008, 0.0004)),
            ellipsoid_center=(22.0, 0.54),
        ),
    },
    delay_s=0.0055,
)


def held(delay: tuple[int, int], scale: float = 0.35) -> HeldJointPositionCfg:
    return HeldJointPositionCfg(
        entity_name="robot", actuator_names=(".*",), scale=scale, delay_steps=delay
    )


def built(
    entity: EntityCfg,
    terms: dict[str, EventTermCfg],
    action: HeldJointPositionCfg,
    *,
    robots: int,
) -> ManagerBasedRlEnv:
    config = ManagerBasedRlEnvCfg(
        seed=7,
        decimation=CHEETAH.decimation,
        scene=SceneCfg(
            num_envs=robots,
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={"robot": entity},
        ),
        sim=simulation(CHEETAH),
        actions={"position": action},
        events={**terms, "reset": EventTermCfg(func=reset_scene_to_default, mode="reset")},
        episode_length_s=20.0,
    )
    return ManagerBasedRlEnv(config, device="cpu")


def free_robots(gains: TrainingGains, randomization: Randomization, robots: int) -> Any:
    entity = robot_entity(CHEETAH, actuators(CHEETAH, gains))
    action = held(delay_steps(CHEETAH, gains, randomization))
    return built(entity, events(CHEETAH, gains, randomization), action, robots=robots)


@pytest.fixture(scope="module", autouse=True)
def quiet() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MJLAB_WARP_QUIET", "1")
        yield


@pytest.fixture(scope="module")
def drawn(quiet: None) -> Any:
    return free_robots(MATCHED, Randomization.paper(), ROBOTS)


@pytest.fixture
def env(drawn: Any) -> Any:
    drawn.reset()
    return drawn


def index(env: Any, kind: str, name: str) -> int:
    """Where a body, geom or site of the robot stands in the model."""
    return int(getattr(env.sim.mj_model, kind)(f"robot/{name}").id)


# --- The law that was matched ---------------------------------------------------------------------


def at_rest(joint: str, gains: TrainingGains) -> dict[str, float]:
    """Where gravity leaves the chain of a joint that is held at its default pose."""
    model = bench_spec(CHEETAH, joint).compile()
    data = mujoco.MjData(model)
    chain = CHEETAH.joint(joint).chain
    target = np.array([CHEETAH.joint(name).default_position for name in chain])
    stiffness = np.array([gains.groups[CHEETAH.joint(n).group].stiffness for n in chain])
    data.qpos[:] = target
    for _ in range(10):
        mujoco.mj_forward(model, data)
        data.qpos[:] = target - data.qfrc_bias / stiffness
    return dict(zip(chain, data.qpos, strict=True))


def on_the_bench(joint: str, gains: TrainingGains, delay: int) -> Any:
    """The training environment with one joint's chain on a fixed base in place of the robot."""

    def passive() -> mujoco.MjSpec:
        spec = bench_spec(CHEETAH, joint)
        for element in (*spec.actuators, *spec.keys):
            spec.delete(element)
        spec.option.timestep, spec.option.disableflags = 0.002, 0  # the scene has its own
        return spec

    chain = CHEETAH.joint(joint).chain
    drives = []
    for drive in actuators(CHEETAH, gains):
        own = tuple(name for name in drive.target_names_expr if name in chain)
        if own:
            drives.append(replace(drive, target_names_expr=own))
    pose = {name: CHEETAH.joint(name).default_position for name in chain}
    entity = EntityCfg(
        spec_fn=passive,
        init_state=EntityCfg.InitialStateCfg(joint_pos=pose, joint_vel={".*": 0.0}),
        articulation=EntityArticulationInfoCfg(actuators=tuple(drives)),
    )
    return built(entity, {}, held((delay, delay), scale=1.0), robots=1)


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "delay"), [("FR_knee", 0), ("FR_hip_roll", 0), ("FR_knee", 6)])
def test_training_answers_the_chirp_that_was_matched(joint: str, delay: int) -> None:
    """match's simulator and the training environment, the same chirp at policy rate.

    A delay of the training environment is that much delay of the command.
    """
    ticks = np.arange(150) / CHEETAH.policy_rate_hz
    offset = 0.25 * chirp(ticks, 0.1, ticks[-1], 15.0, phi=-90)
    default = CHEETAH.joint(joint).default_position
    held = np.repeat(offset, CHEETAH.decimation)
    question = CommandTrace(
        joint=joint,
        start=0.0,
        timestep=CHEETAH.timestep_s,
        command=default + np.concatenate([np.zeros(delay), held[: len(held) - delay]]),
        pose=np.array([j.default_position for j in CHEETAH.joints]),
    )
    gains = {n: MATCHED.groups[CHEETAH.joint(n).group] for n in CHEETAH.joint(joint).chain}
    joints = tuple(
        replace(j, stiffness=gains[j.name].stiffness, damping=gains[j.name].damping)
        if j.name in gains
        else j
        for j in CHEETAH.joints
    )
    matched = replace(CHEETAH, joints=joints)
    expected = simulate(matched, question, gains[joint].stiffness, gains[joint].damping)
    expected = expected[0, :: CHEETAH.decimation]

    env = on_the_bench(joint, MATCHED, delay)
    env.reset()
    robot = env.scene["robot"]
    rest = at_rest(joint, MATCHED)
    start = torch.tensor([[rest[name] for name in robot.joint_names]], dtype=torch.float32)
    robot.write_joint_state_to_sim(start, torch.zeros_like(start))
    asked = robot.joint_names.index(joint)
    answer = []
    for value in offset:
        answer.append(float(robot.data.joint_pos[0, asked]))
        action = torch.zeros_like(start)
        action[0, asked] = float(value)
        env.step(action)
    assert np.ptp(expected) > 0.3
    np.testing.assert_allclose(np.array(answer), expected, atol=2e-5)
    wrong = MATCHED.groups[CHEETAH.joint(joint).group].stiffness - 0.1
    other = simulate(CHEETAH, question, wrong, gains[joint].damping)[0, :: CHEETAH.decimation]
    assert np.abs(other - expected).max() > 2e-4, "another gain would be noticed"


def test_drives_of_every_group() -> None:
    drives = actuators(CHEETAH, MATCHED)
    assert [drive.target_names_expr for drive in drives] == [
        tuple(f"{leg}_{group}" for leg in BODY.legs) for group in CHEETAH.groups
    ]
    knee = drives[2]
    assert (knee.stiffness, knee.damping) == (21.5, 0.55)
    # 72e-6 * 9.33^2; 17 N m * 9.33 / 6; 1.5 * 9.33 * .05 * 24 / .173; 24 / (2 * 9.33 * .05)
    assert knee.armature == pytest.approx(0.0062675, rel=1e-4)
    assert knee.effort_limit == pytest.approx(26.435, rel=1e-4)
    assert knee.saturation_effort == pytest.approx(97.075, rel=1e-4)
    assert knee.velocity_limit == pytest.approx(25.723, rel=1e-4)
    assert (knee.frictionloss, knee.viscous_damping) == (0.2, 0.01)


def test_law_of_the_drives_is_that_of_mjlab() -> None:
    """Over more than twice the no-load speed and torques far beyond the limits."""
    cfg = actuators(CHEETAH, MATCHED)[2]
    generator = torch.Generator().manual_seed(5)

    def drawn(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(5000, 4, generator=generator, dtype=torch.float64)

    params = {
        "stiffness": drawn(10.0, 30.0),
        "damping": drawn(0.2, 0.8),
        "force_limit": torch.full((5000, 4), cfg.effort_limit, dtype=torch.float64),
        "saturation_effort": torch.full((5000, 4), cfg.saturation_effort, dtype=torch.float64),
        "velocity_limit_motor": torch.full((5000, 4), cfg.velocity_limit, dtype=torch.float64),
    }
    params["back_emf"] = params["saturation_effort"] / params["velocity_limit_motor"]
    none = torch.zeros(5000, 4, dtype=torch.float64)
    command = ActuatorCmd(
        position_target=drawn(-4.0, 4.0),
        velocity_target=none,
        effort_target=none,
        pos=drawn(-4.0, 4.0),
        vel=drawn(-60.0, 60.0),
    )
    expected = DcMotorActuator.control_law(params, command)
    torch.testing.assert_close(PositionDrive.control_law(params, command), expected)
    share = (expected.abs() < cfg.effort_limit * 0.999).double().mean()
    assert 0.1 < share < 0.9, "both within and at the limits"


def test_drives_that_are_not_the_robots_are_refused() -> None:
    with pytest.raises(PronkError, match="gains of so101 were given for the drives of mini_ch"):
        actuators(CHEETAH, replace(MATCHED, robot="so101"))
    weak = replace(CHEETAH.joint("FR_knee"), drive=CHEETAH.joint("FR_hip_roll").drive)
    joints = tuple(weak if j.name == "FR_knee" else j for j in CHEETAH.joints)
    with pytest.raises(RobotError, match="group knee have different drives"):
        actuators(replace(CHEETAH, joints=joints), MATCHED)


# --- Drawn once -----------------------------------------------------------------------------------


def assert_uniform(values: Array, low: float, high: float) -> None:
    assert low - 1e-6 <= values.min()
    assert values.max() <= high + 1e-6
    assert kstest(values.ravel(), "uniform", args=(low, high - low)).pvalue > 1e-3
    assert len(np.unique(values)) > 0.99 * values.size, "every draw is its own"


def test_draws_are_uniform_over_their_ranges(env: Any) -> None:
    """Drawn again and again for the sake of numbers; nothing builds up."""
    rounds = []
    for _ in range(10):
        env.event_manager.apply(mode="startup")
        rounds.append(drawing.draws(env))
    found = {name: np.concatenate([draw[name] for draw in rounds]) for name in rounds[0]}
    trunk = BODY.base_mass
    assert_uniform(found["friction"], 0.05, 3.0)
    assert_uniform(found["base_mass"], trunk - 0.4, trunk + 1.6)
    assert_uniform(found["shank_length"], 0.18, 0.20)
    assert_uniform(found["no_load"], 22.2 / 24.0, 25.2 / 24.0)
    assert_uniform(found["drop"], 4 * 0.03 / 24.0**2, 4 * 0.1 / 24.0**2)
    assert found["shank_length"].shape == (10 * ROBOTS, 4)
    names = env.scene["robot"].joint_names
    for group, g in MATCHED.groups.items():
        column = [i for i, name in enumerate(names) if name.endswith(group)]
        kp, kd = found["stiffness"][:, column], found["damping"][:, column]
        assert kp.shape == (10 * ROBOTS, 4)
        assert_uniform(kp, g.stiffness - g.stiffness_range, g.stiffness + g.stiffness_range)
        assert_uniform(kd, g.damping - g.damping_range, g.damping + g.damping_range)
        # Four joints and two gains, all independent: 28 correlations, each ~ N(0, 1/sqrt(640)).
        correlation = np.corrcoef(np.hstack([kp, kd]), rowvar=False)
        assert np.abs(correlation[np.triu_indices(8, 1)]).max() < 4.0 / math.sqrt(10 * ROBOTS)


def test_what_a_robot_has_once_it_keeps(env: Any) -> None:
    before = drawing.draws(env)
    for _ in range(5):
        env.step(torch.zeros(ROBOTS, 12))
    env.reset(env_ids=torch.arange(0, ROBOTS, 2))
    env.step(torch.zeros(ROBOTS, 12))
    env.reset()
    after = drawing.draws(env)
    for name in ("friction", "base_mass", "shank_length", "stiffness", "damping"):
        np.testing.assert_array_equal(after[name], before[name])


def test_contacts_have_the_friction_of_the_foot(env: Any) -> None:
    for _ in range(20):
        env.step(torch.zeros(ROBOTS, 12))
    contact = env.sim.wp_data.contact
    n = int(env.sim.wp_data.nacon.numpy()[0])
    geoms, world = contact.geom.numpy()[:n], contact.worldid.numpy()[:n]
    feet = [index(env, "geom", f"{leg}_foot_collision") for leg in BODY.legs]
    touching = np.isin(geoms, feet).any(axis=1)
    assert touching.sum() > ROBOTS
    sliding = contact.friction.numpy()[:n][touching]
    drawn = drawing.draws(env)["friction"][world[touching]]
    np.testing.assert_allclose(sliding[:, 0], drawn, rtol=1e-6)
    np.testing.assert_allclose(sliding[:, 1], drawn, rtol=1e-6)
    np.testing.assert_allclose(sliding[:, 2], 0.02, rtol=1e-6)


def test_inertia_of_the_trunk_grows_with_its_mass(env: Any) -> None:
    trunk = index(env, "body", "trunk")
    drawn = drawing.draws(env)["base_mass"]
    model = env.sim.mj_model
    inertia = env.sim.model.body_inertia[:, trunk].numpy()
    expected = np.outer(drawn / BODY.base_mass, model.body_inertia[trunk])
    np.testing.assert_allclose(inertia, expected, rtol=1e-5)
    # Derived constants follow, and no other body changes.
    whole = env.sim.model.body_subtreemass[:, trunk].numpy()
    np.testing.assert_allclose(whole, drawn + BODY.total_mass - BODY.base_mass, rtol=1e-5)
    others = [i for i in range(model.nbody) if i != trunk]
    masses = env.sim.model.body_mass.numpy()[:, others]
    np.testing.assert_array_equal(masses, np.tile(np.float32(model.body_mass[others]), (ROBOTS, 1)))


def test_foot_is_where_the_length_of_its_shank_puts_it(env: Any) -> None:
    data = env.sim.data
    for leg, length in zip(BODY.legs, drawing.draws(env)["shank_length"].T, strict=True):
        thigh, shank = (index(env, "body", f"{leg}_{part}") for part in ("thigh", "shank"))
        foot = index(env, "geom", f"{leg}_foot_collision")
        capsule = index(env, "geom", f"{leg}_shank_collision")
        site = index(env, "site", f"{leg}_foot")
        # Default pose: thigh .8 rad back, shank .8 rad forward, both from the vertical.
        drop = (data.xpos[:, thigh, 2] - data.geom_xpos[:, foot, 2]).numpy()
        np.testing.assert_allclose(drop, (BODY.thigh_length + length) * math.cos(0.8), atol=1e-5)
        np.testing.assert_allclose(data.site_xpos[:, site], data.geom_xpos[:, foot], atol=1e-6)
        # The capsule of the shank begins 2 cm below the knee and ends 3 cm above the foot.
        centre = (data.geom_xpos[:, capsule] - data.xpos[:, shank]).norm(dim=-1).numpy()
        half = env.sim.model.geom_size[:, capsule, 1].numpy()
        np.testing.assert_allclose(centre - half, 0.02, atol=1e-5)
        np.testing.assert_allclose(centre + half, length - 0.03, atol=1e-5)
        # What the broad phase takes for its size is its size.
        np.testing.assert_allclose(env.sim.model.geom_rbound[:, capsule], half + 0.01, atol=1e-6)
        bounds = env.sim.model.geom_aabb[:, capsule, 1].numpy()
        np.testing.assert_allclose(bounds[:, :2], 0.01, atol=1e-6)
        np.testing.assert_allclose(bounds[:, 2], half + 0.01, atol=1e-6)


def test_drives_pull_with_the_gains_that_were_drawn(env: Any) -> None:
    """Torque of the last physics step = drawn stiffness and damping on what it found."""
    env.cfg.decimation = 1
    action = torch.rand(ROBOTS, 12) - 0.5
    robot = env.scene["robot"]
    for _ in range(4):  # past every delay
        position, velocity = robot.data.joint_pos.clone(), robot.data.joint_vel.clone()
        env.step(action)
        env.cfg.decimation = 1
    found = drawing.draws(env)
    target = robot.data.default_joint_pos + 0.35 * action
    asked = found["stiffness"] * (target - position).numpy() - found["damping"] * velocity.numpy()
    torque = robot.data.qfrc_actuator.numpy()
    np.testing.assert_allclose(torque, asked, atol=1e-4)
    assert np.abs(asked).max() < 17.0, "no limit in play"


@pytest.mark.parametrize("shape", ["box", "ellipsoid"])
def test_shapes_of_gain_draws(shape: Any) -> None:
    torch.manual_seed(1)
    knee = MATCHED.groups["knee"]
    x = drawing.sample_gains(knee, shape, 4000, "cpu").numpy().astype(np.float64)
    if shape == "box":
        assert_uniform(x[:, 0], 20.5, 22.5)
        assert_uniform(x[:, 1], 0.5, 0.6)
        return
    from_center = x - np.array(knee.ellipsoid_center)
    inverse = np.linalg.inv(np.array(knee.ellipsoid))
    area = np.einsum("ni,ij,nj->n", from_center, inverse, from_center)
    assert_uniform(area, 0.0, 1.0)  # share of the ellipse's area within: uniform in the ellipse
    # Uniform in {x^T E^-1 x <= 1} has covariance E / 4.
    np.testing.assert_allclose(np.cov(x.T), np.array(knee.ellipsoid) / 4, rtol=0.1)


def test_ellipsoids_that_are_none_are_refused() -> None:
    randomization = Randomization(gains="ellipsoid")
    with pytest.raises(PronkError, match="matched gains have no ellipsoid for hip_roll"):
        events(CHEETAH, MATCHED, randomization)
    wide = replace(
        MATCHED.groups["knee"], ellipsoid=((1.0, 0.0), (0.0, 1.0)), ellipsoid_center=(20.0, 0.5)
    )
    gains = replace(MATCHED, groups=dict.fromkeys(CHEETAH.groups, wide))
    with pytest.raises(PronkError, match=r"stiffness 19 and damping -0\.5; both must stay above"):
        events(CHEETAH, gains, randomization)


def test_episodes_begin_about_the_initial_state(env: Any) -> None:
    robot, origins = env.scene["robot"], env.scene.env_origins
    states = []
    everyone = torch.arange(ROBOTS)
    for _ in range(10):
        drawing.draw_start(env, everyone, place=0.5, speed=0.3, heading=math.pi, joints=0.1)
        qpos = env.sim.data.qpos.clone()
        qpos[:, :3] -= origins
        states.append(torch.cat([qpos, env.sim.data.qvel.clone()], dim=1))
    start = torch.cat(states).numpy().astype(np.float64)
    quaternion, velocity = start[:, 3:7], start[:, 19:]
    np.testing.assert_allclose(start[:, 2], robot.data.default_root_state[0, 2], rtol=1e-6)
    np.testing.assert_allclose(quaternion[:, 1:3], 0.0)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, rtol=1e-6)
    assert_uniform(2.0 * np.arctan2(quaternion[:, 3], quaternion[:, 0]), -math.pi, math.pi)
    default = robot.data.default_joint_pos[0].numpy()
    for axis in (0, 1):
        assert_uniform(start[:, axis], -0.5, 0.5)
        assert_uniform(velocity[:, axis], -0.3, 0.3)
    assert_uniform(start[:, 7:19] - default, -0.1, 0.1)
    np.testing.assert_array_equal(velocity[:, 2:], 0.0)
    before = env.sim.data.qpos.clone()
    drawing.draw_start(env, everyone[::2], place=0.5, speed=0.3, heading=math.pi, joints=0.1)
    same = (env.sim.data.qpos == before).all(dim=1)
    assert same.tolist() == [False, True] * (ROBOTS // 2)


# --- Per episode ----------------------------------------------------------------------------------


def test_delay_is_drawn_per_episode(env: Any) -> None:
    first = drawing.draws(env)["delay"]
    assert Counter(first).keys() == {0, 1, 2}, "5.5 ms is one step, +- 1"
    assert chisquare([Counter(first)[i] for i in range(3)]).pvalue > 1e-3
    for _ in range(5):
        env.step(torch.zeros(ROBOTS, 12))
    half = torch.arange(0, ROBOTS, 2)
    env.reset(env_ids=half)
    for _ in range(3):
        env.step(torch.zeros(ROBOTS, 12))
    second = drawing.draws(env)["delay"]
    np.testing.assert_array_equal(second[1::2], first[1::2])
    changed = (second[::2] != first[::2]).mean()
    assert 0.4 < changed < 0.95, "two of three draws differ from the one before"


def test_delay_holds_every_joint_back_alike(env: Any) -> None:
    """A step of the command reaches all joints of a robot after its delay, and not before."""
    robot = env.scene["robot"]
    delay = drawing.draws(env)["delay"]
    action = torch.full((ROBOTS, 12), 0.3)
    for step in range(3):
        env.cfg.decimation = 1
        position, velocity = robot.data.joint_pos.clone(), robot.data.joint_vel.clone()
        env.step(action)
        found = drawing.draws(env)
        arrived = (delay <= step)[:, None]
        target = robot.data.default_joint_pos.numpy() + np.where(arrived, 0.35 * 0.3, 0.0)
        asked = found["stiffness"] * (target - position.numpy())
        asked -= found["damping"] * velocity.numpy()
        np.testing.assert_allclose(robot.data.qfrc_actuator.numpy(), asked, atol=1e-4)
    assert set(delay) == {0.0, 1.0, 2.0}


@pytest.mark.parametrize("delay", [(0, 0), (0, 2), (1, 3), (2, 7)])
def test_targets_arrive_a_delay_after_they_were_issued(env: Any, delay: tuple[int, int]) -> None:
    """Against a list of all targets, for policy steps of any length and a reset on the way."""
    term = held(delay).build(env)
    robot = env.scene["robot"].data
    default = robot.default_joint_pos
    term.reset()
    issued = [default] * (delay[1] + 1)
    """The newest target at each physics step so far."""
    generator = np.random.default_rng(3)
    robots = torch.arange(ROBOTS)
    for step in range(40):
        if step == 25:
            half = robots[::2]
            robot.joint_pos_target[half] = 0.0  # as a reset of the entity does
            term.reset(half)
            for past in issued:
                past[half] = default[half]
        action = torch.tensor(generator.normal(size=(ROBOTS, 12)), dtype=torch.float32)
        term.process_actions(action)
        for _ in range(generator.integers(1, 7)):
            issued.append(default + 0.35 * action)
            term.apply_actions()
            then = len(issued) - 1 - term.lag[:, 0]
            torch.testing.assert_close(robot.joint_pos_target, torch.stack(issued)[then, robots])
    assert set(term.lag[:, 0].tolist()) == set(range(delay[0], delay[1] + 1))


@pytest.mark.parametrize("delay", [(2, 1), (-1, 1)])
def test_delays_that_are_none_are_refused(delay: tuple[int, int]) -> None:
    with pytest.raises(PronkError, match="it must not fall nor be negative"):
        held(delay)


def test_centre_of_the_delay_is_the_matched_one() -> None:
    paper, none = Randomization.paper(), Randomization.none()
    assert delay_steps(CHEETAH, MATCHED, paper) == (0, 2)
    assert delay_steps(CHEETAH, MATCHED, none) == (1, 1)
    assert delay_steps(CHEETAH, replace(MATCHED, delay_s=0.0), paper) == (0, 1)
    assert delay_steps(CHEETAH, replace(MATCHED, delay_s=0.0135), paper) == (2, 4)


# --- Per step -------------------------------------------------------------------------------------


def test_length_of_the_policy_step_is_drawn_each_step(env: Any) -> None:
    seen = []
    for _ in range(12):
        before = env._sim_step_counter
        planned = env.cfg.decimation
        env.step(torch.zeros(ROBOTS, 12))
        assert env._sim_step_counter - before == planned
        seen.append(planned)
    assert set(seen) <= {2, 3, 4, 5, 6}
    assert len(set(seen)) > 2
    # A resumed run restores the counter and asks again: the same draw.
    planned, env.cfg.decimation = env.cfg.decimation, 4
    event = env.event_manager.get_term_cfg("decimation")
    event.func(env, None, **event.params)
    assert env.cfg.decimation == planned


def test_lengths_of_policy_steps_are_uniform_and_independent() -> None:
    fake = SimpleNamespace(cfg=SimpleNamespace(decimation=0), common_step_counter=0)
    lengths = []
    for fake.common_step_counter in range(5000):
        drawing.draw_decimation(fake, None, 4, (-2, 2))
        lengths.append(fake.cfg.decimation)
    counts = Counter(lengths)
    assert set(counts) == {2, 3, 4, 5, 6}
    assert chisquare(list(counts.values())).pvalue > 1e-3
    pairs = Counter(itertools.pairwise(lengths))
    assert chisquare([pairs[a, b] for a in range(2, 7) for b in range(2, 7)]).pvalue > 1e-3


def test_pushes_change_the_velocity_of_the_trunk_mildly(env: Any) -> None:
    push = env.event_manager.get_term_cfg("push")
    assert push.interval_range_s == (5.0, 10.0)
    before = env.sim.data.qvel.clone()
    half = torch.arange(0, ROBOTS, 2)
    push.func(env, half, **push.params)
    change = (env.sim.data.qvel - before).numpy()
    np.testing.assert_array_equal(change[1::2], 0.0)
    np.testing.assert_array_equal(change[:, 6:], 0.0)
    for axis in (0, 1, 5):
        assert_uniform(change[::2, axis].astype(np.float64), -0.3, 0.3)
    np.testing.assert_allclose(change[:, 2:5], 0.0, atol=1e-6)


# --- Nothing drawn, and what is refused -----------------------------------------------------------


def test_none_is_the_nominal_robot() -> None:
    naive = training_gains("naive", CHEETAH)
    assert events(CHEETAH, naive, Randomization.none()) == {}
    assert set(noise(Randomization.none()).values()) == {None}
    env = free_robots(naive, Randomization.none(), 2)
    env.reset()
    env.step(torch.zeros(2, 12))
    assert env.cfg.decimation == 4
    assert not env.sim.expanded_fields
    found = drawing.draws(env)
    nominal = {
        "friction": 0.8,
        "base_mass": BODY.base_mass,
        "shank_length": BODY.shank_length,
        "stiffness": 17.0,
        "damping": 0.4,
        "delay": 0.0,
        "no_load": 1.0,
        "drop": 0.0,
    }
    shapes = {"shank_length": (2, 4), "stiffness": (2, 12), "damping": (2, 12)}
    assert found.keys() == nominal.keys()
    for name, value in nominal.items():
        assert found[name].shape == shapes.get(name, (2,))
        np.testing.assert_allclose(found[name], value, rtol=1e-6)


def test_noise_has_the_widths_of_the_paper() -> None:
    found = noise(Randomization.paper())
    widths = {"position": 0.05, "velocity": 0.5, "angular_velocity": 0.2, "gravity": 0.05}
    assert found.keys() == widths.keys()
    for name, width in widths.items():
        term = found[name]
        assert term is not None
        assert (term.n_min, term.n_max) == (-width, width)
        measured = torch.full((1000, 3), 2.0)
        seen = term.apply(measured).numpy().astype(np.float64)
        assert_uniform(seen - 2.0, -width, width)
        torch.testing.assert_close(measured, torch.full((1000, 3), 2.0), msg="left as it was")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"friction": (3.0, 0.05)}, "friction 3.0 to 0.05; a range must not fall"),
        ({"friction": (0.0, 1.0)}, r"friction begins at 0.0; it must be positive"),
        ({"shank_length": (-0.1, 0.2)}, "shank_length begins at -0.1"),
        ({"delay": -1}, "delay is -1; it must not be negative"),
        ({"bus_voltage": (0.0, 25.0)}, "bus_voltage begins at 0.0; it must be positive"),
        ({"bus_resistance": (-0.1, 0.1)}, "bus_resistance begins at -0.1; it must not be negative"),
        ({"gravity_noise": float("nan")}, "gravity_noise is nan"),
        ({"gains": "sphere"}, "'sphere'; choose box, ellipsoid or off"),
    ],
)
def test_impossible_ranges_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(PronkError, match=message):
        Randomization(**change)


def test_policy_step_without_physics_is_refused() -> None:
    with pytest.raises(PronkError, match="decimation 4 with -4 added leaves a policy step"):
        events(CHEETAH, MATCHED, Randomization(decimation=(-4, 2)))


def test_trunk_without_mass_is_refused(env: Any) -> None:
    base = env.event_manager.get_term_cfg("base_mass").params["base"]
    with pytest.raises(PronkError, match=r"trunk of 6\.\d+ kg is drawn with -7 kg added"):
        drawing.draw_base_mass(env, None, (-7.0, 1.0), base)
