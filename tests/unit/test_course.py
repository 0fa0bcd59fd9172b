"""Gaps and steps: the blocks, the trigger of the jump, and what counts as crossed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pronk.errors import PronkError
from pronk.evaluation import course
from pronk.evaluation.course import CrossingFigures, Obstacle, Operator, direction, judge, lost
from pronk.evaluation.jumps import JumpRules
from pronk.runtime.script import STILL, Script
from pronk.virtual.capture import Capture
from pronk.virtual.ground import Ground
from seen_jump import DELAY, SCRIPT, changed, seen_jump

FORWARD, BACK, LEFT = (2.0, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, 1.0, 0.0)
RULES = JumpRules()
# At 2 m/s the trunk of `seen_jump` is at 4.0 m at the jump input and at 4.4 m at lift-off; the
# flight of 2 * 2.0 / g = 0.408 s takes it to 5.216 m. Feet stand 0.21 m before and behind it.
SEEN = seen_jump(up=2.0, speed=2.0)
TOOK_OFF, LANDED = 4.398 + 0.21, 5.216 - 0.21
EDGE = 4.65


def judged(seen: Capture, obstacle: Obstacle, **changes: object) -> CrossingFigures:
    kept = {"edge": EDGE, "triggered": SCRIPT.on, "rules": RULES}
    return judge(seen, obstacle, FORWARD, **(kept | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "before", "between", "after"),
    [("gap", 0.0, -course.DEPTH, 0.0), ("up", 0.0, 0.3, 0.3), ("down", 0.0, -0.3, -0.3)],
)
@pytest.mark.parametrize(("command", "way"), [(FORWARD, (1, 0)), (BACK, (-1, 0)), (LEFT, (0, 1))])
def test_the_floor_is_where_it_should_be(
    kind: course.Kind,
    before: float,
    between: float,
    after: float,
    command: tuple[float, float, float],
    way: tuple[int, int],
) -> None:
    own = Ground(friction=0.55, stiffness=20e3)
    ground = Obstacle(kind=kind, size=0.3).on(own, command, 2.0)
    assert (ground.friction, ground.stiffness) == (0.55, 20e3)

    def height(s: float, side: float = 0.0) -> float:
        return ground.height(s * way[0] + side * way[1], s * way[1] + side * way[0])

    for s, expected in ((0.0, before), (1.99, before), (2.01, between), (2.29, between)):
        assert height(s) == pytest.approx(expected)
        assert height(s, side=3.0) == pytest.approx(expected)
    assert height(2.31) == pytest.approx(after)
    assert height(8.0) == pytest.approx(after)


def test_practice_is_on_flat_ground_and_odd_obstacles_are_refused() -> None:
    assert Obstacle(kind="flat").on(Ground(), FORWARD, 2.0) == Ground()
    with pytest.raises(PronkError, match="gap"):
        Obstacle(kind="gap")
    with pytest.raises(PronkError, match="course"):
        direction((1.0, 1.0, 0.0))
    with pytest.raises(PronkError, match="course"):
        direction(STILL)


def test_the_operator_looks_at_the_trunk() -> None:
    script = Script(command=FORWARD, stand_s=1.0, jump_s=0.4, keep_s=0.2)
    place = -1.0
    operator = Operator(script, edge=2.0, lead=0.5, where=lambda: place)
    place = 5.0  # where it stands does not matter before it runs
    assert operator(0.5) == (STILL, False)
    place = 1.49
    assert operator(1.0) == (FORWARD, False)
    assert operator.triggered is None
    place = 1.5
    assert operator(1.02) == (FORWARD, True)
    assert operator.triggered == 1.02
    place = 0.0  # never taken back
    assert operator(1.40) == (FORWARD, True)
    assert operator(1.43) == (FORWARD, False)
    assert operator(1.63) == (STILL, False)


def test_a_gap_that_was_crossed() -> None:
    verdict = judged(SEEN, Obstacle(kind="gap", size=0.3))
    assert verdict.success
    assert verdict.take_off == pytest.approx(EDGE - TOOK_OFF, abs=1e-9)
    assert verdict.reach == pytest.approx(TOOK_OFF - 4.0, abs=1e-9)
    assert verdict.landing == pytest.approx(LANDED - EDGE - 0.3, abs=2e-3)
    assert verdict.speed == pytest.approx(2.0)
    assert verdict.reach == pytest.approx(2.0 * (DELAY - 1e-3) + 0.21)


def test_direction_does_not_matter() -> None:
    seen = seen_jump(up=2.0, speed=2.0, yaw=math.pi / 2)
    gap = Obstacle(kind="gap", size=0.3)
    kept = {"edge": EDGE, "triggered": SCRIPT.on, "rules": RULES}
    assert judge(seen, gap, LEFT, **kept).landing == pytest.approx(  # type: ignore[arg-type]
        judged(SEEN, gap).landing
    )


def sample(time: float) -> int:
    return round(time * 1000)


@pytest.mark.parametrize(
    ("seen", "size", "why"),
    [
        # A foot's centre under the floor, while it is over the gap (samples 3.4 to 3.45 s).
        (
            changed(
                SEEN, "foot_position", (slice(sample(3.4), sample(3.45)), 0), [4.8, 0.0, -0.01]
            ),
            0.3,
            course.STEPPED_IN,
        ),
        (changed(SEEN, "other_contact", sample(4.0), True), 0.3, course.NON_FOOT_CONTACT),
        (SEEN, 0.4, course.NOT_OVER),  # the hind feet come down 6 mm before the far edge
        (
            changed(SEEN, "orientation", slice(sample(5.5), None), [0.9, 0.0, 0.4359, 0.0]),
            0.3,
            course.FELL,
        ),
        # Upright at the end, but it lay on its side meanwhile.
        (
            changed(SEEN, "orientation", slice(sample(4.5), sample(4.6)), [0.7, 0.714, 0.0, 0.0]),
            0.3,
            course.FELL,
        ),
        # It stepped back from the edge.
        (changed(SEEN, "position", (slice(sample(5.0), None), 0), 4.9), 0.3, course.NOT_OVER),
    ],
    ids=["stepped in", "contact", "not over", "leant", "lay", "went back"],
)
def test_a_gap_that_was_not_crossed(seen: Capture, size: float, why: str) -> None:
    verdict = judged(seen, Obstacle(kind="gap", size=size))
    assert not verdict.success
    assert verdict.why == why


def test_what_happens_elsewhere_does_not_count() -> None:
    gap = Obstacle(kind="gap", size=0.3)
    # A foot pressed into the floor beside the gap, a shank that touched before the jump.
    low = changed(SEEN, "foot_position", (slice(sample(3.7), sample(3.75)), 0, 2), -0.001)
    early = changed(low, "other_contact", slice(0, sample(2.9)), True)
    assert judged(early, gap).success
    assert judged(SEEN, gap, triggered=None).why == course.NOT_TRIGGERED


def test_steps_have_no_bottom_to_fall_into() -> None:
    low = changed(SEEN, "foot_position", (slice(sample(3.4), sample(3.45)), 0), [4.8, 0.0, -0.01])
    assert judged(low, Obstacle(kind="down", size=0.3)).success
    assert judged(low, Obstacle(kind="up", size=0.3)).landing == pytest.approx(
        LANDED - EDGE, abs=2e-3
    )


def test_a_lost_run_is_seen_at_once() -> None:
    gap = Obstacle(kind="gap", size=0.3)
    assert not lost(SEEN, gap, FORWARD, EDGE)
    lying = changed(SEEN, "orientation", 100, [0.7, 0.714, 0.0, 0.0])
    assert lost(lying, gap, FORWARD, EDGE)
    low = changed(SEEN, "foot_position", (3400, 0), np.array([4.8, 0.0, -0.01]))
    assert lost(low, gap, FORWARD, EDGE)
    assert not lost(low, Obstacle(kind="up", size=0.3), FORWARD, EDGE)
