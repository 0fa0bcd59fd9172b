"""What makes a state of messages, and what does not; checks before anything moves; addresses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pronk.errors import HardwareError
from pronk.links.lcm.address import VIRTUAL_PORT, multicast_interface, url_of
from pronk.links.lcm.codec import CHEETAH, WTW, Layout, clamp_message, encode_state
from pronk.links.lcm.state_decoder import StateDecoder
from pronk.links.machine import State
from pronk.links.state_checks import Freshness, check_rate
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
STATE = State(
    time=0.0,
    sequence=10,
    position=np.array([joint.default_position for joint in ROBOT.joints]),
    velocity=np.zeros(12),
    torque=np.zeros(12),
    gyro=np.zeros(3),
    accelerometer=np.array([0.0, 0.0, 9.81]),
    bus_voltage=24.0,
    robot_time=0.02,
)


def feed(decoder: StateDecoder, layout: Layout, state: State, now: float) -> None:
    (_, attitude), (_, joints) = encode_state(layout, state)
    decoder.attitude(attitude, now)
    decoder.joints(joints, now)


def shaken(k: int) -> State:
    return replace(STATE, sequence=10 + k, gyro=np.full(3, 1e-3 * k), robot_time=0.02 + 2e-3 * k)


def test_states_arrive_with_the_local_time_and_count() -> None:
    decoder = StateDecoder(WTW, ROBOT.joint_names)
    for k in range(3):
        feed(decoder, WTW, shaken(k), 100.0 + k)
    states = decoder.drain()
    assert [(s.time, s.sequence, s.robot_time) for s in states] == [
        (100.0, 0, pytest.approx(0.02)),
        (101.0, 1, pytest.approx(0.022)),
        (102.0, 2, pytest.approx(0.024)),
    ]
    assert decoder.latest is states[-1]
    assert decoder.drain() == []


def test_a_lost_state_is_missing_in_the_count_where_the_robot_counts() -> None:
    for layout, expected in ((WTW, [0, 1, 5]), (CHEETAH, [0, 1, 2])):
        decoder = StateDecoder(layout, ROBOT.joint_names)
        for k in (0, 1, 5):
            feed(decoder, layout, shaken(k), k * 2e-3)
        assert [s.sequence for s in decoder.drain()] == expected


def test_late_and_doubled_states_are_dropped_where_the_robot_counts() -> None:
    decoder = StateDecoder(WTW, ROBOT.joint_names)
    for k in (0, 2, 1, 2, 3):
        feed(decoder, WTW, shaken(k), 0.01)
    assert [s.sequence for s in decoder.drain()] == [0, 2, 3]
    assert decoder.counts["out of order"] == 2
    # A robot that was started again counts from the beginning, and a broken count is no count.
    feed(decoder, WTW, replace(shaken(9), sequence=10**9), 0.02)
    feed(decoder, WTW, replace(shaken(8), sequence=1), 0.02)
    assert [s.sequence for s in decoder.drain()] == [4, 5]


@pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])
def test_frozen_values_make_no_states_however_their_count_lives(layout: Layout) -> None:
    decoder = StateDecoder(layout, ROBOT.joint_names)
    for k in range(50):
        feed(decoder, layout, replace(STATE, sequence=10 + k, robot_time=1.0 + k), 2e-3 * k)
    assert len(decoder.drain()) == 1
    assert decoder.counts["repeated"] == 49
    feed(decoder, layout, shaken(60), 0.2)
    assert len(decoder.drain()) == 1


def test_joints_without_a_young_attitude_make_no_state() -> None:
    decoder = StateDecoder(CHEETAH, ROBOT.joint_names)
    (_, attitude), (_, joints) = encode_state(CHEETAH, STATE)
    decoder.joints(joints, 0.0)
    assert decoder.counts["no attitude"] == 1
    decoder.attitude(attitude, 1.0)
    decoder.joints(joints, 1.03)
    assert decoder.counts["no attitude"] == 2
    assert decoder.latest is None
    decoder.joints(joints, 1.01)
    assert decoder.latest is not None


def test_refusals_are_counted() -> None:
    decoder = StateDecoder(CHEETAH, ROBOT.joint_names)
    feed(decoder, WTW, STATE, 0.0)
    assert decoder.counts["refused: fingerprint"] == 2
    assert "another layout" in decoder.last_error
    feed(decoder, CHEETAH, replace(STATE, position=np.full(12, math.nan)), 0.0)
    assert decoder.counts["refused: not finite"] == 1
    decoder.beacon(b"none")
    assert not decoder.virtual
    decoder.beacon(clamp_message(ROBOT.joint_names, ("FR_knee",), 4))
    assert decoder.virtual
    assert decoder.held == (4, ("FR_knee",))


def states_at(times: np.ndarray) -> list[State]:
    return [replace(STATE, time=float(t)) for t in times]


def test_rate_and_gaps() -> None:
    check_rate("it", states_at(np.arange(100) * 2e-3), 500.0)
    with pytest.raises(HardwareError, match="sent 80 fresh states in 200 ms"):
        check_rate("it", states_at(np.arange(80) * 2e-3), 500.0)
    with pytest.raises(HardwareError, match="longest gap of 30 ms"):
        check_rate("it", states_at(np.append(np.arange(95) * 1.7e-3, 0.1898)), 500.0)
    check_rate("it", states_at(np.arange(5) * 40e-3), 500.0, Freshness(share=0.05, longest_gap_s=1))
    with pytest.raises(HardwareError, match="sent 0 fresh states"):
        check_rate("it", [], 500.0)


TABLE = """Iface	Destination	Gateway 	Flags	RefCnt	Use	Metric	Mask		MTU	Window	IRTT
eth0	00000000	010200C0	0003	0	0	0	00000000	0	0	0
eth0	000200C0	00000000	0001	0	0	0	00FFFFFF	0	0	0
"""
LAN = "wlan0	000000E0	00000000	0001	0	0	0	000000F0	0	0	0\n"
HOST = "robot	434CFFEF	00000000	0005	0	0	0	FFFFFFFF	0	0	0\n"


def test_the_interface_by_which_multicast_leaves() -> None:
    assert multicast_interface(TABLE) == "eth0"
    assert multicast_interface(TABLE + LAN) == "wlan0"
    assert multicast_interface(TABLE + HOST + LAN) == "robot"
    assert multicast_interface(TABLE.splitlines()[0]) is None


def test_nothing_leaves_this_computer_unless_an_interface_is_named() -> None:
    assert url_of() == f"udpm://239.255.76.67:{VIRTUAL_PORT}?ttl=0"
    assert url_of(port=9000).endswith(":9000?ttl=0")
    assert url_of(interface="lo") == "udpm://239.255.76.67:7667?ttl=0"
    with pytest.raises(HardwareError, match="LCM port 7667 is the real robots'"):
        url_of(port=7667)
    with pytest.raises(HardwareError, match="expected 1024 to 65535"):
        url_of(port=80)
    with pytest.raises(HardwareError, match=r"sudo ip route add 239\.255\.76\.67 dev nothing0"):
        url_of(interface="nothing0")
