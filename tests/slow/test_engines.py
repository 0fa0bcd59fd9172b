"""Drive laws beside the real engines of `examples/engines`, where they are installed.

With ENGINE_PYTHON=PATH the engines run in that Python, as with `--simulator-python`: MJX, Newton,
Genesis and ovphysx too (docs/evidence/simulators.md has the results).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.load import load_simulator
from pronk.identify.simulators.mujoco import Chain
from pronk.identify.simulators.simulator import Closing, Simulator
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

EXAMPLES = Path(__file__).parents[2] / "examples"
PENDULUM = EXAMPLES / "pendulum"
BAND = (1.0, 15.0)
E = DriveLaw()
EXPLICIT_PASSIVE = DriveLaw(passive_damping="explicit")
IF = DriveLaw(kind="implicit_damping")
I1 = DriveLaw(kind="implicit", iterations=1)
I4 = DriveLaw(kind="implicit", iterations=4)
I10 = DriveLaw(kind="implicit", iterations=10)


@dataclass(frozen=True, kw_only=True)
class Engine:
    """A class of `examples/engines`."""

    file: str
    name: str
    module: str
    """What is imported to see whether the engine is installed."""
    laws: tuple[DriveLaw, ...]
    """Laws that are compared with the engine."""

    @property
    def choice(self) -> str:
        """The value of `--simulator`."""
        return f"{EXAMPLES / 'engines' / self.file}:{self.name}"


SAPIEN = Engine(file="sapien.py", name="Sapien", module="sapien", laws=(E, I1, I4, I10))
OVPHYSX = Engine(file="ovphysx.py", name="OvPhysx", module="ovphysx", laws=(E, I1, I4))
DRAKE = Engine(file="drake.py", name="Drake", module="pydrake", laws=(E, I1))
PYBULLET = Engine(file="pybullet.py", name="PyBullet", module="pybullet", laws=(EXPLICIT_PASSIVE,))
MUJOCO = Engine(file="mjx.py", name="Mujoco", module="mujoco", laws=(E, EXPLICIT_PASSIVE, IF))
MJX = Engine(file="mjx.py", name="Mjx", module="mujoco.mjx", laws=(E, EXPLICIT_PASSIVE, IF))
GENESIS = Engine(file="genesis.py", name="Genesis", module="genesis", laws=(E, IF))
NEWTON = Engine(file="newton.py", name="Newton", module="newton", laws=(EXPLICIT_PASSIVE, IF, I1))
ENGINES = (SAPIEN, OVPHYSX, DRAKE, PYBULLET, MUJOCO, MJX, GENESIS, NEWTON)
CASES = [(engine, law) for engine in ENGINES for law in engine.laws]
NAMES = [f"{engine.name}-{law.label}-{law.passive_damping}" for engine, law in CASES]
all_engines_and_laws = pytest.mark.parametrize(("engine", "law"), CASES, ids=NAMES)


def prepared(name: str | Path, law: DriveLaw, **drive: float) -> RobotSpec:
    """A robot with a law, without dry friction and limits; `drive` replaces values of drives."""
    robot = load_robot(name)
    linear = {"frictionloss": 0.0, "effort_limit": 1e4, "stall_torque": 1e4, "no_load_speed": 1e4}
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=replace(joint.drive, **linear | drive)))
    return replace(robot, law=law, joints=tuple(joints))


def chirp(step: float, *, amplitude: float = 0.25, seconds: float = 20.0) -> Array:
    """0.1 to 25 Hz, held for 20 ms."""
    time = 0.02 * np.arange(round(seconds / 0.02))
    wave = amplitude * np.sin(2.0 * np.pi * (0.1 + 24.9 / (2.0 * seconds) * time) * time)
    return np.repeat(wave, round(0.02 / step))


def made(engine: Engine, robot: RobotSpec) -> Simulator:
    """The engine's simulator of a robot, in the Python that ENGINE_PYTHON names, or this one."""
    other_python = os.environ.get("ENGINE_PYTHON")
    if other_python is None:
        pytest.importorskip(engine.module, reason=f"{engine.name} is not installed")
        return load_simulator(engine.choice, robot)
    try:
        return load_simulator(engine.choice, robot, python=Path(other_python))
    except PronkError as error:
        pytest.skip(str(error))


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Runs of a chain of n joints by its law and by an engine, all of shape (T, n)."""

    joints: tuple[str, ...]
    command: Array
    by_law: Array
    by_engine: Array


def compared(engine: Engine, robot: RobotSpec, joint: str, wave: Array) -> Compared:
    """Command one joint of a robot by a wave about its default position [rad], shape (T,)."""
    simulator = made(engine, robot)
    default = [robot_joint.default_position for robot_joint in robot.joints]
    command = np.tile(default, (len(wave), 1))
    command[:, robot.joint_names.index(joint)] += wave
    with Chain(robot, joint, threads=1) as chain:
        joints = chain.joints
        columns = [robot.joint_names.index(name) for name in joints]
        by_law = chain.rollout(command[None][..., columns])[0, :-1]
    locked = [name for name in robot.joint_names if name != joint]
    by_engine = simulator.rollout(command[None], {}, locked=locked)[0]
    if isinstance(simulator, Closing):
        simulator.close()
    return Compared(
        joints=joints,
        command=command[:, columns],
        by_law=by_law,
        by_engine=by_engine[:, columns],
    )


def level(command: Array, position: Array, step: float) -> Array:
    """Magnitude of the response to a chirp in half-hertz bins of BAND [dB]."""
    u = np.fft.rfft(command - command[0], 1 << 15)
    y = np.fft.rfft(position - position[0], 1 << 15)
    hertz = np.fft.rfftfreq(1 << 15, step)
    ratios = []
    for centre in np.arange(*BAND, 0.5):
        near = np.abs(hertz - centre) <= 0.25
        ratios.append(abs(np.vdot(u[near], y[near])) / np.vdot(u[near], u[near]).real)
    return np.asarray(20.0 * np.log10(ratios))


@all_engines_and_laws
def test_one_joint_follows_the_law(engine: Engine, law: DriveLaw) -> None:
    robot = prepared(PENDULUM, law)
    step = robot.timestep_s
    runs = compared(engine, robot, "swing", chirp(step))
    law_db = level(runs.command[:, 0], runs.by_law[:, 0], step)
    engine_db = level(runs.command[:, 0], runs.by_engine[:, 0], step)
    assert np.ptp(law_db) > 5.0
    assert np.abs(engine_db - law_db).max() < 0.02
    for omega in (2.0 * np.pi * 3.0, 2.0 * np.pi * 8.0):
        time = step * np.arange(800)
        runs = compared(engine, robot, "swing", 0.25 * np.sin(omega * time))
        spin = np.exp(-1j * omega * time[400:])
        ratio = (runs.by_engine[400:, 0] @ spin) / (runs.by_law[400:, 0] @ spin)
        assert abs(20.0 * np.log10(abs(ratio))) < 0.02
        assert abs(np.angle(ratio)) < 1e-3


@all_engines_and_laws
@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_leg_with_held_joints(name: str, engine: Engine, law: DriveLaw) -> None:
    robot = prepared(name, law)
    if engine is PYBULLET:  # No armature in chains: stable at 1 ms.
        robot = prepared(name, law, rotor_inertia=0.0)
        robot = replace(robot, timestep_s=0.001, decimation=20)
    elif engine is NEWTON and law.kind == "implicit":  # Steel's passive damping is explicit.
        robot = prepared(name, law, viscous_damping=0.0)
    step = robot.timestep_s
    runs = compared(engine, robot, "FR_hip_pitch", chirp(step))
    assert len(runs.joints) == 3
    # PhysX solves joint by joint, the others all joints of a chain at once, as the law does.
    exact = law.kind != "implicit" or engine not in (SAPIEN, OVPHYSX)
    command = runs.command[:, runs.joints.index("FR_hip_pitch")]
    for column, joint in enumerate(runs.joints):
        engine_db = level(command, runs.by_engine[:, column], step)
        law_db = level(command, runs.by_law[:, column], step)
        if exact:
            assert np.abs(engine_db - law_db).max() < 0.01, joint
        elif joint == "FR_hip_pitch":
            assert np.abs(engine_db - law_db).max() < 0.1, joint
        else:  # Joints that follow, as a share of the command's amplitude.
            difference = 10.0 ** (engine_db / 20.0) - 10.0 ** (law_db / 20.0)
            assert np.abs(difference).max() < 0.02, joint


@pytest.mark.parametrize("engine", [SAPIEN, OVPHYSX, DRAKE, PYBULLET], ids=lambda e: e.name)
def test_explicit_drives_have_the_motors_limits(engine: Engine) -> None:
    law = engine.laws[0]
    wave = chirp(0.005, seconds=4.0)
    # The motor's limits are those of its torque alone, without passive damping.
    limited = prepared(
        PENDULUM,
        law,
        effort_limit=1.0,
        stall_torque=1.4,
        no_load_speed=12.0,
        viscous_damping=0.1,
    )
    limited_runs = compared(engine, limited, "swing", wave)
    free_runs = compared(engine, prepared(PENDULUM, law, viscous_damping=0.1), "swing", wave)
    assert np.abs(limited_runs.by_law - free_runs.by_law).max() > 0.02
    assert np.abs(limited_runs.by_law - limited_runs.by_engine).max() < 1e-4


@pytest.mark.parametrize("engine", [SAPIEN, DRAKE, PYBULLET, MUJOCO], ids=lambda e: e.name)
def test_parameters_of_each_run_are_set(engine: Engine) -> None:
    robot = prepared(PENDULUM, E)
    simulator = made(engine, robot)
    command = np.tile(chirp(0.005, seconds=4.0)[None, :, None], (2, 1, 1))
    values = {
        "stiffness": np.array([[12.0], [20.0]]),
        "damping": np.array([[0.3], [0.5]]),
        "armature": np.array([[0.01], [0.002]]),
    }
    delay = np.array([[0.0], [0.01]])
    positions = simulator.rollout(command, {**values, "delay": delay})
    command[1] = np.pad(command[1], ((2, 0), (0, 0)))[:-2]
    with Chain(robot, "swing", threads=1) as chain:
        expected = chain.rollout(command, values)[:, :-1]
    assert np.abs(positions - expected).max() < 1e-4
    if "frictionloss" not in simulator.parameters:
        with pytest.raises(PronkError, match="frictionloss"):
            simulator.rollout(command, {"frictionloss": np.zeros((2, 1))})


@all_engines_and_laws
def test_dry_friction_is_a_torque_where_the_engine_has_it(engine: Engine, law: DriveLaw) -> None:
    with_friction = prepared(PENDULUM, law, frictionloss=0.3)
    if "frictionloss" not in made(engine, with_friction).parameters:
        pytest.skip("no dry friction in N m")
    wave = chirp(0.005, seconds=8.0)
    free_runs = compared(engine, prepared(PENDULUM, law), "swing", wave)
    runs = compared(engine, with_friction, "swing", wave)
    free_db = level(runs.command[:, 0], free_runs.by_law[:, 0], 0.005)
    law_db = level(runs.command[:, 0], runs.by_law[:, 0], 0.005)
    engine_db = level(runs.command[:, 0], runs.by_engine[:, 0], 0.005)
    assert np.abs(law_db - free_db).max() > 0.7
    largest_difference = 0.01
    if engine is PYBULLET:  # Its friction holds a joint at rest.
        largest_difference = 0.25
    elif engine is GENESIS:  # Its friction is less soft than MuJoCo's, which is the law's.
        largest_difference = 0.4
    assert np.abs(engine_db - law_db).max() < largest_difference


def test_pybullet_refuses_a_chain_with_armature() -> None:
    robot = load_robot("mini_cheetah")
    simulator = made(PYBULLET, robot)
    command = np.zeros((1, 2, len(robot.joints)))
    with pytest.raises(PronkError, match="armature"):
        simulator.rollout(command, {})
