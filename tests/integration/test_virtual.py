"""The virtual robot on the bench: time stepping, drives, delays, sensors, clamps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

from pronk.arrays import Array
from pronk.errors import HardwareError, RobotError
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams
from pronk.robots.machine import Command, State
from virtual_robot import (
    POSE,
    ROBOT,
    SIM_PARAMS,
    connected,
    gains,
    quiet,
    with_fixture,
    with_joints,
)

NAMES = ROBOT.joint_names
TICK = 0.02
# A stiff battery and encoders without a grid.
IDEAL = {"bus_resistance": 0.0, "encoder_bits": 32}


def bench(
    sim_params: SimParams = SIM_PARAMS, legs: tuple[str, ...] | None = ("FR",), **options: Any
) -> VirtualRobot:
    """Return a connected robot on the bench, by default one leg of it."""
    return connected(sim_params, legs=legs, **options)


def offset(joint: str, value: float) -> Array:
    """Return the default pose with one joint elsewhere [rad]."""
    position = POSE.copy()
    position[NAMES.index(joint)] += value
    return position


def excite(machine: VirtualRobot, joint: str, command: Array) -> list[State]:
    """Command a joint offsets from the default pose, one a tick; return the states met."""
    states = [machine.latest()]
    start = machine.latest().time
    for k, value in enumerate(command):
        machine.send(Command(position=offset(joint, float(value)), **gains()))
        states += machine.wait(start + (k + 1) * TICK)
    return states


def column(states: list[State], joint: str) -> Array:
    """Return the positions of a joint [rad]."""
    index = NAMES.index(joint)
    return np.array([state.position[index] for state in states])


def chirp(seconds: float, amplitude: float = 0.25) -> Array:
    t = np.arange(round(seconds / TICK)) * TICK
    return amplitude * signal.chirp(t, 0.1, seconds, 25.0, phi=-90.0)


def gain_db(command: Array, position: Array, per_tick: int) -> tuple[Array, Array]:
    """Compute H1 of the stepped command and the position, with its frequencies up to 15 Hz."""
    steps = np.repeat(command, per_tick)
    rate = per_tick / TICK
    segment = round(2.0 * rate)
    overlap = round(1.5 * rate)
    hz, cross_spectrum = signal.csd(
        steps, position[: len(steps)], fs=rate, nperseg=segment, noverlap=overlap
    )
    _, spectrum = signal.welch(steps, fs=rate, nperseg=segment, noverlap=overlap)
    in_band = (hz > 0.0) & (hz <= 15.0)
    return hz[in_band], 20.0 * np.log10(np.abs(cross_spectrum / spectrum)[in_band])


# --- Physics ------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", ["FR_hip_roll", "FR_hip_pitch", "FR_knee"])
def test_the_step_has_converged_to_40_khz(joint: str) -> None:
    command = chirp(6.0)
    coarse = excite(bench(quiet(**IDEAL), timestep_s=0.25e-3), joint, command)
    fine = excite(bench(quiet(**IDEAL), timestep_s=0.025e-3), joint, command)
    _, coarse_gain = gain_db(command, column(coarse, joint), 10)
    _, fine_gain = gain_db(command, column(fine, joint), 10)
    assert np.abs(coarse_gain - fine_gain).max() < 0.05


def test_response_of_an_ideal_joint_is_its_closed_form() -> None:
    joint = "FR_knee"
    scale = 1.2
    drive = ROBOT.joint(joint).drive
    sim_params = with_joints(
        with_fixture(quiet(**IDEAL, drive_lag_s=1e-5), clamp_stiffness=9e4),
        joint,
        torque_scale=scale,
        coulomb=1e-6,
        breakaway=1e-6,
        presliding_stiffness=1e-3,
        presliding_damping=0.0,
        viscous=0.05,
        belt_stiffness=2500.0,
        belt_damping=0.0,
        encoder_offset=0.0,
    )
    machine = bench(sim_params)
    machine.clamp(ROBOT.joint(joint).clamped)
    command = chirp(20.0)
    position = column(excite(machine, joint, command), joint)
    hz, measured = gain_db(command, position, 10)
    # I = reflected rotor + shank about the knee (its own inertia and Steiner's term).
    model = ROBOT.build_spec().compile()
    body = model.jnt_bodyid[model.joint(joint).id]
    arm = np.hypot(model.body_ipos[body][0], model.body_ipos[body][2])
    shank = model.body_inertia[body].max() + model.body_mass[body] * arm**2
    params = sim_params.joints[joint]
    inertia = params.rotor_inertia * drive.gear_ratio**2 + shank * params.link_inertia_scale
    s = 2j * np.pi * hz
    stiffness = scale * 17.0
    damping = scale * 0.4 + 0.05
    equation = stiffness / (inertia * s**2 + damping * s + stiffness)
    middle = (hz > 1.0) & (hz < 15.0)
    error = measured - 20.0 * np.log10(np.abs(equation))
    assert np.abs(error[middle]).max() < 0.1


def test_dry_friction_holds_a_joint_that_is_commanded_too_softly() -> None:
    machine = bench(with_joints(quiet(**IDEAL), "FR_knee", coulomb=0.4, breakaway=0.5))
    before = machine.latest().position[2]
    step = 0.2 / 17.0  # of 0.2 N m through 17 N m/rad, well below break-away
    small = excite(machine, "FR_knee", np.full(25, step))[-1].position[2] - before
    assert 0.0 < small < 0.3 * step
    large = excite(machine, "FR_knee", np.full(25, 0.3))[-1].position[2] - before
    assert large > 0.8 * 0.3


# --- Drives -------------------------------------------------------------------------------------


def test_torque_stays_below_the_torque_speed_line_and_the_effort_limit() -> None:
    # A hard step at a low bus voltage: the drive wants far more than the motor can give. A heavy
    # rotor and a prompt drive, so that torque and speed belong to the same instant.
    voltage = 12.0
    sim_params = quiet(**IDEAL, bus_voltage=voltage, drive_lag_s=1e-5)
    sim_params = with_joints(sim_params, "FR_knee", rotor_inertia=1e-3)
    machine = bench(sim_params, log_rate_hz=2000.0)
    machine.send(Command(position=offset("FR_knee", -2.0), **gains(300.0, 0.1)))
    states = machine.wait(0.2)
    drive = ROBOT.joint("FR_knee").drive
    scale = sim_params.joints["FR_knee"].torque_scale
    measured_torque = []
    measured_speed = []
    for state in states:
        measured_torque.append(state.torque[2])
        measured_speed.append(state.velocity[2])
    torque = scale * np.array(measured_torque)
    speed = np.array(measured_speed)
    believed, resistance = drive.motor
    constant = scale * believed
    line = -constant / resistance * (voltage + constant * speed)
    slack = 0.02 * np.abs(line).max()  # one physics step of acceleration
    assert (torque >= line - slack).all()
    assert (np.abs(torque) <= scale * drive.effort_limit * (1.0 + 1e-9)).all()
    # Both limits were met, and the line held the joint below its no-load speed.
    assert np.isclose(np.abs(torque).max(), scale * drive.effort_limit)
    fast = speed < -0.7 * voltage / constant
    assert fast.any()
    assert (torque[fast] > -0.6 * scale * drive.effort_limit).all()
    assert speed.min() > -voltage / constant


def test_reported_torque_is_what_the_drive_believes() -> None:
    changes = {"torque_scale": 1.25, "coulomb": 1e-6, "breakaway": 1e-6}
    state = bench(with_joints(quiet(**IDEAL), "FR_hip_pitch", **changes)).wait(0.1)[-1]
    believed = 17.0 * (POSE[1] - state.position[1])
    assert abs(state.torque[1]) > 0.02
    np.testing.assert_allclose(state.torque[1], believed, rtol=1e-3)


def test_battery_sags_with_the_power_drawn_and_never_gives_more_than_it_can() -> None:
    full = SIM_PARAMS.machine.bus_voltage
    assert lowest_voltage(resistance=0.2) < full - 1.0
    # A battery's power is largest at half its voltage.
    assert lowest_voltage(resistance=5.0) == 0.5 * full


def lowest_voltage(resistance: float) -> float:
    """Return the lowest bus voltage while a drive draws all the power that it can [V]."""
    machine = bench(quiet(bus_resistance=resistance))
    full = SIM_PARAMS.machine.bus_voltage
    assert machine.latest().bus_voltage == pytest.approx(full, abs=0.5)
    machine.send(Command(position=offset("FR_hip_roll", 1.0), **gains(100.0, 2.0)))
    return min(state.bus_voltage for state in machine.wait(0.1))


# --- Time ---------------------------------------------------------------------------------------


def test_delays_shift_the_response() -> None:
    command = chirp(1.0)
    delayed = quiet(**IDEAL, command_delay_s=0.004, measurement_delay_s=0.002)
    prompt = column(excite(bench(quiet(**IDEAL)), "FR_knee", command), "FR_knee")
    late = column(excite(bench(delayed), "FR_knee", command), "FR_knee")
    np.testing.assert_allclose(late[3:], prompt[:-3], atol=1e-6)
    assert np.abs(late - prompt).max() > 1e-3


def test_timestamps_jitter_increase_and_lose_nothing() -> None:
    machine = bench()
    times = []
    sequence = []
    for state in (machine.latest(), *machine.wait(4.0)):
        times.append(state.time)
        sequence.append(state.sequence)
    time = np.array(times)
    assert time[0] == 0.0
    assert sequence == list(range(2001))
    assert (np.diff(time) > 0.0).all()
    jitter = np.std(time - np.arange(2001) / 500.0)
    assert 0.8 * 51e-6 < jitter < 1.2 * 51e-6  # 50 us and 10 us


def test_connecting_again_starts_anew_and_a_past_time_brings_no_states() -> None:
    machine = bench()
    first = excite(machine, "FR_knee", np.full(5, 0.1))
    machine.clamp(("FR_knee",))
    machine.close()
    machine.connect()
    again = excite(machine, "FR_knee", np.full(5, 0.1))
    assert np.array_equal(column(first, "FR_knee"), column(again, "FR_knee"))
    assert machine.wait(machine.now()) == machine.wait(0.05) == []
    assert len(machine.wait(machine.now() + 0.002)) == 1


# --- Sensors ------------------------------------------------------------------------------------


def test_positions_lie_on_the_grid_of_the_encoder() -> None:
    machine = bench(replace(SIM_PARAMS, machine=replace(SIM_PARAMS.machine, encoder_bits=10)))
    states = excite(machine, "FR_knee", chirp(2.0))
    for joint in NAMES[:3]:
        grid = 2.0 * np.pi / 2**10 / ROBOT.joint(joint).drive.gear_ratio
        steps = column(states, joint) / grid
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert len(set(column(states, "FR_knee"))) > 20


def test_position_noise_has_its_size_and_corner() -> None:
    sim_params = quiet(**IDEAL, position_noise=1e-3, position_noise_corner_hz=10.0)
    noise = column(bench(sim_params).wait(60.0), "FR_hip_roll")
    noise = noise - noise.mean()
    assert np.std(noise) == pytest.approx(1e-3, rel=0.1)
    neighbours = float(noise[1:] @ noise[:-1] / (noise @ noise))
    assert neighbours == pytest.approx(np.exp(-2.0 * np.pi * 10.0 / 500.0), abs=0.02)


def test_inertial_unit_measures_gravity_and_its_bias() -> None:
    sim_params = quiet(**IDEAL)
    imu = replace(sim_params.imu, gyro_bias=(0.1, 0.2, 0.3), accelerometer_bias=(0.4, 0.5, 0.6))
    state = bench(replace(sim_params, imu=imu)).latest()
    np.testing.assert_allclose(state.gyro, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(state.accelerometer, [0.4, 0.5, 0.6 + 9.81])
    # And the motion of a compliant stand.
    compliant = with_fixture(quiet(**IDEAL), stand_stiffness=500.0, stand_damping=5.0)
    machine = bench(compliant, legs=None)
    states = excite(machine, "FR_hip_pitch", chirp(3.0))
    rate = np.array([state.gyro for state in states])
    assert np.abs(rate[:, 1]).max() > 0.05
    assert np.abs(rate[0]).max() < 1e-2


# --- Bench --------------------------------------------------------------------------------------


def test_clamp_holds_a_link_but_no_fixture_is_rigid() -> None:
    joint = "FR_hip_pitch"
    machine = bench(quiet(**IDEAL))
    machine.clamp((joint,))
    start = machine.latest().position[1]
    clamped_motion = excite(machine, joint, np.full(25, 0.2))[-1].position[1] - start
    # Torque through belt and fixture in series, the drive's own stiffness beside them.
    params = SIM_PARAMS.joints[joint]
    torque = 17.0 * params.torque_scale * 0.2
    deflection = torque / SIM_PARAMS.fixture.clamp_stiffness + torque / params.belt_stiffness
    assert 0.5 * deflection < clamped_motion < 1.1 * deflection
    machine.clamp(())
    free_motion = excite(machine, joint, np.full(50, 0.2))[-1].position[1] - start
    assert free_motion > 0.15


def test_legs_on_a_rigid_bench_are_independent() -> None:
    command = chirp(1.0)
    alone = excite(bench(quiet(**IDEAL), legs=("FR",)), "FR_knee", command)
    together = excite(bench(quiet(**IDEAL), legs=None), "FR_knee", command)
    np.testing.assert_allclose(
        column(alone, "FR_knee"), column(together, "FR_knee"), rtol=0.0, atol=1e-9
    )
    # Absent legs report their default pose; present ones sag under their weight.
    assert column(alone, "HL_hip_roll")[-1] == POSE[NAMES.index("HL_hip_roll")]
    assert column(together, "HL_hip_roll")[-1] != POSE[NAMES.index("HL_hip_roll")]
    for state in alone:
        assert len(state.position) == 12


def test_mirrored_legs_mirror_each_other_when_their_parameters_agree() -> None:
    same = replace(SIM_PARAMS.joints["FR_hip_roll"], encoder_offset=0.0)
    sim_params = replace(quiet(**IDEAL), joints=dict.fromkeys(NAMES, same))
    command = chirp(1.0)
    right_states = excite(bench(sim_params, legs=None), "FR_hip_roll", command)
    left_states = excite(bench(sim_params, legs=None), "FL_hip_roll", -command)
    right_position = column(right_states, "FR_hip_roll")
    left_position = column(left_states, "FL_hip_roll")
    np.testing.assert_allclose(left_position, -right_position, atol=1e-6)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda m: m.clamp(("tail",)), "tail"),
        (lambda m: m.wait(float("nan")), "nan"),
        (lambda m: m.send(Command(position=POSE[:3], **gains())), "position"),
        (lambda m: m.send(Command(position=POSE, **gains(), made=float("nan"))), "made"),
        (lambda m: m.send(Command(position=POSE, **gains(), valid_for=0.0)), "valid_for"),
    ],
)
def test_refusals(act: Any, words: str) -> None:
    with pytest.raises((HardwareError, RobotError), match=words):
        act(bench())
    with pytest.raises(HardwareError, match="connect"):
        act(VirtualRobot(ROBOT, SIM_PARAMS))
