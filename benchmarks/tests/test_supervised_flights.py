"""Flights of the shipped policies through the safety filter, on the virtual clock."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("onnxruntime")

from benchmarks.supervision import QUANTITIES, Flight, draw_params
from pronk.deploy.runtime.limits import Limits
from pronk.robots import load_robot

POLICIES = Path(__file__).parents[2] / "policies"


@pytest.mark.parametrize(
    ("policy", "robot", "seed", "seconds"),
    [
        ("matched", "mini_cheetah", 0, 20.0),
        # At 33.8 s all legs push while both hind knees turn faster than without load.
        ("go2/matched", "go2", 10, 36.0),
    ],
)
def test_a_shipped_policy_walks_and_jumps_without_a_fault(
    policy: str, robot: str, seed: int, seconds: float
) -> None:
    flight = Flight(
        policy=POLICIES / policy / "policy.onnx",
        params=draw_params(0, load_robot(robot)),
        seed=seed,
    )
    flight.run(seconds)
    assert flight.damped is None
    assert flight.jumps > 0
    limits = Limits.of(load_robot(robot))
    assert flight.largest.keys() == QUANTITIES.keys()
    for name, (limit_of, _) in QUANTITIES.items():
        # Those named least are to stay above their limits, the height but for a moment.
        if not name.startswith("least"):
            assert flight.largest[name] < limit_of(limits), name


def test_robots_are_drawn_about_their_own_parameters() -> None:
    for name, nominal_v in (("mini_cheetah", 24.0), ("go2", 28.8)):
        robot = load_robot(name)
        params = draw_params(3, robot)
        assert draw_params(3, robot) == params != draw_params(4, robot)
        assert 0.9 * nominal_v < params.machine.bus_voltage < 1.1 * nominal_v
