"""The web page of `pronk play`: viser with mjviser draws the robot, sliders and buttons."""

from __future__ import annotations

import errno
import io
import ipaddress
import math
import socket
import time
from collections.abc import Callable, Iterator, Mapping
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

_DRAW_S = 1.0 / 30.0
"""Shortest time between two drawings [s]."""
_WRITE_S = 0.1
"""Shortest time between two updates of the text [s]."""
_FOLLOW_S = 0.3
"""Time constant of the camera [s]."""
_KEYS = {"arrowup": (0, 1), "arrowdown": (0, -1), "arrowleft": (2, 1), "arrowright": (2, -1)}
"""Slider and direction of each key; each press is a quarter of the way to the end of its range."""
_LABELS = ("forward [m/s]", "left [m/s]", "turn left [rad/s]")
"""Labels of the sliders, in the order of `COMMANDS`."""
_SLIDER_STEP = 0.05
"""Step of the sliders, in the unit of each."""
_PORTS = 20
"""Number of ports that are tried."""


def require_viser() -> tuple[ModuleType, ModuleType]:
    """Import and return `viser` and `mjviser`; PronkError names the extra that has them."""
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
    """Return the first port that can be bound, of twenty from `port` on.

    viser itself waits for ever for a port that is taken.

    Raises:
        PronkError: The address is not one of this machine, or all the ports are taken.
    """
    if not 0 < port < 65536:
        raise PronkError(f"--port {port}; expected a number from 1 to 65535, as in 8080.")
    end = min(port + _PORTS, 65536)
    try:
        family, socket_type, _, _, _ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        for candidate in range(port, end):
            if _can_bind(family, socket_type, host, candidate):
                return candidate
    except OSError as error:
        raise PronkError(
            f"--host {host}: cannot be bound to ({error.strerror}); give an address of this "
            "machine, as in 127.0.0.1."
        ) from None
    raise PronkError(f"ports {port} to {end - 1} are all taken; name another with --port.")


def _can_bind(family: int, socket_type: int, host: str, port: int) -> bool:
    """Return whether a port is free; an OSError if the address is none of this machine."""
    with socket.socket(family, socket_type) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):
                return False
            raise
    return True


def _is_from_this_page(host: str, headers: Mapping[str, str]) -> bool:
    """Return whether a request is for this server by an address, and from a page of this server.

    A page of another server can reach it by a name that it has resolve to this machine (then the
    Host is a name), or by the right address (then the Origin is another).
    """
    try:
        requested_host = headers.get("Host", "")
        origin = headers.get("Origin")
        name = urlsplit(f"//{requested_host}").hostname or ""
        if name not in ("localhost", host):
            ipaddress.ip_address(name)
        return origin is None or urlsplit(origin).netloc == requested_host
    except (ValueError, LookupError):  # no address; a header that is there twice
        return False


@contextmanager
def _only_pages_of_this_server(host: str) -> Iterator[None]:
    """While a viser server starts, make it refuse requests that are not from its own page.

    viser has no hook for it; it passes a function of its own to `websockets`.
    """
    import websockets.asyncio.server as server

    original_serve = server.serve

    def serve(*arguments: Any, process_request: Any = None, **keywords: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if not _is_from_this_page(host, request.headers):
                return connection.respond(403, "another Host or Origin than this page's\n")
            return process_request(connection, request)

        return original_serve(*arguments, process_request=checked, **keywords)

    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original_serve  # type: ignore[misc]


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
        """Start the server.

        Args:
            robot: The robot to draw.
            ground: The ground under it.
            joystick: What the sliders and buttons command.
            title: Markdown above the sliders.
            host: Address to bind to.
            port: First port that is tried.
        """
        viser, mjviser = require_viser()
        port = free_port(host, port)
        spec = mujoco.MjSpec()
        # mjviser follows the first body that is not fixed.
        spec.worldbody.add_body(name="eye", mocap=True)
        ground.add_to(spec)
        spec.attach(robot.build_spec(), prefix="", frame=spec.worldbody.add_frame())
        self._joystick = joystick
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        addresses = [self._model.joint(name).qposadr[0] for name in robot.joint_names]
        self._joint_qpos = np.array(addresses)
        self._drawn_at = -math.inf
        self._written_at = -math.inf
        with redirect_stdout(io.StringIO()), _only_pages_of_this_server(host):  # viser prints
            self.server: Any = viser.ViserServer(host=host, port=port, label="pronk", verbose=False)
        self._scene = mjviser.ViserMujocoScene(self.server, self._model, num_envs=1)
        self.server.initial_camera.position = (0.45, -1.35, 0.6)
        self.server.initial_camera.look_at = (0.0, 0.0, 0.25)
        name = "localhost" if host in ("127.0.0.1", "::1", "0.0.0.0", "::") else host
        self.address = f"http://{name}:{self.server.get_port()}"
        """Where a browser finds it."""
        self.text: Any = None
        """Figures below the title."""
        self.sliders: list[Any] = []
        """Sliders of forward velocity, left velocity and yaw rate."""
        self._add_controls(title)

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def show(self, sample: Capture, gauge: Gauge, factor: float) -> None:
        """Draw the robot, at most 30 times a second, and the figures, ten times a second.

        Args:
            sample: The present moment.
            gauge: Height, speed and jumps.
            factor: Simulated seconds per second.
        """
        now = time.perf_counter()
        if now - self._drawn_at >= _DRAW_S:
            share = min(1.0, (now - self._drawn_at) / _FOLLOW_S)
            self._drawn_at = now
            data = self._data
            data.qpos[:3] = sample.position[0]
            data.qpos[3:7] = sample.orientation[0]
            data.qpos[self._joint_qpos] = sample.joint_position[0]
            data.mocap_pos[0, :2] += share * (sample.position[0, :2] - data.mocap_pos[0, :2])
            mujoco.mj_kinematics(self._model, data)
            self._scene.update_from_mjdata(data)
        if now - self._written_at >= _WRITE_S:
            self._written_at = now
            self.text.content = readout(gauge, factor)

    def _add_controls(self, title: str) -> None:
        """Add title, figures, sliders, buttons and keys."""
        gui = self.server.gui
        # Sharing would open a tunnel from the internet to a page that is for this machine.
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.add_markdown(title)
        self.text = gui.add_markdown("")
        for name, label in zip(COMMANDS, _LABELS, strict=True):
            self._add_slider(name, label)
        self._add_button("Jump", "space", self._joystick.jump, enabled=self._joystick.jumps)
        self._add_button("Stop", "S", self.stop)
        self._add_button("Set down anew", "R", self.reset)
        for key, (index, sign) in _KEYS.items():
            self._add_key(key, index, sign)
        gui.add_markdown("Arrow keys: faster, slower, turn.")

    def _add_slider(self, name: str, label: str) -> None:
        """Add the slider of one part of the velocity; one that was never trained is disabled."""
        low, high = self._joystick.ranges[name]
        slider = self.server.gui.add_slider(
            label,
            min=low,
            max=max(high, low + _SLIDER_STEP),
            step=_SLIDER_STEP,
            initial_value=min(high, max(low, 0.0)),
            disabled=low >= high,
        )
        slider.on_update(lambda _: self._send_velocity())
        self.sliders.append(slider)

    def _add_button(
        self, label: str, key: str, action: Callable[[], None], *, enabled: bool = True
    ) -> None:
        """Add a button and the key that does the same."""
        gui = self.server.gui
        button = gui.add_button(f"{label} ({key})", disabled=not enabled)
        button.on_click(lambda _: action())
        gui.add_command(label, hotkey=key).on_trigger(lambda _: action())

    def _add_key(self, key: str, index: int, sign: int) -> None:
        """Add a key that moves a slider up or down."""
        name, _, _ = _LABELS[index].partition(" [")
        label = f"{name} +" if sign > 0 else f"{name} -"
        command = self.server.gui.add_command(label, hotkey=key)
        command.on_trigger(lambda _: self._nudge(index, sign))

    def stop(self) -> None:
        """Set all sliders to zero."""
        for slider, value in zip(self.sliders, STILL, strict=True):
            slider.value = value
        self._joystick.set_velocity(STILL)

    def reset(self) -> None:
        """Stop, and set the robot down anew."""
        self.stop()
        self._joystick.reset()

    def _send_velocity(self) -> None:
        """Command what the sliders say."""
        forward, sideways, yaw_rate = (float(slider.value) for slider in self.sliders)
        self._joystick.set_velocity((forward, sideways, yaw_rate))

    def _nudge(self, index: int, sign: int) -> None:
        """Move a slider by a quarter of the way to the end of its range."""
        slider = self.sliders[index]
        step = 0.25 * sign * max(abs(slider.min), abs(slider.max))
        slider.value = float(min(slider.max, max(slider.min, slider.value + step)))
        self._send_velocity()


def readout(gauge: Gauge, factor: float) -> str:
    """Return the figures as Markdown; `factor` is simulated seconds per second."""
    jump_line = "no jump yet"
    if gauge.hops:
        hop = gauge.hops[-1]
        jump_line = (
            f"jump {len(gauge.hops)}: lift-off **{hop.vertical:.2f} m/s**, apex "
            f"**{hop.apex:.2f} m**, {hop.duration:.2f} s in the air, {hop.distance:.2f} m far"
        )
    lines = [
        f"trunk **{gauge.height:.2f} m** high, **{gauge.speed:.2f} m/s**, {factor:.2f} x real time",
        jump_line,
    ]
    if gauge.fallen:
        lines.append("**It fell.** Set it down anew.")
    return "\n\n".join(lines)
