"""`pronk play`: the virtual robot in real time, in a web page."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing
from pathlib import Path

import tyro

from pronk.cli import console
from pronk.cli.options import check_seed
from pronk.errors import PronkError


def play(
    policy: tyro.conf.Positional[Path],
    robot: str | None = None,
    sim_params: Path | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    gamepad: bool | None = None,
    seed: int = 0,
) -> console.Outcome:
    """Walk and jump the virtual robot from a browser: sliders, keys or gamepad.

    Example:
        pronk play policies/matched/policy.onnx

    Args:
        policy: policy.onnx.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the policy's if left out.
        sim_params: Parameters of the virtual robot; those that ship with pronk if left out.
        port: Port of the page; the next one that is free.
        host: Address to bind to. 0.0.0.0 admits every computer on your networks.
        gamepad: Use a gamepad that is plugged into this machine; if there is one, if left out.
        seed: Seed of the virtual robot's noise.
    """
    from pronk.jump.play.page import WebPage, require_viser
    from pronk.jump.play.play import Joystick, play_in_real_time
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.policy.contract import check, policy_robot_name
    from pronk.policy.gamepad import GamepadReader
    from pronk.policy.runtime import load_policy
    from pronk.robots import load_robot

    check_seed(seed)
    require_viser()
    loaded_policy = load_policy(policy)
    contract = loaded_policy.contract
    spec = load_robot(robot or policy_robot_name(contract))
    params = load_sim_params(sim_params, spec)
    check(contract, spec)
    title = (
        f"## The virtual robot\nNot a real one. {spec.name}, policy `{policy.name}` "
        f"({contract.gains} gains), in real time."
    )
    device = None if gamepad is False else _find_gamepad()
    if gamepad and device is None:
        raise PronkError(
            "--gamepad: there is no gamepad that can be read in /dev/input; plug one in, or leave "
            "the option out."
        )
    with ExitStack() as stack:
        joystick = Joystick(ranges=contract.command_ranges, jumps=contract.jump)
        if device is not None:
            reader = GamepadReader(device, contract.command_ranges)
            joystick.gamepad = stack.enter_context(closing(reader))
        page = WebPage(spec, params.ground, joystick, title=title, host=host, port=port)
        stack.enter_context(closing(page))
        console.say(f"the virtual robot stands at {page.address}; Ctrl-C ends it")
        if host != "127.0.0.1":
            console.warn(f"bound to {host}: every computer that reaches this one can play")
        if device is not None:
            console.say(
                f"gamepad: {device} (left stick walks, right stick turns, RB jumps, START "
                "sets down anew)"
            )
        run = play_in_real_time(spec, loaded_policy, params, joystick, page, seed=seed)
    console.say(
        f"{run.simulated_s:.0f} s of the virtual robot in {run.wall_s:.0f} s "
        f"({run.simulated_s / max(run.wall_s, 1e-9):.2f} x real time), {len(run.hops)} jumps"
    )
    return console.Outcome(
        figures={
            "simulated_s": run.simulated_s,
            "wall_s": run.wall_s,
            "resets": run.resets,
            "hops": run.hops,
        }
    )


def _find_gamepad() -> Path | None:
    """Return the first gamepad of this machine that can be read; None without one."""
    for path in sorted(Path("/dev/input").glob("js*")):
        if os.access(path, os.R_OK):
            return path
    return None
