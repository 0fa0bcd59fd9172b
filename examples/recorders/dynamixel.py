"""Record a chirp of one Dynamixel X servo (protocol 2.0, `pip install dynamixel-sdk`).

    python dynamixel.py /dev/ttyUSB0 --id 1 --joint shoulder --out chirp.csv

The servo is in position mode with the gains that are set on it. Not run on hardware by pronk's
developers. Clamp the servo, keep clear of the link, and begin with a small amplitude.
"""

from __future__ import annotations

import math

from chirp import record_servo, servo_options
from dynamixel_sdk import COMM_SUCCESS, PacketHandler, PortHandler

TORQUE_ENABLE, GOAL_POSITION, PRESENT_POSITION = 64, 116, 132  # control table of the X series
RADIANS = 2.0 * math.pi / 4096
"""Angle of one count [rad]."""


class Dynamixel:
    """A servo of the X series."""

    def __init__(self, port: PortHandler, number: int) -> None:
        self.port = port
        self.number = number
        self.bus = PacketHandler(2.0)

    def enable(self, torque: bool) -> None:
        """Switch the torque on or off."""
        self.bus.write1ByteTxRx(self.port, self.number, TORQUE_ENABLE, int(torque))

    def position(self) -> float:
        """Return the measured position [rad]."""
        counts, result, _ = self.bus.read4ByteTxRx(self.port, self.number, PRESENT_POSITION)
        if result != COMM_SUCCESS:
            raise SystemExit(self.bus.getTxRxResult(result))
        if counts >= 2**31:  # The register is a signed number of 32 bits.
            counts -= 2**32
        return float(counts * RADIANS)

    def send(self, command_rad: float) -> float:
        """Send a position; return the one that was sent [rad]."""
        counts = round(command_rad / RADIANS)
        self.bus.write4ByteTxOnly(self.port, self.number, GOAL_POSITION, counts % 2**32)
        return counts * RADIANS


def main() -> None:
    """Record."""
    options = servo_options(__doc__, high_hz=6.0)
    port = PortHandler(options.port)
    if not (port.openPort() and port.setBaudRate(options.baud)):
        raise SystemExit(f"{options.port} cannot be opened")
    record_servo(Dynamixel(port, options.id), options)


if __name__ == "__main__":
    main()
