"""The jump that is shown: between its rows and commands, in the mirror, and what led robots do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from pronk.errors import ArtefactError

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

import small_env
from pronk.robots import load_robot
from pronk.train.gains import GainsName
from pronk.train.mdp.commands import motion_command
from pronk.train.mdp.demonstration import JOINTS, Demonstration, demonstration, mirrored, parse
from pronk.train.mdp.jump import JumpSettings
from pronk.train.phases import enter_phase, phase

pytestmark = pytest.mark.train


def jump(k: int, forward: float, left: float, rows: int = 3) -> dict[str, Any]:
    """The k-th of a file: shows 100 k + 10 row + joint."""
    targets = [[100.0 * k + 10.0 * row + joint for joint in range(12)] for row in range(rows)]
    return {"forward": forward, "left": left, "targets": targets}


JUMPS = [jump(0, 0, 0), jump(1, 2, 0), jump(2, -1, 0), jump(3, 0, -0.5), jump(6, 1, 0)]


def content(**changes: Any) -> dict[str, Any]:
    """Of a file."""
    known = {"schema_version": 1, "joints": list(JOINTS), "step_s": 0.02, "jumps": JUMPS}
    return known | changes


def at(shown: Demonstration, since: float, forward: float, left: float) -> list[float]:
    (found,) = shown.at(torch.tensor([since]), torch.tensor([[forward, left]]))
    return list(found.tolist())


@pytest.mark.parametrize(
    ("since", "forward", "left", "hundreds"),
    [
        (0.0, 0.0, 0.0, 0.0),
        (0.02, 0.0, 0.0, 0.1),
        (0.035, 0.0, 0.0, 0.175),
        (0.3, 0.0, 0.0, 0.2),
        (0.0, 2.0, 0.0, 1.0),
        (0.0, 1.0, 0.0, 6.0),
        (0.0, 0.25, 0.0, 1.5),
        (0.0, 1.5, 0.0, 3.5),
        (0.0, 2.5, 0.0, -1.5),
        (0.0, 3.0, 0.0, -1.5),  # no further than that
        (0.0, -1.0, 0.0, 2.0),
        (0.0, -0.5, 0.0, 1.0),
        (0.0, -3.0, 0.0, 2.5),
        (0.0, 0.0, -0.25, 1.5),
        (0.01, 1.0, -0.5, 6.0 + 3.0 + 0.05),  # what each changes is added
    ],
)
def test_rows_and_commands_are_interpolated(
    since: float, forward: float, left: float, hundreds: float
) -> None:
    found = at(parse(content(), "here"), since, forward, left)
    assert found == pytest.approx([100.0 * hundreds + joint for joint in range(12)], abs=1e-3)


def test_left_is_right_in_the_mirror() -> None:
    shown = parse(content(), "here")
    right, left = (torch.tensor(at(shown, 0.02, 0.0, side)) for side in (-0.5, 0.5))
    # Legs change places, and hips roll the other way.
    assert left.tolist() == pytest.approx(
        [-313, 314, 315, -310, 311, 312, -319, 320, 321, -316, 317, 318], abs=1e-3
    )
    assert torch.equal(mirrored(left), right)


def test_robots_are_shown_what_is_theirs() -> None:
    shown = parse(content(), "here")
    since = torch.tensor([0.0, 0.04, 0.02])
    told = torch.tensor([[2.0, 0.0], [0.0, 0.0], [0.0, -0.5]])
    found = shown.at(since, told)[:, 0].tolist()
    assert found == pytest.approx([100.0, 20.0, 310.0], abs=1e-3)


@pytest.mark.parametrize("gains", ["matched", "naive"])
def test_what_is_shown_to_the_mini_cheetah(gains: GainsName) -> None:
    shown = demonstration(gains)
    assert JumpSettings().prompt_s < shown.duration == pytest.approx(0.8)
    robot = load_robot("mini_cheetah")
    default = torch.tensor([joint.default_position for joint in robot.joints])
    *ahead, right, left = shown.targets
    assert shown.forward.tolist() == [-2.0, -1.0, 0.0, 1.0, 2.0]
    assert shown.aside == 1.0
    # A jump that goes ahead is its own mirror image.
    for targets in ahead:
        assert torch.allclose(mirrored(targets), targets)
    assert torch.equal(mirrored(right), left)
    assert not torch.allclose(right, left)
    # Legs fold, and stretch until they leave the ground.
    for targets in shown.targets:
        knee = (targets - default)[:, 2::3].mean(dim=1)
        assert float(knee[:6].max()) > 0.3
        assert float(knee[9:14].min()) < -0.5
    assert float((shown.targets - default).abs().max()) <= 1.6 + 1e-6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"schema_version": 2}, "here: schema_version 2; this pronk reads 1"),
        ({"joints": ["FR_knee"]}, r"here: joints \['FR_knee'\]; expected FR_hip_roll, "),
        ({"jumps": [*JUMPS, jump(5, 1, 1)]}, "neither forward, back nor the one to the right"),
        ({"jumps": JUMPS[:3]}, "neither forward, back nor the one to the right"),
        ({"jumps": JUMPS[1:]}, r"jumps forward at \[-1\.0, 1\.0, 2\.0\] m/s; expected each once"),
        ({"jumps": [*JUMPS, jump(5, 1, 0)]}, "expected each once: back, 0, and ahead"),
        ({"jumps": [JUMPS[0], *JUMPS[3:]]}, "expected each once: back, 0, and ahead"),
        (
            {"jumps": [*JUMPS[:4], jump(4, 1, 0, rows=4)]},
            r"tables of shape \(3, 12\), \(4, 12\); expected one shape \(rows, 12\)",
        ),
    ],
)
def test_a_file_of_something_else_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArtefactError, match=said):
        parse(content(**changes), "here")


def flights(env: Any, led: float, steps: int = 150) -> int:
    """Leaps of robots that do nothing of their own."""
    command = motion_command(env)
    enter_phase(env, phase("jump_a"))
    command.led = led
    leaps = 0
    for _ in range(steps):
        env.step(torch.zeros(small_env.ROBOTS, 12))
        command.velocity[:] = 0.0
        leaps += int((command.tracker.liftoffs > 0.0).sum())
    return leaps


def test_robots_that_are_led_leave_the_ground_and_others_do_not() -> None:
    env = small_env.fresh(small_env.quiet())
    assert flights(env, 0.0) == 0
    assert flights(env, 1.0) > 10


def test_robots_are_led_part_of_the_way_from_their_own_targets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With policy steps of 10 to 30 ms (D1), until they have landed or nothing more is shown."""
    env = small_env.fresh(small_env.quiet())
    command, action = motion_command(env), env.action_manager.get_term("joint_position")
    tracker = command.tracker
    enter_phase(env, phase("jump_a"))
    command.led, command.scripted = 0.25, True
    # What is shown stands out from what robots do of their own.
    made_up = parse(content(), "here")
    stands_out = replace(made_up, step_s=0.13, targets=torch.full((6, 3, 12), 0.5))
    monkeypatch.setattr(command, "_demonstration", stands_out)
    own = command.default_position + 0.35 * 0.1
    mine = torch.full((small_env.ROBOTS, 12), 0.1)
    env.step(mine)
    assert not command.showing.any(), "nobody is told to jump"
    command.jump[:2] = True
    passed = 0.0
    for decimation in (4, 2, 6, 3, 5, 6, 2, 4, 6, 5, 6, 6, 4):
        env.cfg.decimation = decimation
        command.compute(0.0)
        shows = passed < 0.26 - 1e-6
        assert command.showing.tolist() == [shows] * 2 + [False] * (small_env.ROBOTS - 2), passed
        if passed == pytest.approx(0.13):
            before = tracker.liftoffs.clone(), tracker.airborne.clone()
            tracker.liftoffs[1] = 1.0
            for airborne in (True, False):
                tracker.airborne[1] = airborne
                command.compute(0.0)
                assert command.showing[:2].tolist() == [True, airborne], "until it has landed"
            tracker.liftoffs[:], tracker.airborne[:] = before
            command.compute(0.0)
        env.step(mine)
        led = torch.lerp(own, torch.full_like(own, 0.5), 0.25 * shows)
        assert torch.allclose(action._processed_actions[:2], led[:2], atol=1e-6), passed
        assert torch.allclose(action._processed_actions[2:], own[2:], atol=1e-6)
        passed += 0.005 * decimation
    assert passed == pytest.approx(0.295)
    command.led = 0.0
    command.compute(0.0)
    assert action.shown is None


def test_what_is_shown_is_observed_as_the_action_that_would_do_so() -> None:
    env = small_env.fresh(small_env.quiet())
    command = motion_command(env)
    enter_phase(env, phase("jump_a"))
    command.led, command.scripted = 0.0, True
    env.step(torch.zeros(small_env.ROBOTS, 12))
    command.velocity[:] = torch.tensor([2.0, 0.0, 0.0])
    command.jump[:2] = True
    command.compute(0.0)
    group = env.observation_manager.compute(update_history=True)["demonstration"]
    assert group.shape == (small_env.ROBOTS, 13)
    assert group[:, 12].tolist() == [1.0] * 2 + [0.0] * (small_env.ROBOTS - 2)
    robot = load_robot("mini_cheetah")
    default = torch.tensor([joint.default_position for joint in robot.joints])
    row = demonstration(command.cfg.gains).targets[4, 0]
    assert torch.allclose(group[0, :12] * 0.35 + default, row, atol=1e-5)
    # Where nobody jumps nothing is shown.
    enter_phase(env, phase("walk"))
    command.compute(0.0)
    assert not command.showing.any()
