"""The benchmark of random virtual robots: what is drawn, the plain fit, and the summary."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from benchmarks import match, random_robots
from benchmarks.random_robots import HELD_OUT, Recorded, Steps, draw
from benchmarks.time_fit import fit_plain, recordings
from chirp_logs import chirp_log
from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.robots import load_robot
from pronk.simulators.load import joint_rigs
from pronk.virtual.sim_params import load_sim_params

ROBOT = load_robot("mini_cheetah")
JOINT, KNOWN, DELAY = "FR_knee", (21.8, 0.541), 0.007


def synthetic(*amplitudes: float) -> JointLog:
    """A log of the training simulator with the gains `KNOWN` and a delay."""
    return chirp_log(ROBOT, JOINT, KNOWN, amplitudes, repeats=2, delay_s=DELAY, threads=1)


def test_robots_are_the_same_for_the_same_seed_and_within_their_ranges() -> None:
    assert draw(27, 3) == draw(27, 3)
    assert draw(27, 3) != draw(27, 4)
    assert draw(27, 3) != draw(28, 3)
    shipped = load_sim_params()

    def within(value: float, name: str) -> bool:
        low, high = getattr(random_robots, name)
        return bool(low <= value <= high)

    for drawn in (draw(27, number) for number in range(20)):
        assert within(drawn.machine.command_delay_s, "DELAY_S")
        assert within(drawn.machine.encoder_bits, "ENCODER_BITS")
        for name, joint in drawn.joints.items():
            own = shipped.joints[name]
            assert within(joint.coulomb / own.coulomb, "FRICTION")
            assert within(joint.belt_stiffness / own.belt_stiffness, "BELT")
            assert within(joint.torque_scale, "TORQUE")


def test_steps_begin_and_end_at_rest_and_are_all_different() -> None:
    offsets = Steps(amplitude=0.1, hold_s=0.5, steps=20).samples(ROBOT.policy_rate_hz)
    assert np.abs(offsets).max() == pytest.approx(0.1)
    assert offsets[0] == offsets[-1] == 0.0
    assert len(np.unique(offsets)) == 21


def test_the_plain_fit_finds_gains_and_delay_of_the_training_simulator() -> None:
    log = synthetic(0.25, 0.125)
    with joint_rigs("mujoco", ROBOT, threads=1) as rigs:
        found = fit_plain(rigs, log, JOINT)
        nominal = fit_plain(rigs, log, JOINT, ("delay",))
    assert (found["stiffness"], found["damping"]) == pytest.approx(KNOWN, rel=2e-3)
    assert found["delay"] == pytest.approx(DELAY, abs=2e-4)
    assert (nominal["stiffness"], nominal["damping"]) == (17.0, 0.4)
    groups = recordings(log, JOINT, ROBOT)
    assert [one.positions.shape[0] for one in groups] == [2, 2]


def test_a_method_is_judged_on_signals_that_it_did_not_see() -> None:
    logs = Recorded(
        joint=JOINT,
        sweep=synthetic(0.25, 0.125),
        held_out=synthetic(0.1, 0.15, 0.2),
        exact=synthetic(0.18),
    )

    def refuse(*_: object) -> match.Found:
        raise PronkError("no match")

    known = match.methods()
    chosen = {name: known[name] for name in (match.NOMINAL, match.PLAIN)} | {"none": refuse}
    with joint_rigs("mujoco", ROBOT, threads=1) as rigs:
        rows = [{"robot": 0} | row for row in match.compare(rigs, logs, chosen)]
    nominal, plain, none = match.summary(rows)
    assert nominal["below"] == 0
    assert nominal["median"] == pytest.approx(1.0)
    # What is left of the error is that of the interpolation between 5 ms steps.
    assert plain["below"] == plain["joints"] == 1
    assert plain["median"] < 0.1
    assert plain["moving"] == plain["over_plain"] == pytest.approx(1.0)
    assert nominal["moving"] > 10.0
    assert all(row["moving"][s] <= row["rmse"][s] for row in rows[:2] for s in HELD_OUT)
    assert np.abs(plain["bias"]).max() < 0.3
    assert (none["joints"], none["refused"]) == (0, 1)
    assert math.isnan(none["median"])
    assert rows[2]["refused"] == "no match"


def test_coverage_counts_the_gains_of_the_noise_free_sweep() -> None:
    rmse = dict.fromkeys(HELD_OUT, 1.0)
    row: dict[str, Any] = {
        **{"robot": 0, "joint": JOINT, "seconds": 1.0, "rmse": rmse, "moving": rmse},
        "method": match.PRONK,
        "values": {"stiffness": 20.0, "damping": 0.5},
        "exact": {"stiffness": 20.5, "damping": 0.55},
        "repeat": {"stiffness": (19.0, 21.0), "damping": (0.49, 0.51)},
        "total": {"stiffness": (19.0, 21.0), "damping": (0.40, 0.60)},
    }
    (one,) = match.summary([row])
    assert (one["repeat"]["covered"], one["repeat"]["intervals"]) == (1, 2)
    assert (one["total"]["covered"], one["total"]["intervals"]) == (2, 2)
    assert one["bias"] == pytest.approx([100 * (20 / 20.5 - 1), 100 * (0.5 / 0.55 - 1)])


def test_a_joint_is_judged_on_the_signals_that_excite_it() -> None:
    rows = [
        {"robot": 0, "joint": joint, "method": method, "seconds": 1.0, "rmse": rmse, "moving": rmse}
        for method, factor in ((match.NOMINAL, 4.0), (match.PLAIN, 2.0), (match.PRONK, 1.0))
        for joint, rmse in (("a", {"steps": factor, "sweep": factor**2}), ("b", {"steps": factor}))
    ]
    *_, pronk = match.summary(rows)
    assert pronk["signals"] == pytest.approx({"steps": 1 / 4, "sweep": 1 / 16})
    assert pronk["median"] == pytest.approx(np.median([1 / 8, 1 / 4]))
    assert pronk["over_plain"] == pytest.approx((1 / 2 * 1 / 4 * 1 / 2) ** (1 / 3))


def test_an_impossible_run_is_refused() -> None:
    with pytest.raises(PronkError, match="0 robots"):
        next(match.run(0, 0, lambda _stage, _share: None))
