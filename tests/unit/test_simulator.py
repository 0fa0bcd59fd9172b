"""The Simulator protocol: the two of pronk, an example, and how they are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.errors import PronkError
from pronk.excitation.signals import Chirp
from pronk.match import MatchSettings, match_logs, predict
from pronk.robots import load_robot
from pronk.simulators.mujoco import MujocoSimulator
from pronk.simulators.simulator import RolloutRigs, joint_rigs, load_simulator
from pronk.testing import check_simulator

ROBOT = load_robot("mini_cheetah")
EXAMPLE = f"{Path(__file__).parents[2] / 'examples' / 'my_simulator.py'}:Pendulum"


@pytest.mark.parametrize("choice", ["mujoco", EXAMPLE])
def test_simulators_keep_the_protocol(choice: str) -> None:
    check_simulator(load_simulator(choice, ROBOT))


def test_a_check_names_the_rule_that_is_broken() -> None:
    simulator = load_simulator(EXAMPLE, ROBOT)
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
    settings = MatchSettings(simulator=EXAMPLE, grid_points=8)
    gains = match_logs([log], ROBOT, settings=settings).gains
    found = gains.joints["FR_knee"]
    assert found.stiffness == pytest.approx(19.3, rel=2e-3)
    assert found.damping == pytest.approx(0.41, rel=5e-3)
    assert gains.simulator == rigs.info
    replay = predict(log, ROBOT, gains, simulator=EXAMPLE).joints[0]
    assert replay.rmse_matched < 0.1 * replay.rmse_naive


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
