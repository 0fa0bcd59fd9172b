"""The web page of `pronk play`: viser with mjviser draws the robot, sliders and buttons."""

from __future__ import annotations

import errno
import io
import ipaddress
import math
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import mujoco
import numpy as np

from pronk.errors import PronkError
from pronk.jump.play.play import Gauge, Joystick
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.ground import Ground
from pronk.policy.contract import COMMANDS
from pronk.policy.script import STILL
from pronk.robots.robot import RobotSpec

_DRAW_S, _WRITE_S = 1.0 / 30.0, 0.1
"""Shortest time between two drawings, and between two updates of the text."""
_FOLLOW_S = 0.3
"""Time constant of the camera."""
_KEYS = {"arrowup": (0, 1), "arrowdown": (0, -1), "arrowleft": (2, 1), "arrowright": (2, -1)}
"""Key to slider and direction; each press is a quarter of the way to the end of its range."""
_LABELS = ("forward [m/s]", "left [m/s]", "turn left [rad/s]")
_PORTS = 20


def modules() -> tuple[ModuleType, ModuleType]:
    """Import `viser` and `mjviser`."""
    try:
        import mjviser
        import viser
    except ImportError as error:
        raise PronkError(
            f"the web page needs {error.name}, which is not installed; "
            "install it with `pip install 'pronk[play]'`."
        ) from None
    return viser, mjviser


def free_port(host: str, port: int) -> int:
    """The first port that can be bound, of twenty from `port` on (viser itself waits for ever)."""
    if not 0 < port < 65536:
        raise PronkError(f"--port {port}; expected a number from 1 to 65535, as in 8080.")
    last = min(port + _PORTS, 65536)
    try:
        family, kind, _, _, _ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        for candidate in range(port, last):
            with socket.socket(family, kind) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind((host, candidate))
                except OSError as error:
                    if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                        raise
                    continue
                return candidate
    except OSError as error:
        raise PronkError(
            f"--host {host}: cannot be bound to ({error.strerror}); give an address of this "
            "machine, as in 127.0.0.1."
        ) from None
    raise PronkError(f"ports {port} to {last - 1} are all taken; name another with --port.")


def _own(host: str, headers: Mapping[str, str]) -> bool:
    """Whether a request is for this server by an address, and from a page of this server.

    A page of another server can reach it by a name that it has resolve to this machine (then the
    Host is a name), or by the right address (then the Origin is another).
    """
    try:
        at, origin = headers.get("Host", ""), headers.get("Origin")
        name = urlsplit(f"//{at}").hostname or ""
        if name not in ("localhost", host):
            ipaddress.ip_address(name)
        return origin is None or urlsplit(origin).netloc == at
    except (ValueError, LookupError):  # no address; a header that is there twice
        return False


@contextmanager
def _only_own_pages(host: str) -> Iterator[None]:
    """While a viser server starts, make it refuse requests that are not `_own`.

    viser has no hook for it; it passes a function of its own to `websockets`.
    """
    import websockets.asyncio.server as server

    original = server.serve

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if not _own(host, request.headers):
                return connection.respond(403, "another Host or Origin than this page's\n")
            return process_request(connection, request)

        return original(*args, process_request=checked, **options)

    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]


class WebPage:
    """A server with one robot in it. Implements `play.Page`."""

    def __init__(
        self,
        robot: RobotSpec,
        ground: Ground,
        joystick: Joystick,
        *,
        title: str,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Start the server, at the first free port from `port` on; `title` is Markdown."""
        viser, mjviser = modules()
        port = free_port(host, port)
        spec = mujoco.MjSpec()
        # mjviser follows the first body that is not fixed.
        spec.worldbody.add_body(name="eye", mocap=True)
        ground.add_to(spec)
        spec.attach(robot.build_spec(), prefix="", frame=spec.worldbody.add_frame())
        self._joystick = joystick
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        self._joints = np.array([self._model.joint(n).qposadr[0] for n in robot.joint_names])
        self._drawn = self._written = -math.inf
        with redirect_stdout(io.StringIO()), _only_own_pages(host):  # viser prints
            self.server: Any = viser.ViserServer(host=host, port=port, label="pronk", verbose=False)
        self._scene = mjviser.ViserMujocoScene(self.server, self._model, num_envs=1)
        self.server.initial_camera.position = (0.45, -1.35, 0.6)
        self.server.initial_camera.look_at = (0.0, 0.0, 0.25)
        name = "localhost" if host in ("127.0.0.1", "::1", "0.0.0.0", "::") else host
        self.address = f"http://{name}:{self.server.get_port()}"
        """Where a browser finds it."""
        self._build(title)

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def show(self, sample: Capture, gauge: Gauge, factor: float) -> None:
        """Draw the robot, at most 30 times a second, and the figures, ten times a second."""
        now = time.perf_counter()
        if now - self._drawn >= _DRAW_S:
            share = min(1.0, (now - self._drawn) / _FOLLOW_S)
            self._drawn, data = now, self._data
            data.qpos[:3], data.qpos[3:7] = sample.position[0], sample.orientation[0]
            data.qpos[self._joints] = sample.joint_position[0]
            data.mocap_pos[0, :2] += share * (sample.position[0, :2] - data.mocap_pos[0, :2])
            mujoco.mj_kinematics(self._model, data)
            self._scene.update_from_mjdata(data)
        if now - self._written >= _WRITE_S:
            self._written = now
            self.text.content = readout(gauge, factor)

    def _build(self, title: str) -> None:
        """Add sliders, buttons and keys."""
        gui, joystick = self.server.gui, self._joystick
        # Sharing would open a tunnel from the internet to a page that is for this machine.
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.add_markdown(title)
        self.text = gui.add_markdown("")
        """The figures."""
        self.sliders = []
        """Forward, left and yaw rate."""
        for name, label in zip(COMMANDS, _LABELS, strict=True):
            low, high = joystick.ranges[name]
            slider = gui.add_slider(
                label,
                min=low,
                max=max(high, low + 0.05),
                step=0.05,
                initial_value=min(high, max(low, 0.0)),
                disabled=not low < high,  # never trained
            )
            slider.on_update(lambda _: self._slid())
            self.sliders.append(slider)
        buttons = (
            ("Jump", "space", joystick.jump, joystick.jumps),
            ("Stop", "S", self.stop, True),
            ("Set down anew", "R", self.reset, True),
        )
        for label, key, call, enabled in buttons:
            button = gui.add_button(f"{label} ({key})", disabled=not enabled)
            button.on_click(lambda _, call=call: call())
            gui.add_command(label, hotkey=key).on_trigger(lambda _, call=call: call())
        for key, (index, sign) in _KEYS.items():
            label = f"{_LABELS[index].partition(' [')[0]} {'+' if sign > 0 else '-'}"
            gui.add_command(label, hotkey=key).on_trigger(
                lambda _, index=index, sign=sign: self._nudge(index, sign)
            )
        gui.add_markdown("Arrow keys: faster, slower, turn.")

    def stop(self) -> None:
        """Set all sliders to zero."""
        for slider, value in zip(self.sliders, STILL, strict=True):
            slider.value = value
        self._joystick.set_velocity(STILL)

    def reset(self) -> None:
        """Stop, and set the robot down anew."""
        self.stop()
        self._joystick.reset()

    def _slid(self) -> None:
        forward, left, yaw = (float(slider.value) for slider in self.sliders)
        self._joystick.set_velocity((forward, left, yaw))

    def _nudge(self, index: int, sign: int) -> None:
        slider = self.sliders[index]
        step = 0.25 * sign * max(abs(slider.min), abs(slider.max))
        slider.value = float(min(slider.max, max(slider.min, slider.value + step)))
        self._slid()


def readout(gauge: Gauge, factor: float) -> str:
    """The figures, Markdown."""
    lines = [
        f"trunk **{gauge.height:.2f} m** high, **{gauge.speed:.2f} m/s**, {factor:.2f} x real time",
        "no jump yet",
    ]
    if gauge.hops:
        last = gauge.hops[-1]
        lines[1] = (
            f"jump {len(gauge.hops)}: lift-off **{last.vertical:.2f} m/s**, apex "
            f"**{last.apex:.2f} m**, {last.duration:.2f} s in the air, {last.distance:.2f} m far"
        )
    if gauge.fallen:
        lines.append("**It fell.** Set it down anew.")
    return "\n\n".join(lines)
