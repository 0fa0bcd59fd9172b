"""The jump that training shows, done open loop by a policy that is not told to jump."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tools_folder import FOLDER, load_tool

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.evaluation.metrics import JumpFigures
from pronk.evaluation.protocol import PAPER_COMMANDS
from pronk.policy.observation import Measurement
from pronk.policy.runtime import load_policy
from pronk.robots import load_robot
from pronk.train.mdp.demonstration import demonstration

pytestmark = pytest.mark.train
POLICY = FOLDER.parent / "policies" / "matched" / "policy.onnx"


@pytest.fixture
def tool() -> Any:
    return load_tool("shown_jumps")


def standing() -> Measurement:
    """A robot that stands."""
    return Measurement(
        angular_velocity=np.zeros(3),
        projected_gravity=np.array([0.0, 0.0, -1.0]),
        position=np.array([joint.default_position for joint in load_robot("mini_cheetah").joints]),
        velocity=np.zeros(12),
    )


def test_it_does_as_shown_and_then_as_the_policy_that_is_not_told(
    tool: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    walks, shown = load_policy(POLICY), demonstration()
    policy = tool.AsShown(load_policy(POLICY)._session, walks.contract)
    policy.shown = shown
    # What the estimator makes of a robot that stands whatever it does is not the matter here.
    run = policy._run
    stays = np.ones((1, 4), np.float32)
    monkeypatch.setattr(policy, "_run", lambda *given: replace(run(*given), contact=stays))
    stands = standing()
    forward = shown.targets[shown.forward.tolist().index(1.0)].numpy()
    rows = len(forward)
    for step in range(3 + rows):
        told = 3 <= step < 28
        target = policy.step(stands, (1.0, 0.0, 0.0), told)
        if step < 3:
            np.testing.assert_array_equal(target, walks.step(stands, (1.0, 0.0, 0.0)))
        else:
            np.testing.assert_allclose(target, forward[step - 3], atol=1e-5)
    after = policy.step(stands, (1.0, 0.0, 0.0))
    assert np.abs(after - forward[-1]).max() > 0.05
    policy.reset()
    walks.reset()
    again = policy.step(stands, (1.0, 0.0, 0.0))
    np.testing.assert_array_equal(again, walks.step(stands, (1.0, 0.0, 0.0)))


def test_what_has_landed_is_left_to_the_policy(tool: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, contract = demonstration(), load_policy(POLICY).contract
    policy = tool.AsShown(load_policy(POLICY)._session, contract)
    policy.shown = shown
    stands = standing()
    forward = shown.targets[shown.forward.tolist().index(1.0)].numpy()
    # A stride before the push is over is no flight.
    grounded = [not (row in (5, 6) or 14 <= row < 30) for row in range(40)]
    feels = policy._run
    for row, ground in enumerate(grounded):
        contact = np.array([[0.1, 0.1, 0.9 * ground, 0.1]], np.float32)
        monkeypatch.setattr(
            policy, "_run", lambda *given, now=contact: replace(feels(*given), contact=now)
        )
        target = policy.step(stands, (1.0, 0.0, 0.0), row < 25)
        as_shown = np.abs(target - forward[row]).max() < 1e-5
        assert as_shown == (row < 30), row


def test_what_is_shown_jumps_on_the_virtual_robot(tool: Any) -> None:
    figures = tool.jump((PAPER_COMMANDS[0], 0), path=POLICY, shown=demonstration())
    assert figures.found
    assert figures.height > 0.38
    assert figures.distance > 0.55


def test_a_sentence_by_hand(tool: Any) -> None:
    well = JumpFigures(told=True, found=True, upright=True, height=0.4, distance=0.6)
    fell = JumpFigures(told=True, found=True, fell=True, touched=True, height=0.5, distance=0.8)
    said = tool.sentence([well, fell])
    assert "height 0.450 +- 0.050 m, distance 0.700 +- 0.100 m" in said
    assert said.endswith("of 2: success 1, touched 1, fell 1")
