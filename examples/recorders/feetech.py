"""Record a chirp of one Feetech STS or SMS servo (`pip install ftservo-python-sdk`).

    python feetech.py /dev/ttyACM0 --id 1 --joint shoulder_pan --out chirp.csv

The servo is in position mode with the gains that are set on it. Not run on hardware by pronk's
developers. Clamp the servo, keep clear of the link, and begin with a small amplitude.
"""

from __future__ import annotations

import math

from chirp import record_servo, servo_options
from scservo_sdk import COMM_SUCCESS, PortHandler, sms_sts

TORQUE_ENABLE, GOAL_POSITION, PRESENT_POSITION = 40, 42, 56  # control table of STS and SMS servos
COUNTS = 4096
"""Counts of a turn; a servo in position mode stays within one."""
RADIANS = 2.0 * math.pi / COUNTS
"""Angle of one count [rad]."""


class Feetech:
    """A servo of the STS or SMS series."""

    def __init__(self, port: PortHandler, number: int) -> None:
        self.number = number
        self.bus = sms_sts(port)

    def enable(self, torque: bool) -> None:
        """Switch the torque on or off."""
        self.bus.write1ByteTxRx(self.number, TORQUE_ENABLE, int(torque))

    def position(self) -> float:
        """Return the measured position [rad]."""
        counts, result, _ = self.bus.read2ByteTxRx(self.number, PRESENT_POSITION)
        if result != COMM_SUCCESS:
            raise SystemExit(self.bus.getTxRxResult(result))
        return float(counts * RADIANS)

    def send(self, command_rad: float) -> float:
        """Send a position; return the one that was sent [rad]."""
        counts = min(max(round(command_rad / RADIANS), 0), COUNTS - 1)
        self.bus.write2ByteTxRx(self.number, GOAL_POSITION, counts)
        return counts * RADIANS


def main() -> None:
    """Record."""
    options = servo_options(__doc__, high_hz=4.0)
    port = PortHandler(options.port)
    if not (port.openPort() and port.setBaudRate(options.baud)):
        raise SystemExit(f"{options.port} cannot be opened")
    record_servo(Feetech(port, options.id), options)


if __name__ == "__main__":
    main()
