"""`pronk play`: the virtual robot in real time, in a web page."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing
from pathlib import Path

import tyro

from pronk.cli import console
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

    Args:
        policy: policy.onnx.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the policy's if left out.
        sim_params: Body of the virtual robot; the one that ships with pronk if left out.
        port: Of the page; the next one that is free.
        host: Address to bind to. 0.0.0.0 admits every computer on your networks.
        gamepad: Use a gamepad that is plugged into this machine; if there is one, if left out.
        seed: Of the virtual robot's noise.
    """
    from pronk.deploy.runtime.teleop import Gamepad
    from pronk.jump.play.page import WebPage, modules
    from pronk.jump.play.play import Joystick
    from pronk.jump.play.play import play as run
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.policy.contract import check
    from pronk.policy.runtime import load_policy
    from pronk.robots import load_robot

    modules()
    loaded = load_policy(policy)
    machine = load_robot(robot or loaded.contract.robot)
    params = load_sim_params(sim_params, machine)
    check(loaded.contract, machine)
    ranges = loaded.contract.command_ranges
    title = (
        f"## The virtual robot\nNot a real one. {machine.name}, policy `{policy.name}` "
        f"({loaded.contract.gains} gains), in real time."
    )
    plugged = [] if gamepad is False else sorted(Path("/dev/input").glob("js*"))
    devices = [path for path in plugged if os.access(path, os.R_OK)]
    if gamepad and not devices:
        raise PronkError(
            "--gamepad: there is no gamepad that can be read in /dev/input; plug one in, or leave "
            "the option out."
        )
    with ExitStack() as stack:
        pad = stack.enter_context(closing(Gamepad(devices[0], ranges))) if devices else None
        joystick = Joystick(ranges=ranges, jumps=loaded.contract.jump, gamepad=pad)
        server = WebPage(machine, params.ground, joystick, title=title, host=host, port=port)
        page = stack.enter_context(closing(server))
        console.say(f"the virtual robot stands at {page.address}; Ctrl-C ends it")
        if host != "127.0.0.1":
            console.warn(f"bound to {host}: every computer that reaches this one can play")
        if pad is not None:
            console.say(
                f"gamepad: {devices[0]} (left stick walks, right stick turns, RB jumps, START "
                "sets down anew)"
            )
        played = run(machine, loaded, params, joystick, page, seed=seed)
    simulated, wall = played["simulated_s"], played["wall_s"]
    console.say(
        f"{simulated:.0f} s of the virtual robot in {wall:.0f} s "
        f"({simulated / max(wall, 1e-9):.2f} x real time), {len(played['hops'])} jumps"
    )
    return console.Outcome(figures=played)
