"""The search for the jump that is shown: its parts, and robots that do as it found."""

from __future__ import annotations

import os
import shutil
from typing import Any

import numpy as np
import pytest

from tools_folder import FOLDER, load_tool

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
pytest.importorskip("cma")
os.environ.setdefault("MJLAB_WARP_QUIET", "1")

from pronk.train.environment.demonstration import demonstration, mirrored  # noqa: E402

pytestmark = [
    pytest.mark.train,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="compiles the engine with gcc"),
]
POLICIES = FOLDER.parent / "policies"
DEFAULT = torch.tensor([0.0, -0.8, 1.6] * 4)


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    import mjlab.envs.manager_based_rl_env as mjlab_env
    from mjlab.sim.sim import Simulation

    monkeypatch.setattr(mjlab_env, "Simulation", Simulation)
    load_tool("cpu_engine")  # which the next one imports
    return load_tool("find_jump")


def jumps(tool: Any, **values: float) -> Any:
    known = dict.fromkeys(
        ("up", "along", "turn", "tilt", "fell", "last_tilt", "last_turn", "last_along"), 0.0
    )
    known |= {"height": 0.3, "after": 0.26, "lowest": 0.2} | values
    return tool.Jumps(**{name: torch.tensor([value]) for name, value in known.items()})


def test_scores_by_hand(tool: Any) -> None:
    # Up and down again at 2.4525 m/s takes half a second.
    flies = jumps(tool, up=2.4525, along=2.0)
    assert float(flies.way(3.0)) == pytest.approx(1.0)
    assert float(flies.way(1.0)) == pytest.approx(0.5)
    # .31104 m higher at lift-off than standing: it comes down with 3.4716 m/s.
    higher = jumps(tool, up=2.4525, along=1.0, height=0.3 + (3.4716**2 - 2.4525**2) / 19.62)
    assert float(higher.way(3.0)) == pytest.approx((2.4525 + 3.4716) / 9.81)
    assert float(flies.score(2.0)) == pytest.approx(1.0 + 0.25 * 2.4525)
    # Told 0.5 m/s, ground is paid up to .8 m/s.
    assert float(flies.score(0.5)) == pytest.approx(0.8 * 0.5 + 0.25 * 2.4525)
    assert float(jumps(tool, up=3.0).score(0.0)) == pytest.approx(tool.FASTEST)
    worse = jumps(tool, up=2.0, turn=1.2, tilt=0.25, after=0.28, lowest=0.16, fell=1.0)
    assert float(worse.score(0.0)) == pytest.approx(2.0 - 0.15 - 0.2 - 0.06 - 0.03 - 1.0, abs=1e-5)
    lands = jumps(tool, fell=1.0, last_tilt=0.2, last_turn=1.0, last_along=1.5, lowest=0.13)
    assert float(lands.landing(2.0)) == pytest.approx(-2.0 - 0.2 - 0.1 - 0.1 - 0.1, abs=1e-5)


@pytest.mark.parametrize("aside", [False, True])
def test_targets_of_candidates(tool: Any, aside: bool) -> None:
    random = np.random.default_rng(0)
    knots = np.concatenate([np.zeros((1, 54)), random.normal(size=(1, 54))])
    guess, found = tool.table(aside, knots)
    assert guess.shape == (tool.PUSH, 12)
    assert torch.allclose(guess[0], DEFAULT)
    beyond = (guess[-1] - DEFAULT).tolist()
    assert beyond == pytest.approx([0.0, 0.5, -1.0] * 4)
    # At a knot, what is beyond the guess is the candidate's: of the last one, after .26 s.
    last = knots[1].reshape(2, 3, 9)[..., -1]
    pairs = [0, 1, 0, 1] if aside else [0, 0, 1, 1]
    signs = [1.0] * 4 if aside else [-1.0, 1.0, -1.0, 1.0]
    expected = np.array(
        [last[pair] * [sign, 1, 1] for pair, sign in zip(pairs, signs, strict=True)]
    )
    np.testing.assert_allclose((found[-1] - guess[-1]).reshape(4, 3), expected, atol=1e-6)
    assert torch.allclose(mirrored(found), found, atol=1e-6) != aside
    pose = random.normal(size=(3, 6))
    flown = tool.flight(aside, found, pose)
    assert flown.shape == (3, tool.ROWS, 12)
    assert all(torch.equal(one[: tool.PUSH], found) for one in flown)
    landing = flown[:, tool.PUSH + tool.TUCK - 1 :]
    assert torch.equal(landing, landing[:, :1].expand_as(landing))
    right = pose[0].reshape(2, 3)[0] * [signs[0], 1, 1]
    np.testing.assert_allclose(landing[0, 0, :3] - DEFAULT[:3], right, atol=1e-6)


def test_climbing_finds_the_top(tool: Any) -> None:
    top = np.array([0.3, -0.2, 0.1])

    def score(tried: np.ndarray, says: bool) -> Any:
        return torch.tensor(-np.square(tried - top).sum(axis=1))

    found = tool.climb(3, 0.2, generations=40, seed=1, score=score)
    np.testing.assert_allclose(found, top, atol=1e-2)


def test_robots_jump_as_shown_and_land(tool: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The committed jump at 2 m/s, of a policy that walks and has not been searched with."""
    monkeypatch.setattr(tool, "CANDIDATES", 1)
    stand = tool.Stand((2.0, 0.0), [POLICIES / "matched" / "policy.onnx"], POLICIES / "gains.yaml")
    shown = demonstration()
    forward = shown.targets[shown.forward.tolist().index(2.0)]
    found = stand.jump(forward[None], steps=tool.LAND)
    assert float(found.up.mean()) > 1.9
    assert float(found.along.mean()) > 1.8
    assert float(found.after.max()) <= 0.3
    assert float(found.fell.mean()) < 0.5
    # Standing still in the air instead is no jump.
    still = stand.jump(DEFAULT.expand(1, tool.ROWS, 12))
    assert float(still.up.mean()) < 1.0
