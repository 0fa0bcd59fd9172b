"""Record a chirp of one Feetech STS or SMS servo (`pip install ftservo-python-sdk`).

    python feetech.py /dev/ttyACM0 --id 1 --joint shoulder_pan --out chirp.csv

The servo is in position mode with the gains that are set on it. Not run on hardware by pronk's
developers. Clamp the servo, keep clear of the link, and begin with a small amplitude.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

from chirp import command_at, write_csv
from scservo_sdk import COMM_SUCCESS, PortHandler, sms_sts

TORQUE_ENABLE, GOAL_POSITION, PRESENT_POSITION = 40, 42, 56  # control table of STS and SMS servos
COUNTS = 4096
"""Counts of a turn."""


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port")
    parser.add_argument("--id", type=int, required=True)
    parser.add_argument("--joint", required=True)
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[0.1, 0.2, 0.2])
    parser.add_argument("--high-hz", type=float, default=4.0)
    parser.add_argument("--rate-hz", type=float, default=200.0)
    parser.add_argument("--baud", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("chirp.csv"))
    options = parser.parse_args()

    port = PortHandler(options.port)
    if not (port.openPort() and port.setBaudRate(options.baud)):
        raise SystemExit(f"{options.port} cannot be opened")
    servo = sms_sts(port)

    def position() -> float:
        counts, result, _ = servo.read2ByteTxRx(options.id, PRESENT_POSITION)
        if result != COMM_SUCCESS:
            raise SystemExit(servo.getTxRxResult(result))
        return counts * 2.0 * math.pi / COUNTS

    servo.write1ByteTxRx(options.id, TORQUE_ENABLE, 1)
    pose = position()
    rows: list[tuple[float, float, float]] = []
    begin = time.perf_counter()
    try:
        while True:
            now = time.perf_counter() - begin
            relative = command_at(now, options.amplitudes, options.high_hz)
            if relative is None:
                break
            command = round((pose + relative) * COUNTS / (2.0 * math.pi))
            command = min(max(command, 0), COUNTS - 1)
            servo.write2ByteTxRx(options.id, GOAL_POSITION, command)
            rows.append((now, command * 2.0 * math.pi / COUNTS, position()))
            time.sleep(max(0.0, len(rows) / options.rate_hz - (time.perf_counter() - begin)))
    finally:
        servo.write1ByteTxRx(options.id, TORQUE_ENABLE, 0)
        write_csv(options.out, options.joint, rows)


if __name__ == "__main__":
    main()
