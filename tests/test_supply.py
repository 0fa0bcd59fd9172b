"""The battery: what many drives draw, and what is left for each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from mjlab.envs import ManagerBasedRlEnv

import small_env
from pronk.actuator.model import clip_torque, stall_torque
from pronk.robots import load_robot
from pronk.train.mdp.randomization import Randomization
from pronk.train.mdp.supply import Supply
from pronk.train.tasks import env_cfg

pytestmark = pytest.mark.train

ROBOT = load_robot("mini_cheetah")
RATED = 24.0


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    """Two nominal robots; the second one will have a battery."""
    built = ManagerBasedRlEnv(env_cfg(num_envs=2, randomization=Randomization.none()), device="cpu")
    built.reset()
    yield built
    built.close()


def supply_of(env: Any, voltage: float, resistance: float) -> Supply:
    found: Supply = env.action_manager.get_term("joint_position").supply
    found.set(torch.tensor([[RATED], [voltage]]), torch.tensor([[0.0], [resistance]]), rated=RATED)
    return found


def draw(env: Any, torque: float, speed: float) -> None:
    """All joints of both robots pull with a torque at a speed."""
    data = env.sim.data
    data.qfrc_actuator[:, 6:] = torque
    data.qvel[:, 6:] = speed


@pytest.mark.parametrize(("torque", "speed"), [(10.0, 5.0), (-8.0, -3.0), (6.0, -9.0), (0.0, 20.0)])
def test_voltage_is_that_of_the_power_drawn(env: Any, torque: float, speed: float) -> None:
    """V solves V = U - R P / V, with P from the motors' own current and resistance."""
    supply = supply_of(env, 25.0, 0.08)
    for _ in range(100):
        draw(env, torque, speed)
        supply.advance()
    # As a brushed motor with K = 2 gear kt, and the resistance that gives the law's stall torque.
    power = 0.0
    for joint in ROBOT.joints:
        constant = 2.0 * joint.drive.gear_ratio * 0.05
        winding = 0.173 * 2.0 / 1.5
        power += torque * speed + winding * (torque / constant) ** 2
    volts = float(supply.voltage[1, 0]) * RATED
    assert volts == pytest.approx(25.0 - 0.08 * power / volts, rel=1e-4)
    assert float(supply.voltage[0, 0]) == pytest.approx(1.0, rel=1e-6), "no resistance, no sag"


def test_battery_gives_no_more_than_it_can(env: Any) -> None:
    supply = supply_of(env, 24.0, 0.1)
    for _ in range(100):
        draw(env, 26.0, 20.0)
        supply.advance()
    assert float(supply.voltage[1, 0]) * RATED == pytest.approx(12.0, rel=1e-4)


def test_torque_is_that_of_a_drive_at_the_lower_voltage(env: Any) -> None:
    supply = supply_of(env, 18.0, 0.0)
    drives = env.scene["robot"].actuators
    for drive in drives:
        joint = ROBOT.joint(drive.target_names[0]).drive
        expected = stall_torque(
            gear_ratio=joint.gear_ratio,
            torque_constant=0.05,
            resistance=0.173,
            bus_voltage=18.0,
        )
        assert drive.saturation_effort[1].tolist() == pytest.approx([expected] * 4, rel=1e-5)
        assert drive.saturation_effort[0].tolist() == pytest.approx(
            [joint.stall_torque] * 4, rel=1e-6
        )
        # Torque lost to speed is the same, so the no-load speed falls with the voltage.
        params = {name: getattr(drive, name) for name in drive.param_names}
        speed = torch.linspace(-40.0, 40.0, 4).repeat(2, 1)
        command = type("Asked", (), {})()
        command.position_target, command.pos, command.vel = 100.0, 0.0, speed
        found = type(drive).control_law(params, command)[1]
        slower = joint.no_load_speed * 18.0 / RATED
        wanted = clip_torque(1e4, speed[1].numpy(), expected, slower, joint.effort_limit)
        assert found.tolist() == pytest.approx(wanted.tolist(), rel=1e-4, abs=1e-4)
    supply.set(torch.full((2, 1), RATED), torch.zeros(2, 1), rated=RATED)


def test_a_robot_that_jumps_on_a_weak_battery_has_less_torque(env: Any) -> None:
    """The living environment: the same full push, on both batteries."""
    supply = supply_of(env, 24.0, 0.1)
    env.reset()
    least = torch.ones(2)
    for step in range(12):
        push = torch.zeros(2, 12)
        push[:, 2::3] = 0.0 if step < 4 else -6.0
        env.step(push)
        least = torch.minimum(least, supply.voltage[:, 0])
    assert float(least[0]) == pytest.approx(1.0, rel=1e-5)
    assert 0.5 <= float(least[1]) < 0.9


def test_batteries_are_drawn_with_everything_else() -> None:
    cfg = env_cfg(num_envs=1, randomization=Randomization.paper())
    assert cfg.events["supply"].params == {
        "voltage": (22.2, 25.2),
        "resistance": (0.03, 0.1),
        "rated": RATED,
    }
    none = replace(Randomization.paper(), bus_voltage=None)
    assert "supply" not in env_cfg(num_envs=1, randomization=none).events


def test_a_robot_whose_physics_went_wrong_has_a_battery_again() -> None:
    """Power that is no number must not stay in the voltage, nor in the drives' limits."""
    env = small_env.fresh(small_env.drawn())
    supply = env.action_manager.get_term("joint_position").supply
    still = torch.zeros(small_env.ROBOTS, 12)
    env.step(still)
    env.sim.data.qvel[3, 7] = float("nan")
    env.step(still)
    assert env.termination_manager.get_term("non_finite")[3]
    assert float(supply.voltage[3, 0]) == pytest.approx(float(supply.no_load[3, 0]))
    env.step(still)
    drives = env.scene["robot"].actuators
    assert all(torch.isfinite(drive.saturation_effort).all() for drive in drives)
    assert 0.7 < float(supply.voltage[3, 0]) < 1.1
