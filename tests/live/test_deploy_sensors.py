"""Each fault of a sensor damps the walking virtual robot, over LCM or over DDS, in turns.

The rows of the table of faults in docs/hardware.md; times are on the virtual robot's own clock.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import pronk

pytest.importorskip("onnxruntime")
pytest.importorskip("lcm")
pytest.importorskip("cyclonedds")

from benchmarks.sensor_faults import FAULTS, measure
from deploy_runs import PATIENT

POLICY = Path(pronk.__file__).parents[2] / "policies" / "matched" / "policy.onnx"
IMU = ("imu", "attitude", "gyro", "accelerometer")
LONGEST_S = {"encoder-zero": 2.0, "encoder-constant": 2.0}
"""Of a joint that hardly moves; 0.5 s else. Several times what an idle computer takes, so
that a busy one passes."""


@pytest.mark.slow
@pytest.mark.parametrize(("link", "faults"), [("lcm", FAULTS[::2]), ("dds", FAULTS[1::2])])
def test_each_fault_of_a_sensor_damps(link: str, faults: tuple[str, ...]) -> None:
    patient = {"limits": PATIENT | {"hold_s": 1.0}, "action_valid_s": 2.0}
    patient |= {"operator_timeout_s": 2.0, "standby_s": 2.0}
    found = measure(POLICY, link, faults, 1, lambda _stage, _share: None, **patient)
    assert set(found) == set(faults)
    for fault, row in found.items():
        (seconds,), (reason,) = row["times_s"], row["reasons"]
        of_trunk = fault.split("-")[0] in IMU
        assert reason in ({"REPEATED", "ATTITUDE"} if of_trunk else {"ENCODER"}), fault
        assert seconds <= LONGEST_S.get(fault, 0.5), fault
