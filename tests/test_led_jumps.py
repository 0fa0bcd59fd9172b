"""The hand does its work on robots as training draws them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tools_folder import FOLDER, load_tool

os.environ.setdefault("MJLAB_WARP_QUIET", "1")
pytestmark = [
    pytest.mark.train,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="compiles the engine with gcc"),
]
POLICIES = FOLDER.parent / "policies"


def test_robots_that_only_walk_are_led_off_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of 10 to 30 ms, delays, weak batteries and all: standing they come to 2.3 m/s."""
    import mjlab.envs.manager_based_rl_env as mjlab_env

    monkeypatch.setattr(mjlab_env, "Simulation", mjlab_env.Simulation)
    load_tool("cpu_engine")  # which the next one imports
    tool = load_tool("led_jumps")
    policy: Path = POLICIES / "matched" / "policy.onnx"
    found = tool.led(policy, POLICIES / "gains.yaml", robots=8, seed=0)
    assert list(found) == ["+1, +0", "+2, +0", "+0, -1", "+0, +1", "-2, +0", "+0, +0"]
    up, before, after, _ = found["+0, +0"]
    assert up.mean() > 1.8
    assert not before.any()
    assert not after.any(), "there is no direction to go"
    for what in ("+1, +0", "+2, +0", "+0, -1", "+0, +1", "-2, +0"):
        up, before, after, _ = found[what]
        assert up.mean() > 0.9, what
        assert after.mean() > 0.7 * before.mean(), what
