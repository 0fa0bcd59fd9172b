"""The web page of `pronk play`: viser draws the robot by mjviser, and has sliders and buttons."""

from __future__ import annotations

import errno
import io
import math
import socket
import time
from contextlib import redirect_stdout
from types import ModuleType
from typing import Any, Self

import mujoco
import numpy as np

from pronk.errors import PronkError
from pronk.evaluation.live.joystick import Stick
from pronk.evaluation.live.readout import Gauge
from pronk.policy.contract import COMMANDS
from pronk.robots.robot import Robot
from pronk.runtime.script import STILL, Velocity
from pronk.virtual.capture import Capture
from pronk.virtual.ground import Ground

_DRAW_S = 1.0 / 30.0
_WRITE_S = 0.1
_FOLLOW_S = 0.3
"""How slowly the camera follows."""
_KEYS = {"arrowup": (0, 1), "arrowdown": (0, -1), "arrowleft": (2, 1), "arrowright": (2, -1)}
"""Key to slider and direction; each press is a quarter of the way to the end of its range."""
_LABELS = ("forward [m/s]", "left [m/s]", "turn left [rad/s]")
_PORTS = 20
_LOCAL = ("127.0.0.1", "localhost", "::1")


def modules() -> tuple[ModuleType, ModuleType]:
    """Modules `viser` and `mjviser`.

    Raises:
        PronkError: One is not installed.
    """
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
    """The first port that can be bound, of twenty from `port` on.

    viser looks for one itself, but waits for ever where there is none.

    Raises:
        PronkError: The port is none, the address is not this machine's, or all are taken.
    """
    if not 0 < port < 65536:
        raise PronkError(f"--port {port}; expected a number from 1 to 65535, as in 8080.")
    last = min(port + _PORTS, 65536)
    try:
        family, kind, _, _, _ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        for candidate in range(port, last):
            with socket.socket(family, kind) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    trial.bind((host, candidate))
                except OSError as error:
                    if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                        raise
                    continue
                return candidate
    except OSError as error:
        raise PronkError(
            f"--host {host}: cannot be bound to ({error.strerror}); expected an address of this "
            "machine, as in 127.0.0.1."
        ) from None
    raise PronkError(f"ports {port} to {last - 1} are all taken; name another with --port.")


def _silence() -> redirect_stdout[io.StringIO]:
    """For viser, which tells standard output of its comings and goings."""
    return redirect_stdout(io.StringIO())


def scene_model(robot: Robot, ground: Ground) -> Any:
    """Robot, floor and blocks, for drawing, and a body `eye` that the camera follows.

    Args:
        robot: Whose `build_spec` is drawn.
        ground: What it stands on.

    Returns:
        mujoco.MjModel
    """
    spec = mujoco.MjSpec()
    # mjviser follows the first body that is not fixed.
    spec.worldbody.add_body(name="eye", mocap=True)
    ground.add_to(spec)
    spec.attach(robot.build_spec(), prefix="", frame=spec.worldbody.add_frame())
    return spec.compile()


class WebPage:
    """A server with one robot in it. Implements `play.Page`."""

    def __init__(
        self,
        robot: Robot,
        ground: Ground,
        stick: Stick,
        *,
        title: str,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Start the server.

        Args:
            robot: Who is shown.
            ground: What it stands on.
            stick: What the page moves.
            title: Of the page, Markdown.
            host: Address to bind to; 127.0.0.1 is this machine alone.
            port: The first one that is free from here on is taken.

        Raises:
            PronkError: viser or mjviser is not installed, or `free_port` finds none.
        """
        viser, mjviser = modules()
        port = free_port(host, port)
        self._stick = stick
        self._model = scene_model(robot, ground)
        self._data: Any = mujoco.MjData(self._model)
        self._eye = int(self._model.body("eye").mocapid[0])
        self._columns = np.array([self._model.joint(n).qposadr[0] for n in robot.joint_names])
        self._root = int(self._model.joint("root").qposadr[0])
        self._drawn = self._written = -math.inf
        with _silence():
            self.server: Any = viser.ViserServer(host=host, port=port, label="pronk", verbose=False)
        self._scene = mjviser.ViserMujocoScene(self.server, self._model, num_envs=1)
        self.server.initial_camera.position = (0.45, -1.35, 0.6)
        self.server.initial_camera.look_at = (0.0, 0.0, 0.25)
        self._build(viser, title)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the server."""
        with _silence():
            self.server.stop()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        host = str(self.server.get_host())
        shown = "localhost" if host in (*_LOCAL, "0.0.0.0", "::") else host
        return f"http://{shown}:{self.server.get_port()}"

    def show(self, sample: Capture) -> None:
        """Draw the robot, at most 30 times a second."""
        now = time.perf_counter()
        if now - self._drawn < _DRAW_S:
            return
        share = min(1.0, (now - self._drawn) / _FOLLOW_S)
        self._drawn = now
        data, root = self._data, self._root
        data.qpos[root : root + 3] = sample.position[0]
        data.qpos[root + 3 : root + 7] = sample.orientation[0]
        data.qpos[self._columns] = sample.joint_position[0]
        eye = data.mocap_pos[self._eye]
        eye[:2] += share * (sample.position[0, :2] - eye[:2])
        mujoco.mj_kinematics(self._model, data)
        self._scene.update_from_mjdata(data)

    def tell(self, gauge: Gauge, factor: float) -> None:
        """Write the figures, ten times a second."""
        now = time.perf_counter()
        if now - self._written < _WRITE_S:
            return
        self._written = now
        self._readout.content = readout(gauge, factor)

    def _build(self, viser: Any, title: str) -> None:
        """Sliders, buttons, keys."""
        gui, stick = self.server.gui, self._stick
        # Sharing would open a tunnel from the internet to a page that is for this machine.
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.add_markdown(title)
        self._readout = gui.add_markdown("")
        self._sliders = []
        for name, label in zip(COMMANDS, _LABELS, strict=True):
            low, high = stick.ranges[name]
            # A command that was never trained gets no slider.
            slider = gui.add_slider(
                label,
                min=low,
                max=max(high, low + 0.05),
                step=0.05,
                initial_value=min(high, max(low, 0.0)),
                disabled=not low < high,
            )
            slider.on_update(lambda _: stick.set_velocity(self._slid()))
            self._sliders.append(slider)
        jump = gui.add_button("Jump (space)", color="orange", disabled=not stick.jumps)
        jump.on_click(lambda _: stick.jump())
        gui.add_button("Stop (S)").on_click(lambda _: self.stop())
        gui.add_button("Set down anew (R)").on_click(lambda _: self.reset())
        keys = {"space": ("Jump", stick.jump), "S": ("Stop", self.stop)}
        keys["R"] = ("Set down anew", self.reset)
        for key, (label, call) in keys.items():
            gui.add_command(label, hotkey=key).on_trigger(lambda _, call=call: call())
        for key, (index, sign) in _KEYS.items():
            label = f"{_LABELS[index].partition(' [')[0]} {'+' if sign > 0 else '-'}"
            gui.add_command(label, hotkey=key).on_trigger(
                lambda _, index=index, sign=sign: self._nudge(index, sign)
            )
        gui.add_markdown("Arrow keys: faster, slower, turn.")

    def stop(self) -> None:
        """All sliders to zero."""
        for slider, value in zip(self._sliders, STILL, strict=True):
            slider.value = value
        self._stick.set_velocity(STILL)

    def reset(self) -> None:
        """Stop, and set the robot down anew."""
        self.stop()
        self._stick.reset()

    def _slid(self) -> Velocity:
        forward, left, yaw = (float(slider.value) for slider in self._sliders)
        return forward, left, yaw

    def _nudge(self, index: int, sign: int) -> None:
        slider = self._sliders[index]
        step = 0.25 * max(abs(slider.min), abs(slider.max))
        slider.value = float(min(slider.max, max(slider.min, slider.value + sign * step)))
        self._stick.set_velocity(self._slid())


def readout(gauge: Gauge, factor: float) -> str:
    """The figures, Markdown."""
    lines = [
        f"trunk **{gauge.height:.2f} m** high, **{gauge.speed:.2f} m/s**, {factor:.2f} x real time"
    ]
    if gauge.hops:
        last = gauge.hops[-1]
        lines.append(
            f"jump {len(gauge.hops)}: lift-off **{last.vertical:.2f} m/s**, apex "
            f"**{last.apex:.2f} m**, {last.duration:.2f} s in the air, {last.distance:.2f} m far"
        )
    else:
        lines.append("no jump yet")
    if gauge.fallen:
        lines.append("**It fell.** Set it down anew.")
    return "\n\n".join(lines)
