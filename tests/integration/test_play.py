"""`pronk play`: the stick, the gauge, real time, and the page as a browser finds it."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hopper import DEFAULT, ROBOT, write_hopper
from pronk.cli.main import run
from pronk.errors import PronkError
from pronk.evaluation.live.gamepad import Gamepad
from pronk.evaluation.live.joystick import JUMP_S, Pad, Stick, live
from pronk.evaluation.live.page import WebPage, free_port, readout
from pronk.evaluation.live.play import play
from pronk.evaluation.live.readout import Gauge
from pronk.policy.runtime import load_policy
from pronk.robots.legged import legged
from pronk.virtual.capture import Capture
from pronk.virtual.sim_params import load_sim_params

BODY = legged("mini_cheetah")

RANGES = {"vx": (-2.0, 3.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.0, 2.0)}
GRAVITY = 9.81


# --- The stick ----------------------------------------------------------------------------------


@given(deflection=st.floats(-1.0, 1.0))
def test_a_gamepad_has_a_dead_middle_and_reaches_its_ends(deflection: float) -> None:
    value = live(deflection)
    assert value == pytest.approx(-live(-deflection))
    assert abs(value) <= abs(deflection)
    if abs(deflection) < 0.12:
        assert value == 0.0
    assert live(1.0) == 1.0
    assert live(0.56) == pytest.approx(0.5)


def test_page_and_gamepad_add_up_within_the_ranges() -> None:
    stick = Stick(ranges=RANGES)
    stick.set_velocity((0.5, 0.2, -1.0))
    assert stick.commanded(0.0) == ((0.5, 0.2, -1.0), False)
    stick.feel(Pad(forward=1.0, left=-1.0, yaw=0.05))
    assert stick.commanded(0.02) == ((3.0, -0.8, -1.0), False)
    stick.feel(Pad(forward=-1.0))
    assert stick.commanded(0.04)[0] == (-1.5, 0.2, -1.0)


def commanded_jump(stick: Stick, start: float, ticks: int) -> list[bool]:
    return [stick.commanded(start + k / 50.0)[1] for k in range(ticks)]


def test_a_jump_lasts_as_long_as_in_the_trial_however_often_one_presses() -> None:
    stick = Stick(ranges=RANGES)
    assert not any(commanded_jump(stick, 0.0, 10))
    stick.jump()
    length = round(JUMP_S * 50)
    assert commanded_jump(stick, 1.0, 5) == [True] * 5
    stick.jump()
    assert commanded_jump(stick, 1.1, length) == [True] * (length - 5) + [False] * 5


def test_a_button_counts_when_it_goes_down() -> None:
    stick = Stick(ranges=RANGES)
    for k in range(100):
        stick.feel(Pad(jump=True))
        assert stick.commanded(k / 50.0)[1] == (k < JUMP_S * 50)
    stick.feel(Pad())
    stick.feel(Pad(jump=True, reset=True))
    assert stick.take_reset()
    assert not stick.take_reset()
    # Set down anew, the clock begins at zero and nobody jumps.
    assert not stick.commanded(0.0)[1]


def test_who_cannot_jump_is_never_commanded_to() -> None:
    stick = Stick(ranges=RANGES, jumps=False)
    stick.jump()
    stick.feel(Pad(jump=True))
    assert not any(commanded_jump(stick, 0.0, 50))


def test_without_a_gamepad_nothing_is_commanded() -> None:
    pad = Gamepad()
    try:
        if pad.name is not None:
            pytest.skip("a gamepad is plugged in")
        assert pad.read() == Pad()
    finally:
        pad.close()


# --- The gauge ----------------------------------------------------------------------------------


def sample(time: float, z: float, vz: float, *, airborne: bool, tilt: float = 0.0) -> Capture:
    return Capture(
        time=np.array([time]),
        position=np.array([[1.5 * time, 0.0, z]]),
        orientation=np.array([[math.cos(0.5 * tilt), math.sin(0.5 * tilt), 0.0, 0.0]]),
        velocity=np.array([[1.5, 0.0, vz]]),
        angular_velocity=np.zeros((1, 3)),
        foot_position=np.zeros((1, 4, 3)),
        contact=np.full((1, 4), not airborne),
        other_contact=np.zeros(1, dtype=bool),
        joint_position=DEFAULT[None],
        joint_velocity=np.zeros((1, 12)),
        torque=np.zeros((1, 12)),
        electrical_power=np.zeros(1),
        bus_voltage=np.array([24.0]),
    )


def flown(speed: float) -> Gauge:
    """A stone thrown up from standing height, seen every 2 ms."""
    gauge = Gauge()
    for time_ in np.arange(0.0, 1.2, 0.002):
        t = time_ - 0.3
        airborne = 0.0 <= t <= 2.0 * speed / GRAVITY
        z = BODY.standing_height + (speed * t - 0.5 * GRAVITY * t * t if airborne else 0.0)
        vz = speed - GRAVITY * t if airborne else 0.0
        gauge.see(sample(float(time_), z, vz, airborne=airborne))
    return gauge


def test_a_jump_is_read_as_it_was() -> None:
    (hop,) = flown(2.0).hops
    assert hop.vertical == pytest.approx(2.0, abs=0.03)
    assert hop.apex == pytest.approx(BODY.standing_height + 4.0 / (2.0 * GRAVITY), abs=1e-3)
    assert hop.duration == pytest.approx(4.0 / GRAVITY, abs=0.005)
    assert hop.distance == pytest.approx(1.5 * hop.duration)


def test_a_stride_is_no_jump() -> None:
    # v^2 / 2g is 2.5 cm: less than the 3 cm that `pronk.evaluation.jumps` requires.
    assert flown(0.7).hops == []


def test_a_fallen_robot_is_called_so() -> None:
    gauge = Gauge()
    gauge.see(sample(0.0, 0.29, 0.0, airborne=False))
    assert not gauge.fallen
    gauge.see(sample(0.1, 0.15, 0.0, airborne=False, tilt=1.5))
    assert gauge.fallen
    assert "fell" in readout(gauge, 1.0)


# --- The game -----------------------------------------------------------------------------------


class Album:
    """A page that keeps what it was shown."""

    def __init__(self) -> None:
        self.heights: list[float] = []

    def show(self, sample: Capture) -> None:
        self.heights.append(float(sample.position[0, 2]))

    def tell(self, gauge: Gauge, factor: float) -> None:
        self.gauge = gauge


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("onnxruntime")
    return write_hopper(tmp_path_factory.mktemp("hopper") / "policy.onnx")


def test_the_robot_hops_on_command_and_no_faster_than_real_time(hopper: Path) -> None:
    stick, album = Stick(ranges=RANGES), Album()
    calls = []

    def until(simulated: float) -> bool:
        if simulated >= 0.1 and not calls:
            calls.append(simulated)
            stick.jump()
        return simulated >= 1.0

    played = play(ROBOT, load_policy(hopper), load_sim_params(), stick, album, until=until)
    assert played.simulated_s == pytest.approx(1.0)
    assert played.wall_s >= 0.97
    assert album.heights[0] == pytest.approx(BODY.standing_height, abs=0.06)
    assert max(album.heights) > album.heights[0] + 0.05
    assert len(album.heights) == 51


def test_set_down_anew_the_robot_stands_where_it_began(hopper: Path) -> None:
    stick, album = Stick(ranges=RANGES), Album()
    resets = []

    def until(simulated: float) -> bool:
        if simulated >= 0.2 and not resets:
            resets.append(simulated)
            stick.reset()
        return simulated >= 0.3

    played = play(ROBOT, load_policy(hopper), load_sim_params(), stick, album, until=until)
    assert played.resets == 1
    # Same seed, same robot: it does again what it did at first.
    again = album.heights[11:]
    assert again == album.heights[: len(again)]


def wait_for(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.train
def test_a_browser_moves_the_robot(hopper: Path) -> None:
    pytest.importorskip("mjviser")
    viser = pytest.importorskip("viser")
    client = pytest.importorskip("websockets.sync.client")
    import msgspec

    stick = Stick(ranges=RANGES)
    sim_params = load_sim_params()
    with WebPage(ROBOT, sim_params.ground, stick, title="# virtual", port=18765) as page:
        assert page.server.get_host() == "127.0.0.1"
        with urllib.request.urlopen(page.address) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read()[:2000].lower()
        address = page.address.replace("http", "ws")
        protocol = [f"viser-v{viser.__version__}"]
        with client.connect(address, subprotocols=protocol, max_size=None) as socket:

            def browse(kind: str, fields: dict[str, Any]) -> None:
                socket.send(msgspec.msgpack.encode({"type": kind} | fields))

            # A browser is a client from its first camera on.
            camera = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 0.0, 0.0), "fov": 1.0}
            camera |= {"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}
            camera |= {"near": 0.1, "far": 10.0, "image_height": 400, "image_width": 640}
            browse("ViewerCameraMessage", camera)
            wait_for(lambda: bool(page.server.get_clients()))
            forward = page._sliders[0]
            slid = {"uuid": forward._impl.uuid, "updates": {"value": 1.25}}
            browse("GuiUpdateMessage", slid)
            wait_for(lambda: stick.commanded(0.0)[0] == (1.25, 0.0, 0.0))
            before = page._data.qpos.copy()
            play(ROBOT, load_policy(hopper), sim_params, stick, page, until=lambda t: t > 0.2)
            assert (page._data.qpos != before).any()
            assert "trunk" in page._readout.content
        page.reset()
        assert stick.commanded(0.0)[0] == (0.0, 0.0, 0.0)
        assert stick.take_reset()


@pytest.mark.train
def test_ctrl_c_ends_the_game_cleanly(hopper: Path, tmp_path: Path) -> None:
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
        first = process.stdout.readline()
        assert "the virtual robot stands at http://localhost:1877" in first
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        rest, complaints = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0, complaints
    assert "s of the virtual robot" in rest
    assert "Traceback" not in complaints
    assert json.loads(figures.read_text(encoding="utf-8"))["resets"] == 0


def test_without_viser_one_sentence_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], hopper: Path
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setitem(sys.modules, "mjviser", None)
    assert run(["play", str(hopper)]) == 2
    said = capsys.readouterr().err
    assert "pip install 'pronk[play]'" in said
    assert len(said.strip().splitlines()) == 1


def test_a_port_that_is_taken_is_passed_over() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 20


def test_a_bad_address_is_refused() -> None:
    with pytest.raises(PronkError, match="--port 0; expected a number from 1 to 65535"):
        free_port("127.0.0.1", 0)
    with pytest.raises(PronkError, match=r"--host 300\.1\.1\.1: cannot be bound to"):
        free_port("300.1.1.1", 8080)
    # An address that is set aside for documents is no machine's.
    with pytest.raises(PronkError, match=r"--host 192\.0\.2\.1: cannot be bound to"):
        free_port("192.0.2.1", 8080)
