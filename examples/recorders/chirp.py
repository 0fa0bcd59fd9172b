"""The command of the recorders beside this file, and the CSV file that they write."""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

DURATION_S = 20.0
"""Length of a chirp; a second of standstill follows."""
PAUSE_S = 1.0


def chirp(
    time_s: float, amplitude_rad: float, *, low_hz: float = 0.2, high_hz: float = 12.0
) -> float:
    """Return the command relative to the pose [rad]; it fades in and out over a second."""
    if not 0.0 <= time_s <= DURATION_S:
        return 0.0
    phase = 2.0 * math.pi * (low_hz * time_s + 0.5 * (high_hz - low_hz) / DURATION_S * time_s**2)
    fade = min(1.0, time_s, DURATION_S - time_s)
    return amplitude_rad * fade * math.sin(phase)


def command_at(time_s: float, amplitudes_rad: Sequence[float], high_hz: float) -> float | None:
    """Return the command of the whole recording relative to the pose [rad]; None at its end."""
    length_s = PAUSE_S + DURATION_S
    number = int(time_s // length_s)
    if number >= len(amplitudes_rad):
        return None
    return chirp(time_s - number * length_s - PAUSE_S, amplitudes_rad[number], high_hz=high_hz)


def write_csv(path: Path, joint: str, rows: Sequence[tuple[float, float, float]]) -> None:
    """Write time [s], command and position [rad] of one joint, by the names that pronk guesses."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", f"command.{joint}", f"position.{joint}"])
        for time_s, command, position in rows:
            writer.writerow([f"{time_s:.6f}", f"{command:.6f}", f"{position:.6f}"])


class Servo(Protocol):
    """A serial servo in position mode."""

    def enable(self, torque: bool) -> None:
        """Switch the torque on or off."""

    def position(self) -> float:
        """Return the measured position [rad]."""

    def send(self, command_rad: float) -> float:
        """Send a position; return the one that was sent, in the servo's whole counts [rad]."""


def servo_options(description: str | None, high_hz: float) -> argparse.Namespace:
    """Return the options of a recorder of one serial servo.

    Args:
        description: What the recorder does.
        high_hz: Highest frequency of the chirp if no other one is given [Hz].
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("port")
    parser.add_argument("--id", type=int, required=True)
    parser.add_argument("--joint", required=True)
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[0.1, 0.2, 0.2])
    parser.add_argument("--high-hz", type=float, default=high_hz)
    parser.add_argument("--rate-hz", type=float, default=200.0)
    parser.add_argument("--baud", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("chirp.csv"))
    return parser.parse_args()


def record_servo(servo: Servo, options: argparse.Namespace) -> None:
    """Send the chirps to a servo, and write the CSV file; the torque is off at the end."""
    servo.enable(True)
    pose = servo.position()
    rows: list[tuple[float, float, float]] = []
    begin = time.perf_counter()
    try:
        while True:
            now = time.perf_counter() - begin
            relative = command_at(now, options.amplitudes, options.high_hz)
            if relative is None:
                break
            command = servo.send(pose + relative)
            rows.append((now, command, servo.position()))
            time.sleep(max(0.0, len(rows) / options.rate_hz - (time.perf_counter() - begin)))
    finally:
        servo.enable(False)
        write_csv(options.out, options.joint, rows)
