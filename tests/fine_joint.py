"""Logs of one joint on a pendulum, simulated in fine steps without pronk and without MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog

JOINT = "swing"
STEP_S = 1e-4
"""Step of the integrator [s]; the drive computes its torque at every second one."""
NOISE_HZ = 40.0
"""Corner of the coloured noise of the encoder [Hz]."""


@dataclass(frozen=True, kw_only=True)
class FineJoint:
    """A link of a pendulum with a rotor and a drive."""

    stiffness: float = 17.0
    damping: float = 0.4
    armature: float = 0.0063
    mass: float = 0.2
    length: float = 0.1
    """Distance of the centre of mass from the axis [m]."""
    inertia: float = 0.001
    """Inertia of the link about its centre of mass [kg m^2]."""
    frictionloss: float = 0.1
    viscous: float = 0.02
    delay_s: float = 0.004
    velocity_lag_s: float = 5e-4
    """Time constant of the filter on the drive's velocity [s]."""
    torque_scale: float = 1.0
    """Torque of the motor over the torque that its drive computes."""

    def write_robot(self, folder: Path, **drive: float) -> Path:
        """Write a robot.yaml with this joint's own numbers, `drive` in place of some of them."""
        numbers = {
            "effort_limit": 200.0,
            "stall_torque": 200.0,
            "no_load_speed": 600.0,
            "armature": self.armature,
            "frictionloss": self.frictionloss,
            "viscous_damping": self.viscous,
        } | drive
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "fine.xml").write_text(
            f"""<mujoco model="fine"><worldbody><body name="link">
            <joint name="{JOINT}" axis="0 1 0"/>
            <inertial pos="0 0 -{self.length}" mass="{self.mass}"
              diaginertia="{self.inertia} {self.inertia} {self.inertia}"/>
            </body></worldbody></mujoco>""",
            encoding="utf-8",
        )
        written = ", ".join(f"{name}: {value}" for name, value in numbers.items())
        path = folder / "robot.yaml"
        path.write_text(
            "schema: pronk/robot/1\nname: fine\nmodel: fine.xml\n"
            f"drives:\n  motor: {{{written}}}\n"
            f"groups:\n  {JOINT}: {{drive: motor, stiffness: {self.stiffness}, "
            f"damping: {self.damping}, band_hz: [1, 15]}}\n"
            f"poses:\n  default: {{{JOINT}: 0}}\n",
            encoding="utf-8",
        )
        return path

    def positions(self, sent: Array, command: Array, times: Array) -> Array:
        """Simulate commands that were sent at some instants, from rest at the first.

        Args:
            sent: Instants of the commands, increasing [s], shape (n,).
            command: Commands [rad], shape (n,).
            times: Instants at which the position is read [s], shape (m,).

        Returns:
            Position [rad], shape (m,).
        """
        count = int(times[-1] / STEP_S) + 3
        steps = STEP_S * np.arange(count)
        arrived = np.searchsorted(sent, steps - self.delay_s + 1e-9, side="right") - 1
        target = np.asarray(command)[np.maximum(arrived, 0)].tolist()
        total_inertia = self.armature + self.inertia + self.mass * self.length**2
        gravity = self.mass * 9.81 * self.length
        sticking = STEP_S * self.frictionloss / total_inertia
        track = np.empty(count)
        angle = target[0]
        speed = 0.0
        torque = 0.0
        last_angle = angle
        filtered_speed = 0.0
        share = 2.0 * STEP_S / (self.velocity_lag_s + 2.0 * STEP_S)
        for step in range(count):
            track[step] = angle
            if step % 2 == 0:
                measured_speed = (angle - last_angle) / (2.0 * STEP_S)
                last_angle = angle
                filtered_speed += share * (measured_speed - filtered_speed)
                torque = self.stiffness * (target[step] - angle) - self.damping * filtered_speed
                torque *= self.torque_scale
            passive = self.viscous * speed + gravity * math.sin(angle)
            speed += STEP_S * (torque - passive) / total_inertia
            if abs(speed) <= sticking:
                speed = 0.0
            else:
                speed -= math.copysign(sticking, speed)
            angle += STEP_S * speed
        return np.interp(times, steps, track)

    def log(
        self,
        sent: Array,
        command: Array,
        rate_hz: float,
        *,
        noise_rad: float = 2e-4,
        seed: int = 0,
    ) -> JointLog:
        """Record commands at some rate [Hz], with noise [rad] on position and timestamps.

        The log ends with the last command, and its excitations are not named.
        """
        rng = np.random.default_rng(seed)
        times = np.arange(int(sent[-1] * rate_hz)) / rate_hz
        kept = math.exp(-2.0 * math.pi * NOISE_HZ / rate_hz)
        white = noise_rad * math.sqrt(1.0 - kept**2) * rng.standard_normal(len(times))
        position = self.positions(sent, command, times) + lfilter([1.0], [1.0, -kept], white)
        logged = command[np.maximum(np.searchsorted(sent, times + 1e-9, side="right") - 1, 0)]
        return JointLog(
            robot="fine",
            joints=(JOINT,),
            time=times + 2e-5 * rng.uniform(-1.0, 1.0, len(times)),
            command=logged[:, None],
            position=position[:, None],
        )


def chirp_at(
    time: Array,
    amplitude: float,
    *,
    length_s: float,
    highest_hz: float = 25.0,
    lowest_hz: float = 0.1,
) -> Array:
    """Linear chirp from time 0 with ramps of half a second, zero before and after [rad]."""
    inside = np.clip(time, 0.0, length_s)
    growth = (highest_hz - lowest_hz) / (2.0 * length_s)
    phase = 2.0 * np.pi * (lowest_hz * inside + growth * inside**2)
    ramp = np.minimum(np.minimum(inside, length_s - inside) / 0.5, 1.0)
    return np.asarray(amplitude * ramp * np.sin(phase))


def two_chirps_at(time: Array, *, amplitude: float = 0.25, length_s: float = 20.0) -> Array:
    """A chirp and one of half its amplitude, each after a rest of a second [rad]."""
    loud = chirp_at(time - 1.0, amplitude, length_s=length_s)
    quiet = chirp_at(time - length_s - 2.0, 0.5 * amplitude, length_s=length_s)
    return loud + quiet
