"""The policies that come with pronk: what they were trained with, and that a Go2's jumps land."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("onnxruntime")

from pronk.files import sha256
from pronk.jump.trial.protocol import PAPER_COMMANDS
from pronk.jump.trial.trial import TrialPlan, run_trial, setup_of
from pronk.policy.runtime import load_policy

ROOT = Path(__file__).parents[2]
GO2_POLICY = ROOT / "policies" / "go2" / "matched" / "policy.onnx"


@pytest.mark.parametrize(
    ("policy", "robot", "gains"),
    [
        ("matched", "mini_cheetah", "policies/gains.yaml"),
        (
            "recipes/contact_rotors",
            "mini_cheetah",
            "examples/studies/match_worth/gains/shipped.yaml",
        ),
        ("go2/matched", "go2", "examples/studies/go2/gains.yaml"),
    ],
)
def test_each_names_its_robot_and_the_gains_beside_it(policy: str, robot: str, gains: str) -> None:
    contract = load_policy(ROOT / "policies" / policy / "policy.onnx").contract
    assert contract.robot == robot
    assert contract.gains_sha256 == sha256(ROOT / gains)


def test_a_go2_lands_a_jump_with_each_of_the_papers_commands(tmp_path: Path) -> None:
    plan = TrialPlan(cases=PAPER_COMMANDS, jumps=1)
    results = run_trial([GO2_POLICY], plan, setup_of(GO2_POLICY, tmp_path / "trial"))
    cells = {cell.case: cell for cell in results.cells}
    assert set(cells) == {case.name for case in PAPER_COMMANDS}
    for name, cell in cells.items():
        assert (cell.found, cell.fell) == (1, 0), name
    assert sum(cell.succeeded for cell in cells.values()) >= 4
    heights = [cell.figures["height"].mean for cell in cells.values()]
    assert max(heights) > 0.38
