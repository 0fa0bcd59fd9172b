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

from pronk.robots import load_robot
from pronk.train.gains import training_gains
from pronk.train.mdp.demonstration import demonstration, mirrored

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


def series(tool: Any, steps: int = 80, **values: Any) -> Any:
    """Robots that stand still, but for what is given."""
    known: dict[str, Any] = dict.fromkeys(tool.Series.__dataclass_fields__, 0.0)
    known |= {"height": 0.3, "stands": 1.0, "lowest_knee": 0.15} | values
    columns = {n: torch.as_tensor(v, dtype=torch.float32) for n, v in known.items()}
    return tool.Series(**{n: v.expand(steps)[:, None].clone() for n, v in columns.items()})


def test_a_flight_is_measured_between_the_steps_it_is_seen_at(tool: Any) -> None:
    """Thrown from standing height with 2.4525 m/s after 0.255 s: half a second, at 2 m/s."""
    left, came = 0.255, 0.755
    time = 0.02 * torch.arange(1.0, 81.0)
    flown = (time - left).clamp(0.0, came - left)
    foot = 2.4525 * flown - 0.5 * 9.81 * flown**2
    seen = series(
        tool,
        x=2.0 * time,
        along=2.0,
        height=0.3 + foot - 0.1 * (time < 0.1),
        up=2.4525 - 9.81 * flown,
        stands=((time <= left) | (time >= came)).float(),
        lowest_foot=foot,
        foot_up=2.4525 - 9.81 * flown,
    )
    way, high = seen.flight()
    assert float(way) == pytest.approx(1.0, abs=5e-3)
    assert float(high) == pytest.approx(0.1 + 2.4525**2 / 19.62, abs=2e-3)
    assert float(series(tool).flight()[0]) == 0.0


def test_scores_by_hand(tool: Any) -> None:
    def push(told: float, **values: Any) -> float:
        return float(tool.push_score(series(tool, tool.JUMP, **values), torch.tensor([told])))

    pushes = torch.zeros(tool.JUMP)
    pushes[12] = 2.4525  # 0.26 s after the command; up and down again takes half a second
    assert push(2.0, up=pushes, along=2.0) == pytest.approx(1.0 + 0.4 * 2.4525)
    # Told 0.5 m/s, ground is paid up to .8 m/s.
    assert push(0.5, up=pushes, along=2.0) == pytest.approx(0.8 * 0.5 + 0.4 * 2.4525)
    assert push(0.0, up=1.3 * pushes) == pytest.approx(0.4 * tool.FASTEST)
    late = pushes.roll(1)
    bad = {"turn": 1.2, "tilt": 0.25, "touching": late > 0, "fell": late > 0, "lowest_knee": 0.06}
    worse = push(0.0, up=late, height=0.16, **bad)
    costs = 0.15 + 0.2 + 0.06 + 0.03 + 0.03 + 0.4 + 1.0
    assert worse == pytest.approx(0.4 * 2.4525 - costs, abs=1e-5)

    def whole(told: float, **values: Any) -> float:
        seen = series(tool, tool.ROWS + tool.AFTER, **values)
        return float(tool.whole_score(seen, torch.tensor([told])))

    assert whole(0.0) == pytest.approx(0.0)
    high = torch.full((tool.ROWS + tool.AFTER,), 0.3)
    high[30] = 0.6
    assert whole(0.0, height=high) == pytest.approx(2.0 * 0.3)
    high[30] = 0.9
    assert whole(0.0, height=high) == pytest.approx(2.0 * tool.HIGHEST)
    high[45] = 0.1  # a deep landing adds nothing, and costs
    assert whole(0.0, height=high) == pytest.approx(2.0 * tool.HIGHEST - 4.0 * 0.1)
    pushes = torch.zeros(tool.ROWS + tool.AFTER)
    pushes[14] = 2.7
    once = pushes > 0
    bad = {"turn": 1.0, "tilt": 0.1, "touching": once, "fell": once, "lowest_knee": 0.05}
    costs = 0.3 * 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.2 + 3.0 * 0.02 + 5.0 * 0.02 + 0.4 + 2.0
    assert whole(1.0, up=pushes, **bad) == pytest.approx(-costs, abs=1e-5)


def test_jumps_that_differ_cost(tool: Any) -> None:
    seen = series(tool, tool.JUMP)
    moments = torch.arange(float(tool.MOMENTS))
    # What those do that are told something else does not count.
    up = torch.where(tool.BETWEEN, 9.0, 2.0 + 0.1 * moments).expand(tool.JUMP, -1)
    several = tool.Series(
        **{
            name: up if name == "up" else getattr(seen, name).expand_as(up)
            for name in tool.Series.__dataclass_fields__
        }
    )
    told = torch.zeros(tool.MOMENTS)
    counted = 0.1 * moments[~tool.BETWEEN]
    assert float(tool.unlike(several, told)) == pytest.approx(0.3 * float(counted.std()))
    assert 0 < int(tool.BETWEEN.sum()) < tool.MOMENTS / 2


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
    # What follows does not change the push, and ends where its last knots say.
    more = len(tool.KNOTS) - tool.PUSH_KNOTS
    rest = random.normal(size=(2, 3, more))
    whole = np.concatenate((knots[1].reshape(2, 3, 9), rest), axis=2)
    (flown,) = tool.table(aside, whole.reshape(1, -1))
    assert flown.shape == (tool.ROWS, 12)
    assert torch.equal(flown[: tool.PUSH], found)
    right = rest[0, :, -1] * [signs[0], 1, 1]
    np.testing.assert_allclose(flown[-1, :3] - DEFAULT[:3], right, atol=1e-6)


def test_climbing_finds_the_top(tool: Any) -> None:
    top = np.array([0.3, -0.2, 0.1])

    def score(tried: np.ndarray, says: bool) -> Any:
        return torch.tensor(-np.square(tried - top).sum(axis=1))

    found = tool.climb(np.zeros(3), 0.2, 40, 1, score, 20)
    np.testing.assert_allclose(found, top, atol=1e-2)


@pytest.mark.parametrize("told", [(2.0, 0.0), (0.0, -1.0)])
def test_robots_jump_as_shown_and_land(
    tool: Any, monkeypatch: pytest.MonkeyPatch, told: tuple[float, float]
) -> None:
    """The committed jumps, of a policy that walks and has not been searched with."""
    gains = training_gains(POLICIES / "gains.yaml", load_robot("mini_cheetah"))
    policies = [POLICIES / "matched" / "policy.onnx"]
    stand = tool.Stand(told, tool.STAND, policies, gains, 2)
    shown = demonstration()
    jump = shown.targets[-2 if told[1] else shown.forward.tolist().index(told[0])]
    # Standing still in the air instead is no jump.
    seen = stand.jump(torch.stack((jump, DEFAULT.expand_as(jump))), tool.ROWS + tool.AFTER)
    mine, still = slice(tool.MOMENTS), slice(tool.MOMENTS, None)
    told_so = torch.cat((~tool.BETWEEN, torch.zeros_like(tool.BETWEEN)))
    way, high = seen.flight()
    assert float(way[told_so].mean()) > (0.8 if told[0] else 0.6)
    assert float(high[told_so].mean()) > 0.35
    assert float(seen.top().step[told_so].max() + 1) * tool.STEP_S <= 0.3
    # Robots differ: with some of them it does.
    assert float(seen.touching[: tool.JUMP, told_so].amax(dim=0).mean()) < 0.5
    assert float(seen.fell[:, told_so].amax(dim=0).mean()) < 0.2
    assert float(seen.top().up[still].mean()) < 1.0
    # Who has landed is left to the policy, here one that stands, whatever a candidate would do.
    other = jump.clone()
    other[-3:] += 1.0
    monkeypatch.setattr(stand, "_decide", lambda _: torch.zeros(stand.count, 12))
    seen = stand.jump(torch.stack((jump, other)), tool.ROWS + tool.AFTER)
    airborne = seen.stands[tool.PUSH :, mine] < 0.5
    landed = (airborne.int().cummax(dim=0).values.bool() & ~airborne)[: tool.ROWS - tool.PUSH - 3]
    same = (seen.height[:, mine] == seen.height[:, still]).all(dim=0)
    stays = seen.fell[:, mine].amax(dim=0) == 0.0  # who falls is set down anew, at random
    assert same[stays].tolist() == landed.any(dim=0)[stays].tolist()
    assert 0.3 < float(same.float().mean()) < 1.0
    # Robots of all candidates are the same ones: until they differ, they do the same.
    again = stand.jump(torch.stack((jump, jump)), tool.PUSH)
    assert torch.equal(again.up[:, mine], again.up[:, still])
    assert torch.equal(again.up[:, mine], seen.up[: tool.PUSH, mine])
    # Those between are shown the mean of two jumps, the others what they are told.
    near = stand.jump(torch.stack((jump, jump)), tool.PUSH, DEFAULT.expand_as(jump))
    same = (near.up == again.up).all(dim=0)[mine]
    assert same.tolist() == (~tool.BETWEEN).tolist()
