"""Record a chirp of one Dynamixel X servo (protocol 2.0, `pip install dynamixel-sdk`).

    python dynamixel.py /dev/ttyUSB0 --id 1 --joint shoulder --out chirp.csv

The servo is in position mode with the gains that are set on it. Not run on hardware by pronk's
developers. Clamp the servo, keep clear of the link, and begin with a small amplitude.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

from chirp import command_at, write_csv
from dynamixel_sdk import COMM_SUCCESS, PacketHandler, PortHandler

TORQUE_ENABLE, GOAL_POSITION, PRESENT_POSITION = 64, 116, 132  # control table of the X series
COUNTS = 4096
"""Counts of a turn."""


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port")
    parser.add_argument("--id", type=int, required=True)
    parser.add_argument("--joint", required=True)
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[0.1, 0.2, 0.2])
    parser.add_argument("--high-hz", type=float, default=6.0)
    parser.add_argument("--rate-hz", type=float, default=200.0)
    parser.add_argument("--baud", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("chirp.csv"))
    options = parser.parse_args()

    port = PortHandler(options.port)
    if not (port.openPort() and port.setBaudRate(options.baud)):
        raise SystemExit(f"{options.port} cannot be opened")
    servo = PacketHandler(2.0)

    def position() -> float:
        counts, result, _ = servo.read4ByteTxRx(port, options.id, PRESENT_POSITION)
        if result != COMM_SUCCESS:
            raise SystemExit(servo.getTxRxResult(result))
        return (counts - COUNTS * (counts > 2**31)) * 2.0 * math.pi / COUNTS

    servo.write1ByteTxRx(port, options.id, TORQUE_ENABLE, 1)
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
            servo.write4ByteTxOnly(port, options.id, GOAL_POSITION, command % 2**32)
            rows.append((now, command * 2.0 * math.pi / COUNTS, position()))
            time.sleep(max(0.0, len(rows) / options.rate_hz - (time.perf_counter() - begin)))
    finally:
        servo.write1ByteTxRx(port, options.id, TORQUE_ENABLE, 0)
        write_csv(options.out, options.joint, rows)


if __name__ == "__main__":
    main()
