"""Drive laws beside the real engines: SAPIEN (PhysX), Drake, PyBullet, where installed; MuJoCo.

With ENGINE_PYTHON=PATH the engines run in that Python, as with `--simulator-python`: MJX, Newton,
Genesis and ovphysx too (docs/simulators.md has the results).
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engines.drake import Drake
from pronk.identify.simulators.engines.engine import EngineSimulator
from pronk.identify.simulators.engines.genesis import Genesis
from pronk.identify.simulators.engines.mujoco import Mjx, Mujoco
from pronk.identify.simulators.engines.newton import Newton
from pronk.identify.simulators.engines.ovphysx import OvPhysx
from pronk.identify.simulators.engines.pybullet import PyBullet
from pronk.identify.simulators.engines.sapien import Sapien
from pronk.identify.simulators.load import load_simulator
from pronk.identify.simulators.mujoco import Chain
from pronk.identify.simulators.simulator import Closing
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

PENDULUM = Path(__file__).parents[2] / "examples" / "pendulum"
BAND = (1.0, 15.0)
E, EXPLICIT_PASSIVE = DriveLaw(), DriveLaw(passive_damping="explicit")
IF = DriveLaw(kind="implicit_damping")
I1, I4, I10 = (DriveLaw(kind="implicit", iterations=n) for n in (1, 4, 10))
LAWS: dict[type[EngineSimulator], tuple[DriveLaw, ...]] = {
    Sapien: (E, I1, I4, I10),
    OvPhysx: (E, I1, I4),
    Drake: (E, I1),
    PyBullet: (EXPLICIT_PASSIVE,),
    Mujoco: (E, EXPLICIT_PASSIVE, IF),
    Mjx: (E, EXPLICIT_PASSIVE, IF),
    Genesis: (E, IF),
    Newton: (EXPLICIT_PASSIVE, IF, I1),
}
CASES = [(engine, law) for engine, laws in LAWS.items() for law in laws]
engines = pytest.mark.parametrize(
    ("engine", "law"),
    CASES,
    ids=[f"{one.__name__}-{law.label}-{law.passive_damping}" for one, law in CASES],
)


def prepared(name: str | Path, law: DriveLaw, **drive: float) -> RobotSpec:
    """A robot with a law, without dry friction and limits; `drive` replaces values of drives."""
    robot = load_robot(name)
    linear = {"frictionloss": 0.0, "effort_limit": 1e4, "stall_torque": 1e4, "no_load_speed": 1e4}
    joints = [replace(one, drive=replace(one.drive, **linear | drive)) for one in robot.joints]
    return replace(robot, law=law, joints=tuple(joints))


def chirp(step: float, *, amplitude: float = 0.25, seconds: float = 20.0) -> Array:
    """0.1 to 25 Hz, held for 20 ms."""
    time = 0.02 * np.arange(round(seconds / 0.02))
    wave = amplitude * np.sin(2.0 * np.pi * (0.1 + 24.9 / (2.0 * seconds) * time) * time)
    return np.repeat(wave, round(0.02 / step))


def both(
    engine: type[EngineSimulator], robot: RobotSpec, joint: str, wave: Array
) -> tuple[Array, Array, Array, Sequence[str]]:
    """Command, positions by the law and by the engine, shape (T, n), and the n joints."""
    if other := os.environ.get("ENGINE_PYTHON"):
        choice = f"{inspect.getfile(engine)}:{engine.__name__}"
        try:
            simulator = load_simulator(choice, robot, python=Path(other))
        except PronkError as error:
            pytest.skip(str(error))
    else:
        pytest.importorskip(engine.module, reason=f"{engine.package} is not installed")
        simulator = engine(robot)
    command = np.tile([one.default_position for one in robot.joints], (len(wave), 1))
    command[:, robot.joint_names.index(joint)] += wave
    with Chain(robot, joint, threads=1) as chain:
        columns = [robot.joint_names.index(name) for name in chain.joints]
        expected = chain.rollout(command[None][..., columns], [{}])[0, :-1]
    locked = [name for name in robot.joint_names if name != joint]
    got = simulator.rollout(command[None], {}, locked=locked)[0]
    if isinstance(simulator, Closing):
        simulator.close()
    return command[:, columns], expected, got[:, columns], chain.joints


def level(command: Array, position: Array, step: float) -> Array:
    """Magnitude of the response to a chirp in half-hertz bins of BAND [dB]."""
    u, y = (np.fft.rfft(one - one[0], 1 << 15) for one in (command, position))
    hertz = np.fft.rfftfreq(1 << 15, step)
    bins = [np.abs(hertz - centre) <= 0.25 for centre in np.arange(*BAND, 0.5)]
    ratios = [abs(np.vdot(u[one], y[one])) / np.vdot(u[one], u[one]).real for one in bins]
    return np.asarray(20.0 * np.log10(ratios))


@engines
def test_one_joint_follows_the_law(engine: type[EngineSimulator], law: DriveLaw) -> None:
    robot = prepared(PENDULUM, law)
    step = robot.timestep_s
    command, expected, got, _ = both(engine, robot, "swing", chirp(step))
    law_db = level(command[:, 0], expected[:, 0], step)
    assert np.ptp(law_db) > 5.0
    assert np.abs(level(command[:, 0], got[:, 0], step) - law_db).max() < 0.02
    for omega in (2.0 * np.pi * 3.0, 2.0 * np.pi * 8.0):
        time = step * np.arange(800)
        _, expected, got, _ = both(engine, robot, "swing", 0.25 * np.sin(omega * time))
        spin = np.exp(-1j * omega * time[400:])
        ratio = (got[400:, 0] @ spin) / (expected[400:, 0] @ spin)
        assert abs(20.0 * np.log10(abs(ratio))) < 0.02
        assert abs(np.angle(ratio)) < 1e-3


@engines
@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_leg_with_held_joints(name: str, engine: type[EngineSimulator], law: DriveLaw) -> None:
    robot = prepared(name, law)
    if engine is PyBullet:  # No armature in chains: stable at 1 ms.
        robot = prepared(name, law, rotor_inertia=0.0)
        robot = replace(robot, timestep_s=0.001, decimation=20)
    elif engine is Newton and law.kind == "implicit":  # Steel's passive damping is explicit.
        robot = prepared(name, law, viscous_damping=0.0)
    step = robot.timestep_s
    command, expected, got, joints = both(engine, robot, "FR_hip_pitch", chirp(step))
    assert len(joints) == 3
    # PhysX solves joint by joint, the others all joints of a chain at once, as the law does.
    exact, u = law.kind != "implicit" or engine not in (Sapien, OvPhysx), command[:, 1]
    for k, joint in enumerate(joints):
        ours, law_db = level(u, got[:, k], step), level(u, expected[:, k], step)
        if exact or joint == "FR_hip_pitch":
            assert np.abs(ours - law_db).max() < (0.01 if exact else 0.1), joint
        else:  # Followers: of the command's amplitude.
            assert np.abs(10.0 ** (ours / 20.0) - 10.0 ** (law_db / 20.0)).max() < 0.02, joint


@pytest.mark.parametrize("engine", [Sapien, OvPhysx, Drake, PyBullet])
def test_explicit_drives_have_the_motors_limits(engine: type[EngineSimulator]) -> None:
    limits = {"effort_limit": 1.0, "stall_torque": 1.4, "no_load_speed": 12.0}
    law, wave = LAWS[engine][0], chirp(0.005, seconds=4.0)
    # The motor's limits are those of its torque alone, without passive damping.
    limited = prepared(PENDULUM, law, **limits, viscous_damping=0.1)
    _, expected, got, _ = both(engine, limited, "swing", wave)
    _, free, *_ = both(engine, prepared(PENDULUM, law, viscous_damping=0.1), "swing", wave)
    assert np.abs(expected - free).max() > 0.02
    assert np.abs(expected - got).max() < 1e-4


@pytest.mark.parametrize("engine", [Sapien, Drake, PyBullet, Mujoco])
def test_parameters_of_each_run_are_set(engine: type[EngineSimulator]) -> None:
    pytest.importorskip(engine.module, reason=f"{engine.package} is not installed")
    robot = prepared(PENDULUM, E)
    command = np.tile(chirp(0.005, seconds=4.0)[None, :, None], (2, 1, 1))
    sets = [
        {"stiffness": 12.0, "damping": 0.3, "armature": 0.01},
        {"stiffness": 20.0, "damping": 0.5, "armature": 0.002},
    ]
    values = {name: np.array([[one[name]] for one in sets]) for name in sets[0]}
    got = engine(robot).rollout(command, {**values, "delay": np.array([[0.0], [0.01]])})
    command[1] = np.pad(command[1], ((2, 0), (0, 0)))[:-2]
    with Chain(robot, "swing", threads=1) as chain:
        expected = chain.rollout(command, [{"swing": one} for one in sets])[:, :-1]
    assert np.abs(got - expected).max() < 1e-4
    if not engine.dry:
        with pytest.raises(PronkError, match="frictionloss"):
            engine(robot).rollout(command, {"frictionloss": np.zeros((2, 1))})


@engines
def test_dry_friction_is_a_torque_where_the_engine_has_it(
    engine: type[EngineSimulator], law: DriveLaw
) -> None:
    if law.kind not in engine.dry:
        pytest.skip("no dry friction in N m")
    wave = chirp(0.005, seconds=8.0)
    free, dry = (prepared(PENDULUM, law, frictionloss=f) for f in (0.0, 0.3))
    command, without, *_ = both(engine, free, "swing", wave)
    _, expected, got, _ = both(engine, dry, "swing", wave)
    all_three = (without, expected, got)
    without_db, law_db, engine_db = (level(command[:, 0], y[:, 0], 0.005) for y in all_three)
    assert np.abs(law_db - without_db).max() > 0.7
    # PyBullet's holds a joint at rest, Genesis's is less soft than MuJoCo's, which is the law's.
    assert np.abs(engine_db - law_db).max() < {PyBullet: 0.25, Genesis: 0.4}.get(engine, 0.01)


def test_pybullet_refuses_a_chain_with_armature() -> None:
    robot = load_robot("mini_cheetah")
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    command = np.zeros((1, 2, len(robot.joints)))
    with pytest.raises(PronkError, match="armature"):
        PyBullet(robot).rollout(command, {})
