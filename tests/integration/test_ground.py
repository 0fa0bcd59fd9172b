"""The virtual robot off the bench: contact, free flight, inertial unit, commands that expire."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pronk.arrays import Array
from pronk.errors import HardwareError, RobotError
from pronk.jump.virtual.ground import Box, Ground, Start
from pronk.jump.virtual.physics import CommandQueue, Physics
from pronk.jump.virtual.plant import Plant, legs_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sensors import about_z, moving_force, of_vector, product, turned_back
from pronk.jump.virtual.sim_params import AttitudeParams, SimParams, TrunkParams, load_sim_params
from pronk.robots import load_robot
from pronk.robots.machine import Command, State
from virtual_robot import POSE, ROBOT, SIM_PARAMS, connected, gains, quiet, with_joints

ARM = load_robot("so101")
GRAVITY = 9.81
STEP = 0.25e-3


def frictionless() -> SimParams:
    """Return parameters with nothing that takes energy away."""
    return with_joints(
        quiet(),
        presliding_stiffness=1e-3,
        presliding_damping=0.0,
        viscous=0.0,
        belt_damping=0.0,
        coulomb=1e-9,
        breakaway=1e-9,
    )


def aligned(sim_params: SimParams) -> SimParams:
    """Remove the encoders' offsets, so that in free fall the drives have nothing to correct."""
    return with_joints(sim_params, encoder_offset=0.0)


def standing(sim_params: SimParams = SIM_PARAMS, **options: Any) -> VirtualRobot:
    """Return a connected robot on the ground."""
    return connected(sim_params, base="ground", **options)


def hold(position: Array = POSE, **options: Any) -> Command:
    """Return a command of a pose."""
    return Command(position=position, **gains(), **options)


def falling(sim_params: SimParams, **options: Any) -> VirtualRobot:
    """Return a connected robot 2 m over the ground."""
    return standing(sim_params, start=Start(drop=2.0, settle_s=0.0), **options)


def down(state: State) -> Array:
    """Return the direction of gravity in the trunk's frame, as the machine reports it."""
    attitude = Rotation.from_quat(state.orientation, scalar_first=True)
    return np.asarray(attitude.inv().apply([0.0, 0.0, -1.0]))


# --- Contact of one foot, by itself -------------------------------------------------------------


def ball(ground: Ground, mass: float = 2.0) -> tuple[Any, Any]:
    """Let a point mass with a foot, which can only shift, down on the ground."""
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP
    ground.add_to(spec)
    body = spec.worldbody.add_body(name="ball", mass=mass, inertia=(1, 1, 1), explicitinertial=True)
    for axis in np.eye(3):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    body.add_geom(
        name="foot",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(0.02, 0.0, 0.0),
        priority=1,
        mass=0.0,
    )
    model = spec.compile()
    ground.set_contact(model, np.array([model.geom("foot").id]))
    data = mujoco.MjData(model)
    data.qpos[2] = 0.02 - mass * GRAVITY / ground.stiffness
    return model, data


def test_a_foot_sinks_in_by_its_load_over_the_stiffness() -> None:
    model, data = ball(Ground(stiffness=20e3))
    data.qpos[2] = 0.02
    mujoco.mj_step(model, data, 8000)
    assert 0.02 - data.qpos[2] == pytest.approx(2.0 * GRAVITY / 20e3, rel=1e-6)


def test_a_pressed_foot_swings_with_its_own_mass_added() -> None:
    ground = Ground(stiffness=20e3, damping=1.0)
    model, data = ball(ground)
    data.qpos[2] += 1e-4
    height = []
    for _ in range(2000):
        mujoco.mj_step(model, data)
        height.append(data.qpos[2])
    swing = np.array(height) - np.mean(height)
    upward_crossings = np.flatnonzero((swing[1:] > 0.0) & (swing[:-1] <= 0.0))
    period = STEP * np.diff(upward_crossings).mean()
    # The added mass at an impedance of one half is 1 / A, the mass of the body.
    assert 2.0 * math.pi / period == pytest.approx(math.sqrt(20e3 / 4.0), rel=0.02)


def test_a_sliding_foot_slows_down_by_friction_and_a_sticking_one_stays() -> None:
    ground = Ground(friction=0.6)
    model, data = ball(ground)
    data.qvel[0] = 2.0
    mujoco.mj_step(model, data, 400)
    mujoco.mj_forward(model, data)
    assert data.qfrc_constraint[0] == pytest.approx(-0.6 * data.qfrc_constraint[2], rel=1e-4)
    assert data.qvel[0] == pytest.approx(2.0 - 0.6 * GRAVITY * 0.1, rel=0.03)
    mujoco.mj_step(model, data, 2000)
    start = data.qpos[0]
    data.qfrc_applied[0] = 0.9 * 0.6 * 2.0 * GRAVITY
    mujoco.mj_step(model, data, 4000)
    assert abs(data.qpos[0] - start) < 1e-3
    data.qfrc_applied[0] = 1.2 * 0.6 * 2.0 * GRAVITY
    mujoco.mj_step(model, data, 4000)
    assert data.qpos[0] - start == pytest.approx(0.5 * 0.2 * 0.6 * GRAVITY, rel=0.03)


# --- Standing -----------------------------------------------------------------------------------


def test_robot_stands_still_without_a_command() -> None:
    machine = standing(quiet())
    state = machine.wait(2.0)[-1]
    seen = machine.capture()
    assert seen.contact.all()
    assert not seen.other_contact.any()
    assert np.ptp(seen.position, axis=0).max() < 0.01
    assert 0.22 < seen.position[:, 2].min() < 0.31
    # Feet creep a little where they are loaded sideways, and no more.
    assert np.ptp(seen.foot_position, axis=0).max() < 0.004
    # They sink in by the weight over their stiffness.
    model = Plant(ROBOT, SIM_PARAMS, legs_of(ROBOT), STEP, Ground()).model
    sunk = (0.0175 - seen.foot_position[-1, :, 2]).sum()
    weight = model.body_mass.sum() * GRAVITY
    assert sunk * SIM_PARAMS.ground.stiffness == pytest.approx(weight, rel=0.06)
    np.testing.assert_allclose(state.accelerometer, -GRAVITY * down(state), atol=0.05)
    # The parameters' trunk leans, so this is no test of (0, 0, g).
    assert abs(down(state)[0]) > 1e-4


def test_start_pose() -> None:
    offset = tuple(np.linspace(-0.1, 0.1, 12))
    start = Start(position=(1.0, -2.0), yaw=2.0, joint_offset=offset, settle_s=0.0)
    seen = standing(quiet(), start=start).snapshot()
    np.testing.assert_allclose(seen.position[0, :2], [1.0, -2.0], atol=1e-12)
    turned = Rotation.from_quat(seen.orientation[0], scalar_first=True)
    np.testing.assert_allclose(turned.as_rotvec(), [0.0, 0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(seen.joint_position[0], POSE + offset, atol=1e-12)
    assert seen.foot_position[0, :, 2].min() == pytest.approx(0.0175, abs=1e-12)


def test_it_stands_on_blocks_over_a_gap() -> None:
    near = Box(center=(-1.0, 0.0, -0.1), half_size=(1.0, 1.0, 0.1))
    far = Box(center=(1.6, 0.0, -0.05), half_size=(1.0, 1.0, 0.1))
    ground = replace(SIM_PARAMS.ground, floor=-0.5, terrain=(near, far))
    assert ground.height(-0.5, 0.0) == 0.0
    assert ground.height(0.3, 0.0) == -0.5
    assert ground.height(1.0, 0.5) == pytest.approx(0.05)
    machine = standing(quiet(), ground=ground, start=Start(position=(1.5, 0.0)))
    seen = machine.snapshot()
    assert seen.contact.all()
    assert seen.foot_position[0, :, 2].mean() == pytest.approx(0.05 + 0.0175, abs=0.002)
    # Half over the edge it tips into the gap.
    machine = standing(quiet(), ground=ground, start=Start(position=(0.6, 0.0), settle_s=0.0))
    machine.wait(1.5)
    seen = machine.capture()
    assert seen.other_contact.any()
    assert seen.foot_position[-1, 2:, 2].max() < 0.0


# --- Free flight --------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [STEP, STEP / 2])
def test_energy_is_conserved_without_drives_and_contacts(step: float) -> None:
    sim_params = frictionless()
    plant = Plant(ROBOT, sim_params, legs_of(ROBOT), step, Ground())
    physics = Physics(plant, sim_params.machine, pose=POSE, first_step=0)
    physics.apply(Command(position=POSE, **gains(0.0, 0.0)))
    model = plant.model
    data = physics.data
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    rng = np.random.default_rng(5)
    data.qpos[2] = 2.0
    data.qvel[:6] = rng.uniform(-3.0, 3.0, 6)
    data.qvel[plant.link] = rng.uniform(-4.0, 4.0, 12)

    def energy() -> float:
        mujoco.mj_forward(model, data)
        return float(data.energy.sum())

    start_energy = energy()
    changes = []
    for _ in range(40):
        mujoco.mj_step(model, data, round(0.004 / step))
        changes.append(energy() - start_energy)
    kinetic = float(data.energy[1])
    # First order in the step, as MuJoCo's Euler is.
    assert np.abs(changes).max() < 0.02 * kinetic * step / STEP
    assert kinetic > 20.0


def test_in_free_fall_the_accelerometer_reads_zero() -> None:
    machine = falling(aligned(quiet()))
    height = machine.snapshot().position[0, 2]
    states = machine.wait(0.4)
    seen = machine.capture()
    t = seen.time
    # MuJoCo's Euler is symplectic: a step ahead of the parabola, g h t / 2.
    fallen = height - seen.position[:, 2]
    np.testing.assert_allclose(fallen, 0.5 * GRAVITY * t * (t + STEP), atol=1e-9)
    np.testing.assert_allclose(seen.velocity[:, 2], -GRAVITY * t, atol=1e-9)
    assert not seen.contact.any()
    assert max(np.abs(state.accelerometer).max() for state in states) < 1e-6
    assert max(np.abs(state.gyro).max() for state in states) < 1e-9


# --- Inertial unit ------------------------------------------------------------------------------


def test_bias_and_noise_are_as_large_as_their_parameters() -> None:
    sim_params = replace(SIM_PARAMS, imu=replace(SIM_PARAMS.imu, gyro_bias=(0.1, 0.2, 0.3)))
    states = falling(aligned(sim_params)).wait(0.6)
    gyro = np.array([state.gyro for state in states])
    force = np.array([state.accelerometer for state in states[1:]])  # before, it was at rest
    np.testing.assert_allclose(gyro.mean(axis=0), [0.1, 0.2, 0.3], atol=3e-4)
    np.testing.assert_allclose(force.mean(axis=0), SIM_PARAMS.imu.accelerometer_bias, atol=4e-3)
    assert gyro.std() == pytest.approx(math.hypot(0.001, np.std([0.1, 0.2, 0.3])), rel=0.1)
    assert force.std(axis=0).mean() == pytest.approx(0.02, rel=0.1)


def test_attitude_is_off_by_bias_and_wander_and_its_heading_starts_anywhere() -> None:
    attitude = AttitudeParams(bias=(0.05, -0.03, 0.0), noise=0.01, noise_corner_hz=20.0)
    sim_params = replace(quiet(), trunk=TrunkParams())
    headings = []
    for seed in range(3):
        machine = standing(replace(sim_params, attitude=attitude), seed=seed)
        states = machine.wait(1.5)
        true_states = standing(sim_params, seed=seed).wait(1.5)
        # To first order, a small rotation e turns gravity (0, 0, -1) by e x (0, 0, 1).
        gravity = np.array([down(state) for state in states])
        true_gravity = np.array([down(state) for state in true_states])
        error = gravity - true_gravity
        np.testing.assert_allclose(error.mean(axis=0), [-0.03, -0.05, 0.0], atol=0.006)
        assert error[:, :2].std(axis=0).mean() == pytest.approx(0.01, rel=0.3)
        first_attitude = Rotation.from_quat(states[0].orientation, scalar_first=True)
        headings.append(first_attitude.as_euler("ZYX")[0])
    assert np.ptp(headings) > 0.3
    states = falling(replace(aligned(quiet()), attitude=AttitudeParams(yaw_drift=0.2))).wait(0.5)
    start_attitude = Rotation.from_quat(states[0].orientation, scalar_first=True)
    end_attitude = Rotation.from_quat(states[-1].orientation, scalar_first=True)
    drift = (end_attitude * start_attitude.inv()).as_rotvec()
    np.testing.assert_allclose(drift, [0.0, 0.0, 0.2 * 0.498], atol=1e-6)


VECTOR = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3)


@given(VECTOR, VECTOR)
def test_accelerometer_of_a_constant_acceleration(turn: list[float], pull: list[float]) -> None:
    orientation = np.tile(of_vector(np.array([turn])), (4, 1))
    velocity = np.arange(4)[:, None] * 0.1 * np.array(pull)
    force = moving_force(velocity, orientation, 0.01)
    world = 10.0 * np.array(pull) + [0.0, 0.0, GRAVITY]
    expected = Rotation.from_rotvec(turn).inv().apply(world)
    np.testing.assert_allclose(force, np.tile(expected, (3, 1)), atol=1e-9)


@given(VECTOR, VECTOR)
def test_quaternions_agree_with_scipy(first: list[float], second: list[float]) -> None:
    a = Rotation.from_rotvec(first)
    b = Rotation.from_rotvec(second)
    a_quaternion = of_vector(np.array([first]))
    b_quaternion = of_vector(np.array([second]))
    composed = Rotation.from_quat(product(a_quaternion, b_quaternion), scalar_first=True)
    np.testing.assert_allclose(composed.as_matrix()[0], (a * b).as_matrix(), atol=1e-12)
    vector = turned_back(a_quaternion, np.array([second]))[0]
    np.testing.assert_allclose(vector, a.inv().apply(second), atol=1e-9)
    heading = Rotation.from_quat(about_z(np.array(first)), scalar_first=True).as_matrix()
    expected = Rotation.from_euler("z", np.array(first)[:, None]).as_matrix()
    np.testing.assert_allclose(heading, expected, atol=1e-12)


# --- Repeatability ------------------------------------------------------------------------------


def shaken(seed: int, cuts: int) -> tuple[Array, Array]:
    """Return states and capture of a robot that is commanded to bob, time cut into pieces."""
    machine = standing(seed=seed, start=Start(settle_s=0.2))
    states = []
    for k in range(10):
        machine.send(hold(POSE + 0.15 * (-1.0) ** k))
        for cut in range(cuts):
            states += machine.wait(0.02 * k + 0.02 * (cut + 1) / cuts)
    seen = machine.capture()
    rows = []
    for state in states:
        vectors = (state.position, state.gyro, state.accelerometer, state.orientation)
        rows.append(np.concatenate([[state.time], *vectors]))
    columns = np.hstack([seen.position, seen.torque, seen.bus_voltage[:, None]])
    return np.array(rows), columns


def test_results_depend_on_the_seed_and_not_on_the_steps_of_wait() -> None:
    states, seen = shaken(3, 1)
    again = shaken(3, 7)
    assert np.array_equal(states, again[0])
    assert np.array_equal(seen, again[1])
    other = shaken(4, 1)
    assert not np.array_equal(states, other[0])
    # Noise is in the states, not in the robot.
    assert np.array_equal(seen, other[1])


def test_repeated_gains_are_applied_after_others() -> None:
    # It stands again as it would have; with the weak gains still in force it would lie.
    height = height_after((17.0, 17.0, 17.0, 17.0))
    assert height_after((17.0, 3.4, 17.0, 17.0)) == pytest.approx(height, abs=0.01)


def height_after(stiffnesses: tuple[float, ...]) -> float:
    """Return the height of a trunk some time after commands of these gains [m]."""
    machine = standing(quiet(), start=Start(settle_s=0.2))
    for k, stiffness in enumerate(stiffnesses):
        machine.send(Command(position=POSE, **gains(stiffness)))
        machine.wait(0.05 * (k + 1))
    machine.wait(2.0)
    return float(machine.snapshot().position[0, 2])


# --- Commands that expire -----------------------------------------------------------------------


def taken(queue: CommandQueue) -> list[tuple[int, bool]]:
    """Return the steps at which commands take effect, and whether they are damping alone."""
    effects = []
    arrival = queue.take(10**6)
    while arrival is not None:
        step, command = arrival
        effects.append((step, not command.stiffness.any()))
        arrival = queue.take(10**6)
    return effects


def test_commands_arrive_late_and_damping_follows_when_nothing_new_comes() -> None:
    queue = CommandQueue(12, 0.002, 0.001)
    queue.put(hold(made=0.0, valid_for=0.010), 0.0)
    queue.put(hold(made=0.005, valid_for=0.010), 0.005)
    assert queue.soonest == 2
    assert queue.take(2) is None
    # At last made + valid_for + delay.
    assert taken(queue) == [(2, False), (7, False), (17, True)]
    assert queue.soonest == math.inf
    # One that is stale on arrival is followed by damping at once.
    queue.put(hold(made=0.0, valid_for=0.005), 0.020)
    assert taken(queue)[-1][1]


def test_a_command_at_the_expiry_of_the_one_before_is_applied() -> None:
    """It never expires itself."""
    queue = CommandQueue(12, 0.0, 0.001)
    queue.put(hold(made=0.0, valid_for=0.010), 0.0)
    queue.put(hold(made=0.010), 0.010)
    assert taken(queue) == [(0, False), (10, True), (10, False)]


# --- Other bodies -------------------------------------------------------------------------------


def test_a_trunk_with_other_mass_centre_and_inertia() -> None:
    trunk = TrunkParams(
        mass_offset=1.5, com_offset=(0.01, 0.02, -0.03), inertia_scale=(1.1, 0.9, 1.0)
    )
    sim_params = replace(SIM_PARAMS, trunk=trunk)
    model = Plant(ROBOT, sim_params, legs_of(ROBOT), STEP, Ground()).model
    nominal = ROBOT.build_spec().compile()
    nominal_body = nominal.body("trunk")
    body = model.body("trunk")
    mass = float(nominal_body.mass[0])
    assert body.mass[0] == pytest.approx(mass + 1.5)
    np.testing.assert_allclose(body.ipos - nominal_body.ipos, trunk.com_offset, atol=1e-12)

    def tensor(body: Any) -> Array:
        axes = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
        return np.asarray(axes @ np.diag(body.inertia) @ axes.T)

    moments = np.diag(tensor(nominal_body)) * trunk.inertia_scale * (1.0 + 1.5 / mass)
    np.testing.assert_allclose(tensor(body), np.diag(moments), atol=1e-9)


# --- Refusals -----------------------------------------------------------------------------------


def built(sim_params: SimParams = SIM_PARAMS, base: Any = "ground", **options: Any) -> VirtualRobot:
    """Return a robot that is not connected; options are those of `VirtualRobot`."""
    return VirtualRobot(ROBOT, sim_params, base=base, **options)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: built(replace(SIM_PARAMS, trunk=TrunkParams(mass_offset=-20.0))), "mass_offset"),
        (
            lambda: built(replace(SIM_PARAMS, trunk=TrunkParams(inertia_scale=(1.0, 1.0, 3.0)))),
            "inertia_scale",
        ),
        (lambda: built(replace(SIM_PARAMS, ground=Ground(stiffness=5e6))), "stiffness"),
        (lambda: built(base="sky"), "sky"),
        (lambda: built(base="bench", ground=Ground()), "bench"),
        (lambda: built(base="bench", start=Start()), "bench"),
        (lambda: built(legs=("FR",)), "ground"),
        (lambda: built(capture_rate_hz=1e5), "capture_rate_hz"),
        (lambda: built(base="bench", log_rate_hz=5e4), "log_rate_hz"),
        (lambda: built(base="bench", legs=("XL",)), "XL"),
        (lambda: built(base="bench", legs=()), "legs"),
        (lambda: VirtualRobot(ARM, SIM_PARAMS), "so101"),
        (lambda: standing(start=Start(joint_offset=(0.0, 0.0, 0.0))), "joint_offset"),
        (lambda: Start(drop=-1.0), "drop"),
        (lambda: Start(yaw=math.inf), "yaw"),
        (lambda: Box(center=(0.0, 0.0, 0.0), half_size=(1.0, 0.0, 1.0)), "half_size"),
        (lambda: Box(center=(0.0, math.nan, 0.0), half_size=(1.0, 1.0, 1.0)), "center"),
        (lambda: Ground(friction=0.0), "friction"),
        (lambda: VirtualRobot(ARM, load_sim_params(None, ARM), base="ground"), "so101"),
    ],
)
def test_impossible_bodies_and_scenes_are_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises((HardwareError, RobotError), match=words) as caught:
        make()
    assert "\n" not in str(caught.value)
