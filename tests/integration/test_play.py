"""`pronk play`: operator command, readout, real time, and the page as a browser finds it."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import closing
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from command_line import invoke
from hopper import ROBOT, write_hopper
from pronk.deploy.links.link import wait_for
from pronk.errors import PronkError
from pronk.jump.play.page import WebPage, free_port, readout
from pronk.jump.play.play import JUMP_S, Gauge, Joystick, play_in_real_time
from pronk.jump.trial.jumps import JumpRules
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.gamepad import GamepadButton, GamepadInput
from pronk.policy.runtime import load_policy
from pronk.robots.legged import legged
from seen_jump import STANDING, Z_OFF, G, changed, seen_jump

RANGES = {"vx": (-2.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)}


class Pad:
    """A gamepad whose state a test sets."""

    state = GamepadInput()

    def read(self, now: float) -> GamepadInput:
        return self.state


def test_page_and_gamepad_add_up_within_the_ranges() -> None:
    pad = Pad()
    joystick = Joystick(ranges=RANGES, gamepad=pad)
    joystick.set_velocity((0.5, 0.2, -1.0))
    assert joystick.commanded(0.0) == ((0.5, 0.2, -1.0), False)
    pad.state = GamepadInput(velocity=(3.0, -1.0, 0.0), jump=True)
    assert joystick.commanded(0.02) == ((3.0, -0.8, -1.0), True)
    pad.state = GamepadInput(pressed=(GamepadButton.START,))
    assert joystick.commanded(0.04)[1] is False
    assert joystick.take_reset()
    assert not joystick.take_reset()


def jumps(joystick: Joystick, start: float, ticks: int) -> list[bool]:
    return [joystick.commanded(start + k / 50.0)[1] for k in range(ticks)]


def test_a_jump_lasts_as_long_as_in_the_trial_however_often_one_presses() -> None:
    joystick = Joystick(ranges=RANGES)
    assert not any(jumps(joystick, 0.0, 10))
    joystick.jump()
    length = round(JUMP_S * 50)
    assert jumps(joystick, 1.0, 5) == [True] * 5
    joystick.jump()
    assert jumps(joystick, 1.1, length) == [True] * (length - 5) + [False] * 5
    joystick.jump()
    joystick.reset()
    assert joystick.take_reset()
    assert not joystick.commanded(0.0)[1]


def test_a_policy_without_a_jump_input_gets_none() -> None:
    pad = Pad()
    pad.state = GamepadInput(jump=True)
    joystick = Joystick(ranges=RANGES, jumps=False, gamepad=pad)
    joystick.jump()
    assert not any(jumps(joystick, 0.0, 50))


def gauge_of(capture: Capture) -> Gauge:
    """A gauge that has seen every second sample."""
    gauge = Gauge(JumpRules(standing_height=STANDING))
    for index in range(0, len(capture.time), 2):
        arrays = {}
        for entry in fields(Capture):
            arrays[entry.name] = getattr(capture, entry.name)[index : index + 1]
        gauge.add(Capture(**arrays))
    return gauge


def test_jumps_and_falls_are_measured() -> None:
    seen = seen_jump(up=2.0, speed=1.5)
    gauge = gauge_of(seen)
    (hop,) = gauge.hops
    assert hop.vertical == pytest.approx(2.0, abs=0.03)
    assert hop.apex == pytest.approx(Z_OFF + 2.0**2 / (2.0 * G), abs=1e-3)
    assert hop.duration == pytest.approx(2.0 * 2.0 / G, abs=0.005)
    assert hop.distance == pytest.approx(1.5 * hop.duration, abs=0.005)
    # Less than the 3 cm over standing height of a jump.
    low = changed(seen, "position", (slice(None), 2), STANDING)
    assert gauge_of(low).hops == []
    fallen = gauge_of(changed(seen, "orientation", slice(7000, None), [0.7, 0.7, 0.0, 0.0]))
    assert (gauge.fallen, fallen.fallen) == (False, True)
    assert "fell" in readout(fallen, 1.0)


class Heights(list[float]):
    """A page that keeps the heights of the trunk."""

    def show(self, sample: Capture, gauge: Gauge, factor: float) -> None:
        self.append(float(sample.position[0, 2]))


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("onnxruntime")
    return write_hopper(tmp_path_factory.mktemp("hopper") / "policy.onnx")


@pytest.mark.parametrize(("act", "at", "end"), [("jump", 0.1, 1.0), ("reset", 0.2, 0.3)])
def test_the_robot_hops_and_resets_no_faster_than_real_time(
    hopper: Path, act: str, at: float, end: float
) -> None:
    joystick = Joystick(ranges=RANGES)
    heights = Heights()
    acted = False

    def until(simulated: float) -> bool:
        nonlocal acted
        if simulated >= at and not acted:
            acted = True
            if act == "jump":
                joystick.jump()
            else:
                joystick.reset()
        return simulated >= end

    policy = load_policy(hopper)
    run = play_in_real_time(ROBOT, policy, load_sim_params(), joystick, heights, until=until)
    assert run.wall_s >= 0.97 * end
    assert heights[0] == pytest.approx(legged(ROBOT.source).standing_height, abs=0.06)
    if act == "jump":
        assert run.simulated_s == pytest.approx(1.0)
        assert max(heights) > heights[0] + 0.05
        assert len(heights) == 51
    else:
        assert run.resets == 1
        again = heights[11:]
        assert again == heights[: len(again)]


@pytest.mark.train
def test_a_browser_moves_the_robot(hopper: Path) -> None:
    pytest.importorskip("mjviser")
    viser = pytest.importorskip("viser")
    client = pytest.importorskip("websockets.sync.client")
    import msgspec

    joystick = Joystick(ranges=RANGES)
    sim_params = load_sim_params()
    policy = load_policy(hopper)
    server = WebPage(ROBOT, sim_params.ground, joystick, title="# virtual", port=18765)
    with closing(server) as page:
        assert page.server.get_host() == "127.0.0.1"
        with urllib.request.urlopen(page.address) as reply:
            assert b"<html" in reply.read()[:2000].lower()
        for header in ({"Host": "evil.example:18765"}, {"Origin": "http://evil.example"}):
            request = urllib.request.Request(page.address, headers=header)
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(request)
        with pytest.raises(pytest.importorskip("websockets").InvalidStatus):
            client.connect(page.address.replace("http", "ws"), origin="http://evil.example")
        address, protocol = page.address.replace("http", "ws"), [f"viser-v{viser.__version__}"]
        with client.connect(address, subprotocols=protocol, max_size=None) as browser:

            def send(kind: str, fields: dict[str, Any]) -> None:
                browser.send(msgspec.msgpack.encode({"type": kind} | fields))

            # A browser is a client from its first camera on.
            camera = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 0.0, 0.0), "fov": 1.0}
            camera |= {"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}
            camera |= {"near": 0.1, "far": 10.0, "image_height": 400, "image_width": 640}
            send("ViewerCameraMessage", camera)
            assert wait_for(lambda: bool(page.server.get_clients()), 120.0)
            update = {"uuid": page.sliders[0]._impl.uuid, "updates": {"value": 1.25}}
            send("GuiUpdateMessage", update)
            assert wait_for(lambda: joystick.commanded(0.0)[0] == (1.25, 0.0, 0.0), 120.0)
            play_in_real_time(ROBOT, policy, sim_params, joystick, page, until=lambda t: t > 0.2)
            assert "trunk" in page.text.content
        page.reset()
        assert joystick.commanded(0.0)[0] == (0.0, 0.0, 0.0)
        assert joystick.take_reset()


@pytest.mark.train
def test_ctrl_c_ends_the_run(hopper: Path, tmp_path: Path) -> None:
    pytest.importorskip("mjviser")
    figures = tmp_path / "figures.json"
    words = ["play", str(hopper), "--port", "18770", "--no-gamepad", "--json", str(figures)]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "pronk.cli.main", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    try:
        assert process.stdout is not None
        assert "http://localhost:1877" in process.stdout.readline()
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "s of the virtual robot" in rest
    assert "Traceback" not in errors
    assert json.loads(figures.read_text(encoding="utf-8"))["resets"] == 0


def test_without_viser_one_sentence_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, hopper: Path
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setitem(sys.modules, "mjviser", None)
    done = invoke(["play", hopper])
    assert done.exit_code == 2
    assert "pronk[play]" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_port_that_is_taken_is_passed_over_and_bad_addresses_are_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 20
    # The last one is set aside for documents, so no machine has it.
    for host, port in (("127.0.0.1", 0), ("300.1.1.1", 8080), ("192.0.2.1", 8080)):
        with pytest.raises(PronkError, match=r"--(port|host)"):
            free_port(host, port)
