"""`pronk play`: the virtual robot in real time, in a web page."""

from __future__ import annotations

from pathlib import Path

import tyro

from pronk.cli import console


def play(
    policy: tyro.conf.Positional[Path],
    sim_params: Path | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    gamepad: bool | None = None,
    seed: int = 0,
    json_file: console.JsonFile = None,
) -> None:
    """Walk and jump the virtual robot from a browser: sliders, keys or gamepad.

    Args:
        policy: policy.onnx.
        sim_params: Body of the virtual robot; the one that ships with pronk if left
            out.
        port: Of the page; the next one that is free.
        host: Address to bind to. 0.0.0.0 lets everybody on your networks play.
        gamepad: Use a gamepad that is plugged into this machine; if there is one, if
            left out.
        seed: Of the virtual robot's noise.
        json_file: Also write the figures to this file.
    """
    from dataclasses import asdict

    from pronk.errors import PronkError
    from pronk.evaluation.live.gamepad import Gamepad
    from pronk.evaluation.live.joystick import Stick
    from pronk.evaluation.live.page import WebPage, modules
    from pronk.evaluation.live.play import play as run
    from pronk.policy.contract import check
    from pronk.policy.runtime import load_policy
    from pronk.robots import load_robot
    from pronk.virtual.sim_params import load_sim_params

    modules()
    robot = load_robot("mini_cheetah")
    loaded, body = load_policy(policy), load_sim_params(sim_params)
    check(loaded.contract, robot)
    stick = Stick(ranges=loaded.contract.command_ranges, jumps=loaded.contract.jump)
    pad = None if gamepad is False else Gamepad()
    title = (
        f"## The virtual robot\nNot a real one. {robot.name}, policy `{policy.name}` "
        f"({loaded.contract.gains} gains), in real time."
    )
    try:
        if gamepad and pad is not None and pad.name is None:
            raise PronkError(
                "--gamepad, but no gamepad was found; plug one into this machine, which must have "
                "a display, or leave the option out."
            )
        with WebPage(robot, body.ground, stick, title=title, host=host, port=port) as page:
            console.say(f"the virtual robot stands at {page.address}; Ctrl-C ends it")
            if host != "127.0.0.1":
                console.warn(f"bound to {host}: everyone who reaches this machine can play")
            if pad is not None and pad.name is not None:
                console.say(
                    f"gamepad: {pad.name} (left stick walks, right stick turns, A jumps, "
                    "Start sets down anew)"
                )
            played = run(robot, loaded, body, stick, page, gamepad=pad, seed=seed)
    finally:
        if pad is not None:
            pad.close()
    console.say(
        f"{played.simulated_s:.0f} s of the virtual robot in {played.wall_s:.0f} s "
        f"({played.factor:.2f} x real time), {len(played.hops)} jumps"
    )
    console.write_json(json_file, asdict(played))
