"""Candidate quantities of a lift-off: numbers by hand, and what must hold of all."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from torch import Tensor

from pronk.jump.train.mdp.liftoff import angle_kernel, forward_share, speed_share

pytestmark = pytest.mark.train

speeds = st.floats(0.0, 4.0, width=32)


def one(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def test_the_angle_asked_for_is_upright_on_the_spot_and_flatter_with_speed() -> None:
    def kernel(along: float, target: float, vertical: float) -> float:
        return float(angle_kernel(one(along), one(target), one(vertical), wanted=2.0, std=0.15))

    assert kernel(0.0, 0.0, 2.0) == pytest.approx(1.0)
    assert kernel(2.6, 2.6, 2.0) == pytest.approx(1.0)
    # Twice as fast in the right direction earns no more, half as fast half.
    assert kernel(5.2, 2.6, 4.0) == pytest.approx(1.0)
    assert kernel(1.3, 2.6, 1.0) == pytest.approx(0.5)
    # 53.3 degrees where 37.6 are asked for.
    error = math.atan2(2.24, 1.67) - math.atan2(2.0, 2.6)
    share = math.hypot(2.24, 1.67) / math.hypot(2.0, 2.6)
    expected = math.exp(-0.5 * (error / 0.15) ** 2) * share
    assert kernel(1.67, 2.6, 2.24) == pytest.approx(expected)


@settings(max_examples=50)
@given(along=st.floats(-4.0, 4.0), target=speeds, vertical=speeds)
def test_the_kernel_is_between_0_and_1(along: float, target: float, vertical: float) -> None:
    kernel = float(angle_kernel(one(along), one(target), one(vertical), wanted=2.0, std=0.15))
    assert 0.0 <= kernel <= 1.0 + 1e-9


def test_less_height_is_paid_the_faster_forwards() -> None:
    forward = torch.tensor([-2.0, 0.0, 1.0, 2.0, 3.0], dtype=torch.float64)
    share = speed_share(forward, full_speed=2.0, least=0.4)
    assert share.tolist() == pytest.approx([1.0, 1.0, 0.7, 0.4, 0.4])


def test_only_commands_forwards_are_forwards() -> None:
    forward = torch.tensor([-2.0, 0.0, 0.5, 1.0, 2.0], dtype=torch.float64)
    assert forward_share(forward, full_speed=1.0).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
