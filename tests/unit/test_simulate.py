"""Simulators: command traces, trajectories of the training simulator, the protocol."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import LogError, PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.segment import Segment
from pronk.identify.match.match import match
from pronk.identify.match.predict import predict
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.load import joint_rigs, load_simulator
from pronk.identify.simulators.mujoco import JointTestRig, MujocoSimulator
from pronk.identify.simulators.simulator import RolloutRigs
from pronk.robots import load_robot
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec
from pronk.testing import check_simulator
from synthetic_log import Excitation, simulate, synthetic_log

ROBOT = load_robot("mini_cheetah")
EXAMPLE = f"{Path(__file__).parents[2] / 'examples' / 'my_simulator.py'}:Pendulum"
POSE = np.array([joint.default_position for joint in ROBOT.joints])


def trace_of(joint: str, offsets: np.ndarray, robot: RobotSpec = ROBOT) -> CommandTrace:
    centre = robot.joint(joint).default_position
    return CommandTrace(
        joint=joint,
        start=0.0,
        timestep=robot.timestep_s,
        command=centre + np.repeat(offsets, robot.decimation),
        pose=POSE,
        amplitude=float(np.abs(offsets).max()),
    )


def short_chirp(amplitude: float = 0.25) -> np.ndarray:
    return Chirp(length_s=4.0, amplitude=amplitude).samples()


@pytest.mark.parametrize("joint", ["FR_hip_pitch", "FR_knee"])
def test_positions_are_those_of_the_bench_model_stepped_from_rest(joint: str) -> None:
    trace = trace_of(joint, short_chirp(0.5))
    simulated = simulate(ROBOT, trace, 20.0, 0.5)[0]
    model = bench_spec(ROBOT, joint, stiffness={joint: 20.0}, damping={joint: 0.5}).compile()
    data = mujoco.MjData(model)
    key = model.key("default")
    chain = ROBOT.joint(joint).chain
    kp = np.array([20.0 if name == joint else ROBOT.joint(name).stiffness for name in chain])
    # Begin where the match begins: at rest, gravity carried by the drives.
    data.qpos[:] = key.qpos
    for _ in range(8):
        mujoco.mj_forward(model, data)
        data.qpos[:] = key.qpos - data.qfrc_bias / kp
    data.ctrl[:] = key.ctrl
    positions = []
    for command in trace.command:
        data.ctrl[chain.index(joint)] = command
        positions.append(data.qpos[chain.index(joint)])
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(simulated, positions, atol=1e-6)


def test_a_mirrored_joint_is_simulated_by_its_original() -> None:
    alone = replace(ROBOT, joints=tuple(replace(joint, mirror=None) for joint in ROBOT.joints))
    for joint in ("FL_hip_roll", "HL_hip_pitch", "HR_knee", "HR_hip_roll"):
        trace = trace_of(joint, short_chirp())
        by_mirror = simulate(ROBOT, trace, 18.0, 0.45)
        itself = simulate(alone, trace, 18.0, 0.45)
        np.testing.assert_allclose(by_mirror, itself, atol=2e-6)


def test_chunks_and_threads_change_nothing() -> None:
    trace = trace_of("FR_hip_pitch", short_chirp())
    stiffness = np.linspace(14, 26, 7)
    damping = np.linspace(0.2, 0.6, 7)
    values = {"stiffness": stiffness, "damping": damping}
    in_chunks = np.empty((7, len(trace.command)))
    with JointTestRig(ROBOT, "FR_hip_pitch", chunk=3) as rig:
        for part, position in rig.run([trace], values, len(trace.command)):
            in_chunks[part] = position
    alone = simulate(ROBOT, trace, stiffness[4], damping[4], threads=1)[0]
    centre = ROBOT.joint("FR_hip_pitch").default_position
    np.testing.assert_array_equal(in_chunks[4] + centre, alone)


def test_armature_and_friction_are_the_drives_unless_given() -> None:
    trace = trace_of("FR_knee", short_chirp())
    drive = ROBOT.joint("FR_knee").drive
    by_default = simulate(ROBOT, trace, 20.0, 0.5)
    with_values = simulate(
        ROBOT, trace, 20.0, 0.5, armature=drive.armature, frictionloss=drive.frictionloss
    )
    np.testing.assert_array_equal(by_default, with_values)


def log_of(time: np.ndarray, command: np.ndarray) -> JointLog:
    joints = ("FR_knee",)
    segment = Segment(kind="chirp", joints=joints, amplitude=0.25, start=time[0], stop=time[-1])
    return JointLog(
        robot="mini_cheetah",
        joints=joints,
        time=time,
        command=command[:, None],
        position=0.5 * command[:, None],
        segments=(segment,),
    )


@given(
    seed=st.integers(0, 10_000),
    offset=st.floats(0.0, 100.0),
    rate=st.sampled_from([500.0, 1000.0, 476.0]),
)
@settings(max_examples=25, deadline=None)
def test_jitter_does_not_move_a_tick(seed: int, offset: float, rate: float) -> None:
    rng = np.random.default_rng(seed)
    ticks = 1.6 + 0.25 * rng.standard_normal(100)
    exact = offset + np.arange(int(2.0 * rate)) / rate
    command = ticks[np.minimum(((exact - offset) / 0.02 + 1e-6).astype(int), 99)]
    log = log_of(exact + 50e-6 * rng.uniform(-1, 1, len(exact)), command)
    trace = command_trace(log.excitations("FR_knee")[0], ROBOT)
    assert trace.uncertain_s[0] < 1.5 / rate
    assert len(trace.command) >= 395
    np.testing.assert_array_equal(trace.command, np.repeat(ticks, 4)[: len(trace.command)])
    assert abs(trace.start - offset) < 0.0025


def test_repeats_are_alike_at_any_tick_that_the_log_begins_in() -> None:
    ticks = 1.6 + np.concatenate([np.zeros(25), short_chirp(), np.zeros(20)])
    command = np.repeat(ticks, 10)
    trace = []
    for caught in (0, 7, 13):
        log = log_of(0.002 * np.arange(len(command))[caught:], command[caught:])
        trace.append(command_trace(log.excitations("FR_knee")[0], ROBOT))
    longer = replace(trace[0], command=np.append(trace[0].command, np.full(8, 1.6)))
    moved = replace(trace[0], command=np.append(trace[0].command, np.full(8, 1.7)))
    for same in (trace[1], trace[2], longer, replace(trace[0], joint="HL_knee")):
        assert trace[0].same_as(same, ROBOT)
        assert same.same_as(trace[0], ROBOT)
    for other in (moved, replace(trace[0], joint="FR_hip_pitch")):
        assert not other.same_as(trace[0], ROBOT)
    # A mirrored roll is the same simulation the other way round.
    right = trace_of("FR_hip_roll", short_chirp())
    assert not trace_of("FL_hip_roll", short_chirp()).same_as(right, ROBOT)
    assert trace_of("FL_hip_roll", -short_chirp()).same_as(right, ROBOT)
    assert trace_of("HR_hip_roll", short_chirp()).same_as(right, ROBOT)


@given(
    rate=st.sampled_from([20.0, 30.0, 47.5, 60.0, 75.0, 100.0, 150.0, 190.0, 250.0, 500.0]),
    log_rate=st.sampled_from([500.0, 476.0, 1000.0]),
    phase=st.floats(0.0, 1.0),
    jitter=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_commands_at_any_rate_have_their_own_instants(
    rate: float, log_rate: float, phase: float, jitter: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    count = int(4.0 * rate)
    sent = (1.0 + np.arange(count) + phase + jitter * rng.uniform(-0.5, 0.5, count)) / rate
    values = 1.6 + np.where(sent < 0.5, 0.0, 0.2 * np.sin(2.0 * np.pi * 2.0 * sent**1.2))
    time_ = np.arange(int(3.9 * log_rate)) / log_rate
    time_ += 20e-6 * rng.uniform(-1.0, 1.0, len(time_))
    logged = values[np.maximum(np.searchsorted(sent, time_, side="right") - 1, 0)]
    trace = command_trace(log_of(time_, logged).excitations("FR_knee")[0], ROBOT)
    # The integral of the command is that of the commands as they were sent: none was dropped, and
    # none came earlier or later than the log leaves open.
    fine = np.arange(0.2, 3.7, 1e-4)
    as_sent = values[np.maximum(np.searchsorted(sent, fine, side="right") - 1, 0)]
    simulated = trace.command[((fine - trace.start) / trace.timestep).astype(int)]
    integral = np.cumsum(as_sent - simulated) * 1e-4
    earlier, later = trace.uncertain_s
    step_rad = np.abs(np.diff(values)).max()
    allowed = 0.4 * (max(earlier, later) + 1.05 / log_rate) + trace.timestep * step_rad
    assert np.abs(integral).max() < allowed
    if rate < 200.0:
        assert len(np.unique(trace.command.round(9))) >= 0.95 * len(np.unique(logged.round(9)))


def test_a_segment_that_cannot_be_simulated_is_refused() -> None:
    time_ = np.arange(0.0, 2.0, 0.002)
    log = log_of(time_, 1.6 + 0.2 * np.sin(time_))
    wide = replace(
        log,
        joints=("FR_knee", "FR_hip_pitch"),
        command=np.repeat(log.command, 2, axis=1) * [1.0, 0.0],
        position=np.repeat(log.position, 2, axis=1) * [1.0, 0.0],
        pose=np.array([1.6, 0.0]),
    )
    for bad, joint, words in (
        (log, "FR_hip_roll", r"FR_hip_roll.*FR_knee"),
        (replace(log, units=("unknown",)), "FR_knee", "radians"),
        (wide, "FR_knee", "FR_hip_pitch was clamped"),
    ):
        with pytest.raises(LogError, match=words):
            command_trace(bad.excitations(joint)[0], ROBOT)


# --- the protocol ---------------------------------------------------------------------------------


def test_simulators_keep_the_protocol_and_a_check_names_the_rule_that_is_broken() -> None:
    check_simulator(load_simulator("mujoco", ROBOT))
    simulator = load_simulator(EXAMPLE, ROBOT)
    check_simulator(simulator)
    simulator.parameters = simulator.parameters | {"mass"}
    with pytest.raises(PronkError, match="mass"):
        check_simulator(simulator)


@pytest.mark.parametrize("joint", ["FR_knee", "FR_hip_pitch"])
def test_a_rollout_of_mujoco_gives_the_positions_of_its_rig(joint: str) -> None:
    chirp = Excitation(offsets=Chirp(length_s=2.0).samples())
    with MujocoSimulator(ROBOT) as simulator:
        rigs = RolloutRigs(simulator, ROBOT)
        logs = [
            synthetic_log(ROBOT, joint, [chirp], 20.0, 0.5, simulator=s) for s in (simulator, rigs)
        ]
    np.testing.assert_allclose(logs[0].position, logs[1].position, atol=1e-9)


def test_gains_matched_in_another_simulator_are_those_it_was_swept_with() -> None:
    chirp = Excitation(offsets=Chirp(length_s=8.0).samples())
    rigs = joint_rigs(EXAMPLE, ROBOT)
    log = synthetic_log(ROBOT, "FR_knee", [chirp], 19.3, 0.41, simulator=rigs)
    gains = match([log], ROBOT, EXAMPLE).gains
    knee = gains.joints["FR_knee"]
    assert knee.stiffness.value == pytest.approx(19.3, rel=2e-3)
    assert knee.damping.value == pytest.approx(0.41, rel=5e-3)
    assert gains.simulator == rigs.info
    replay = predict(log, ROBOT, gains, simulator=EXAMPLE).joints[0]
    assert replay.rmse_matched < 0.1 * replay.rmse_nominal


@pytest.mark.parametrize(
    ("choice", "named"),
    [
        ("bullet", "mujoco"),
        ("missing.py:Pendulum", "missing.py"),
        (EXAMPLE.replace("Pendulum", "Cart"), "Pendulum"),
    ],
)
def test_an_unknown_simulator_is_refused(choice: str, named: str) -> None:
    with pytest.raises(PronkError, match=named):
        load_simulator(choice, ROBOT)
