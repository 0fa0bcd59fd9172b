"""The virtual robot of joints from grams to fifty kilograms, derived from the robot's own file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plain_mujoco import motion_in_mujoco
from pronk.errors import RobotError
from pronk.identify.excitation.plan import make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.jump.virtual.plant import Plant, legs_of
from pronk.jump.virtual.robot import TIMESTEP_S, VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from sized_joint import JOINT, SIZES, Size, sized_robot

SIGNAL = Chirp(length_s=4.0)
RATE_HZ = 1000.0


def exact(params: SimParams) -> SimParams:
    """Return the parameters with sensors and clocks without errors."""
    machine = replace(
        params.machine,
        encoder_bits=30,
        position_noise=0.0,
        sampling_jitter_s=0.0,
        timestamp_error_s=0.0,
        measurement_delay_s=0.0,
        command_delay_s=0.0,
    )
    return replace(params, machine=machine)


@pytest.mark.parametrize("name", SIZES)
def test_a_joint_of_any_size_moves_as_in_plain_mujoco(name: str, tmp_path: Path) -> None:
    robot = sized_robot(SIZES[name], tmp_path)
    params = load_sim_params(None, robot)
    plan = make_plan(robot, [JOINT], SIGNAL, amplitudes=(0.25,), repeats=1)
    signal = replace(SIGNAL, amplitude=plan.fitting_amplitude(JOINT))
    offsets = signal.samples(50.0)
    machine = VirtualRobot(robot, exact(params), log_rate_hz=RATE_HZ)
    machine.connect()
    hold = hold_of(robot)
    column = robot.joint_names.index(JOINT)
    positions = []
    for tick, offset in enumerate(offsets):
        position = np.array(hold.position)
        position[column] += offset
        machine.send(replace(hold, position=position))
        for state in machine.wait((tick + 1) / 50.0):
            positions.append(float(state.position[column]))
    # The motors give what `torque_scale` says more than their drives compute.
    joints = []
    for joint in robot.joints:
        scale = params.joints[joint.name].torque_scale
        stronger = replace(joint, stiffness=scale * joint.stiffness, damping=scale * joint.damping)
        joints.append(stronger)
    motion = motion_in_mujoco(replace(robot, joints=tuple(joints)), JOINT, offsets)
    steps = round(1.0 / (RATE_HZ * motion.timestep_s))
    excited = len(offsets) * round(1.0 / (50.0 * motion.timestep_s))
    reference = motion.position[-excited::steps][1:]
    difference = np.array(positions)[: len(reference)] - reference
    assert np.std(difference) < 0.06 * np.std(reference)


def drawn_size(generator: np.random.Generator) -> Size:
    """Draw a joint: any size, natural frequency, damping and armature."""
    mass = float(np.exp(generator.uniform(np.log(0.001), np.log(100.0))))
    length = float(np.exp(generator.uniform(np.log(0.01), np.log(1.0))))
    armature = float(generator.choice([0.0, generator.uniform(0.0, 3.0)])) * mass * length**2
    inertia = mass * length**2 / 3.0 + armature
    frequency = float(np.exp(generator.uniform(np.log(1.0), np.log(200.0))))
    stiffness = (2.0 * np.pi * frequency) ** 2 * inertia
    damping_ratio = float(np.exp(generator.uniform(np.log(0.1), np.log(100.0))))
    return Size(
        mass=mass,
        length=length,
        stiffness=stiffness,
        damping=2.0 * damping_ratio * float(np.sqrt(stiffness * inertia)),
        # From a tight limit to one that a file has for none.
        effort_limit=stiffness * float(np.exp(generator.uniform(np.log(0.1), np.log(1000.0)))),
        armature=armature,
        frictionloss=float(generator.choice([0.0, 0.01])) * stiffness,
        links=int(generator.integers(1, 4)),
    )


@pytest.mark.parametrize("seed", range(25))
def test_a_virtual_robot_of_any_size_holds_its_pose(seed: int, tmp_path: Path) -> None:
    size = drawn_size(np.random.default_rng([41, seed]))
    robot = sized_robot(size, tmp_path)
    machine = VirtualRobot(robot, load_sim_params(None, robot))
    machine.connect()
    states = machine.wait(0.5)
    positions = np.array([state.position for state in states])
    pose = np.array(hold_of(robot).position)
    # Weight, friction and the encoder's offset move it from its pose, and then it is still, or
    # swings the less the longer it does.
    weight = size.mass * 9.81 * size.length * size.links**2
    sag = weight / size.stiffness
    assert np.abs(positions - pose).max() < sag + 0.02
    assert np.std(positions[-100:], axis=0).max() < 0.2 * sag + 2e-3


@pytest.mark.parametrize("name", ["mini_cheetah", "go2", "so101"])
def test_robots_of_ordinary_size_keep_the_ordinary_step(name: str) -> None:
    robot = load_robot(name)
    limbs = legs_of(robot)[:1]
    plant = Plant(robot, load_sim_params(None, robot), limbs, TIMESTEP_S)
    assert plant.largest_timestep >= TIMESTEP_S


def test_a_belt_that_holds_no_link_is_refused(tmp_path: Path) -> None:
    robot: RobotSpec = sized_robot(SIZES["servo"], tmp_path)
    params = load_sim_params(None, robot)
    joint = replace(params.joints[JOINT], belt_stiffness=1e-3)
    soft = replace(params, joints={**params.joints, JOINT: joint})
    with pytest.raises(RobotError, match="belt_stiffness"):
        VirtualRobot(robot, soft)


def test_a_light_link_on_a_motor_of_a_large_joint_is_stable_at_the_bus_voltage(
    tmp_path: Path,
) -> None:
    """A URDF states torque and speed of a large motor at a link of grams."""
    light = Size(mass=0.01, length=0.05, stiffness=0.05, damping=0.0006, effort_limit=50.0, links=2)
    robot = sized_robot(light, tmp_path)
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=replace(joint.drive, no_load_speed=0.5)))
    robot = replace(robot, joints=tuple(joints))
    machine = VirtualRobot(robot, load_sim_params(None, robot))
    machine.connect()
    hold = hold_of(robot)
    target = np.array(hold.position) + 0.3  # approached far faster than at 0.5 rad/s
    machine.send(replace(hold, position=target))
    fall = machine.wait(0.5)
    rest = machine.wait(1.5)[-50:]
    speeds = np.array([state.velocity for state in fall])
    assert np.abs(speeds).max() < 20.0
    positions = np.array([state.position for state in rest])
    assert np.abs(positions.mean(axis=0) - target).max() < 0.25
    assert np.std(positions, axis=0).max() < 5e-3


SPRING = """\
<mujoco model="spring">
  <worldbody>
    <body name="link">
      <inertial pos="0 0 0" mass="1" diaginertia="0.05 0.05 0.05"/>
      <joint name="bend" axis="0 1 0" range="-90 90" limited="true" stiffness="20" damping="0.5"
        armature="0.01" springref="0"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="bend" kp="40" kv="2" forcerange="-40 40"/>
  </actuator>
</mujoco>
"""


def test_a_spring_of_the_models_joint_stays_with_the_virtual_robot(tmp_path: Path) -> None:
    """Of a command that stands still a joint on a spring takes k / (k + k_spring)."""
    path = tmp_path / "spring.xml"
    path.write_text(SPRING)
    robot = load_robot(str(path))
    params = load_sim_params(None, robot)
    machine = VirtualRobot(robot, exact(params))
    machine.connect()
    hold = hold_of(robot)
    machine.send(replace(hold, position=np.array([0.3])))
    states = machine.wait(3.0)[-100:]
    stiffness = 40.0 * params.joints["bend"].torque_scale
    position = np.mean([state.position[0] for state in states])
    assert position == pytest.approx(0.3 * stiffness / (stiffness + 20.0), abs=0.004)
    # A fixture holds the link against its spring, and releases it.
    machine.clamp(("bend",))
    machine.send(replace(hold, position=np.array([0.0])))
    clamped = np.mean([state.position[0] for state in machine.wait(4.0)[-100:]])
    assert clamped == pytest.approx(position, abs=0.01)
    machine.clamp(())
    released = np.mean([state.position[0] for state in machine.wait(6.0)[-100:]])
    assert released == pytest.approx(0.0, abs=0.004)


# Arms as URDFs state them: a large motor, a low speed limit, and no rotor.
ARMS = {
    "shoulder": Size(mass=4.0, length=0.28, stiffness=345.0, damping=21.0, effort_limit=330.0),
    "hobby servo": Size(mass=0.05, length=0.4, stiffness=1.77, damping=0.131, effort_limit=30.0),
}


@pytest.mark.parametrize(("name", "speed"), [("shoulder", 2.16), ("hobby servo", 1.0)])
def test_a_sweep_that_fits_the_plan_does_not_end_at_the_speed_limit(
    name: str, speed: float, tmp_path: Path
) -> None:
    robot = sized_robot(ARMS[name], tmp_path)
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=replace(joint.drive, no_load_speed=speed)))
    robot = replace(robot, joints=tuple(joints))
    signal = Chirp(length_s=6.0, start_hz=1.0, stop_hz=10.0)
    plan = make_plan(robot, [JOINT], signal, amplitudes=(0.25,), repeats=1)
    amplitude = plan.fitting_amplitude(JOINT)
    assert amplitude < 0.25
    machine = VirtualRobot(robot, load_sim_params(None, robot))
    machine.connect()
    hold = hold_of(robot)
    speeds = []
    for tick, offset in enumerate(replace(signal, amplitude=amplitude).samples(50.0)):
        machine.send(replace(hold, position=np.array(hold.position) + offset))
        for state in machine.wait((tick + 1) / 50.0):
            speeds.append(abs(float(state.velocity[0])))
    assert 0.6 * speed < max(speeds) < speed


@pytest.mark.parametrize("stiffness", [2.5e-11, 0.05, 9000.0])
def test_friction_leaves_a_small_sweep_to_the_drive(stiffness: float, tmp_path: Path) -> None:
    """Dry friction that no file states is a few percent of the torque of 0.04 rad."""
    size = Size(mass=0.02, length=0.05, stiffness=stiffness, damping=0.0, effort_limit=1e4)
    robot = sized_robot(size, tmp_path)
    joint = load_sim_params(None, robot).joints[JOINT]
    assert 0.0 < joint.breakaway <= 0.05 * 0.04 * stiffness
    assert joint.presliding_stiffness > 0.0
