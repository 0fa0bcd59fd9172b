"""The virtual robot, on the bench or on the ground: a `Machine` with `virtual` True.

The physics step is 0.25 ms, and that has converged. On the bench the Bode gains of hip_roll,
hip_pitch and knee differ by 0.004, 0.003 and 0.002 dB at most from those at 25 us (40 kHz, the rate
of the robot's own drives, S4) over 0.1 to 15 Hz, thanks to the second-order corrections that
`plant.py` explains. On the ground, with a policy and the same seeds at every step (means of n):

    step [ms]                                  0.0625   0.125   0.25    0.5
    jump from standing, height [m]             .3238    .3235   .3233   .3228   n = 5, +- .0008
    jump while running at 1 m/s, distance [m]  .408     .409    .409    .410    n = 5, +- .003
    jump while running at 2 m/s, distance [m]           .781    .771            n = 20, +- .021
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from pronk.errors import HardwareError
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.ground import Ground, Start
from pronk.jump.virtual.physics import Physics
from pronk.jump.virtual.plant import Plant, legs_of
from pronk.jump.virtual.sensors import Sensors
from pronk.jump.virtual.sim_params import SimParams
from pronk.robots.machine import Command, State, TorqueKind, check_command, damping_command
from pronk.robots.robot import RobotSpec

TIMESTEP_S = 0.25e-3
"""Physics step [s]; the module's docstring says why it suffices."""
SMALLEST_TIMESTEP_S = TIMESTEP_S / 64.0
"""Smallest physics step that is taken for links that need one [s]."""
_SETTLE_S = 2.0
"""Time before the clock starts on the bench, in which the legs settle into their hold [s]."""


def hold_of(robot: RobotSpec) -> Command:
    """Return the command of the default pose at the drives' own gains."""
    return Command(
        position=np.array([joint.default_position for joint in robot.joints]),
        stiffness=np.array([joint.stiffness for joint in robot.joints]),
        damping=np.array([joint.damping for joint in robot.joints]),
    )


class VirtualRobot:
    """A robot of `robot`'s structure and `sim_params`'s imperfections. Implements `Machine`.

    The clock starts at 0 when connected, with every drive holding the default pose at the robot's
    own gains. Same parameters, seed, calls: same numbers, however `wait` is cut into pieces.
    """

    virtual = True
    torque_kind: TorqueKind = "measured"

    def __init__(
        self,
        robot: RobotSpec,
        sim_params: SimParams,
        *,
        seed: int = 0,
        base: Literal["bench", "ground"] = "bench",
        ground: Ground | None = None,
        start: Start | None = None,
        log_rate_hz: float = 500.0,
        capture_rate_hz: float | None = 1000.0,
        legs: tuple[str, ...] | None = None,
        timestep_s: float | None = None,
    ) -> None:
        """Build the plant.

        Args:
            robot: Structure, masses, drives.
            sim_params: How the machine differs from `robot`.
            seed: Seed of all noise.
            base: `bench`: the body is fixed to its stand; `ground`: it moves freely.
            ground: The ground; None for the parameters' own floor.
            start: How it is set down; None for the default pose at the origin.
            log_rate_hz: Rate of the states [Hz].
            capture_rate_hz: Rate of `capture`, on the ground [Hz]; None keeps none (a second takes
                0.7 MB at 1 kHz).
            legs: Legs that are simulated on the bench; None for all. Joints of absent legs report
                their default position and no speed.
            timestep_s: Physics step [s]; None for `TIMESTEP_S`, or a part of it where links are so
                light, or drives so stiff, that they need one.

        Raises:
            HardwareError: Options that do not go together, or an impossible rate.
            RobotError: Parameters of another robot, or a robot that cannot be simulated.
        """
        all_legs = legs_of(robot)
        if base not in ("bench", "ground"):
            raise HardwareError(f"base {base!r}; expected 'bench' or 'ground'.")
        if base == "bench" and (ground is not None or start is not None):
            raise HardwareError("ground or start given on the bench; take base='ground' for them.")
        if base == "ground" and legs is not None:
            raise HardwareError(f"legs {legs} on the ground, where all are needed; leave legs out.")
        if legs is not None and (not legs or not set(legs) <= set(all_legs)):
            raise HardwareError(
                f"legs {legs}; expected some of {', '.join(all_legs)}, the legs of {robot.name}, "
                "or None for all."
            )
        # A part of the step makes no lower rate impossible.
        _check_rate("log_rate_hz", log_rate_hz, timestep_s or TIMESTEP_S)
        if capture_rate_hz is not None:
            _check_rate("capture_rate_hz", capture_rate_hz, timestep_s or TIMESTEP_S)
        self.robot = robot.name
        self.state_rate_hz = log_rate_hz
        self.capture_rate_hz = capture_rate_hz
        """Rate of the capture [Hz]; a change has an effect until the robot is connected."""
        self._robot = robot
        self._sim_params = sim_params
        self._seed = seed
        self._ground: Ground | None = None
        if base == "ground":
            self._ground = ground or sim_params.ground
        self._start = start or Start()
        limbs = legs or all_legs
        if timestep_s is None:
            self._plant = _plant(robot, sim_params, limbs, self._ground)
        else:
            self._plant = Plant(robot, sim_params, limbs, timestep_s, self._ground)
        self._dt = float(self._plant.model.opt.timestep)
        self._physics: Physics | None = None
        self._open = False

    def connect(self) -> None:
        """Set the robot down, let it settle, start the clock; the drives hold its pose."""
        plant = self._plant
        hold = hold_of(self._robot)
        pose = np.asarray(hold.position)
        settle_s = _SETTLE_S
        capture_rate_hz = None
        if self._ground is not None:
            pose = pose + self._start.offset(len(pose))
            settle_s = self._start.settle_s
            capture_rate_hz = self.capture_rate_hz
        self._sensors = Sensors(
            self._robot, self._sim_params, plant, rate_hz=self.state_rate_hz, seed=self._seed
        )
        # Steps are counted from the clock's zero; settling happens before it.
        physics = Physics(
            plant,
            self._sim_params.machine,
            pose=pose,
            first_step=-round(settle_s / self._dt),
            capture_rate_hz=capture_rate_hz,
        )
        if self._ground is not None:
            self._ground.set_down(plant.model, physics.data, plant.feet, self._start)
        physics.apply(replace(hold, position=pose))
        self._physics = physics
        self._now = 0.0
        self._open = True
        self._latest = self._run(1)[0]

    def now(self) -> float:
        """Return the time of the machine's clock [s]."""
        self._running()
        return self._now

    def latest(self) -> State:
        """Return the newest state."""
        self._running()
        return self._latest

    def wait(self, until: float) -> list[State]:
        """Let time pass to `until` [s] on the machine's clock; return the states met on the way."""
        self._running()
        if not math.isfinite(until):
            raise HardwareError(f"wait until {until}; expected a finite time [s].")
        if until <= self._now:
            return []
        self._now = until
        # States with nominal times up to `until`; the slack forgives binary fractions.
        count = math.floor(until * self.state_rate_hz + 1e-6) + 1 - self._sensors.sequence
        states = self._run(count) if count > 0 else []
        if states:
            self._latest = states[-1]
        return states

    def send(self, command: Command) -> None:
        """Put a command into force, after the transport delay and until it expires."""
        physics = self._running()
        check_command(command, len(self._robot.joints))
        physics.commands.put(command, self._now)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Fix links where they are, on the bench; () frees all."""
        physics = self._running()
        if self._ground is not None:
            raise HardwareError(
                "joints cannot be clamped on the ground, where nothing holds the body; use the "
                "virtual robot on the bench, base='bench'."
            )
        for name in joints:
            self._robot.joint(name)
        fixture = self._sim_params.fixture
        self._plant.set_clamps(
            joints, physics.data.qpos, fixture.clamp_stiffness, fixture.clamp_damping
        )

    def damp(self) -> None:
        """Damp the joints without stiffness."""
        self._running().commands.put(damping_command(len(self._robot.joints)), self._now)

    def capture(self) -> Capture:
        """Return the capture up to the step reached, `now` less the delay; also after `close`."""
        if self._physics is None or self._physics.capture_rate_hz is None:
            raise HardwareError(
                "nothing was captured; connect a virtual robot with base='ground' and a "
                "capture_rate_hz."
            )
        return self._physics.capture()

    def snapshot(self) -> Capture:
        """Return one sample of the capture, at the physics step reached."""
        physics = self._running()
        if self._ground is None:
            raise HardwareError("nothing is captured on the bench; use base='ground'.")
        return physics.snapshot()

    def close(self) -> None:
        """Damp and close; closing twice does no harm."""
        if self._open:
            self.damp()
            self._open = False

    def _running(self) -> Physics:
        """Return the physics of a connected robot."""
        if self._physics is None or not self._open:
            raise HardwareError("the virtual robot is not connected; call connect() first.")
        return self._physics

    def _run(self, count: int) -> list[State]:
        """Simulate until the next `count` states are measured."""
        first = self._sensors.sequence
        ticks = np.arange(first, first + count) / self.state_rate_hz
        # A state was measured some time before its timestamp.
        delay = self._sim_params.machine.measurement_delay_s
        steps = np.rint((ticks - delay) / self._dt).astype(int)
        rows = self._running().run(steps.tolist())
        return self._sensors.read(ticks, steps * self._dt, self._plant.unpack(rows))


def _plant(
    robot: RobotSpec, sim_params: SimParams, limbs: tuple[str, ...], ground: Ground | None
) -> Plant:
    """Build a plant at `TIMESTEP_S`, or at the largest half, quarter and so on that suffices."""
    plant = Plant(robot, sim_params, limbs, TIMESTEP_S, ground, checked=False)
    timestep_s = TIMESTEP_S
    while timestep_s > plant.largest_timestep and timestep_s > SMALLEST_TIMESTEP_S:
        timestep_s *= 0.5
    if timestep_s == TIMESTEP_S:
        plant.check_springs()
        return plant
    return Plant(robot, sim_params, limbs, timestep_s, ground)


def _check_rate(name: str, rate_hz: float, timestep_s: float) -> None:
    """Refuse a rate that is not above 0 or more than one per physics step."""
    if not 0.0 < timestep_s * rate_hz <= 1.0:
        raise HardwareError(
            f"{name} is {rate_hz:g}; expected above 0 and at most one per physics step "
            f"({1.0 / timestep_s:g} Hz)."
        )
