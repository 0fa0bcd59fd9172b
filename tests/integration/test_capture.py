"""What is seen of the virtual robot from outside: geometry, contacts, power, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from pronk.errors import ArtefactError, HardwareError
from pronk.files import save_arrays
from pronk.jump.virtual.capture import SCHEMA, Capture, load_capture, save_capture
from pronk.jump.virtual.ground import Ground, Start
from pronk.jump.virtual.plant import Plant, legs_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.robots.machine import Command
from virtual_robot import POSE, ROBOT, SIM_PARAMS, connected, gains

KNEES = [index for index, name in enumerate(ROBOT.joint_names) if name.endswith("knee")]
HIP_PITCHES = [index - 1 for index in KNEES]


def hopped(**options: Any) -> VirtualRobot:
    """A robot that has stretched its legs at once, left the ground and come back."""
    start = Start(position=(0.3, -0.2), yaw=0.4, settle_s=1.5)
    machine = connected(base="ground", start=start, **options)
    stretched = POSE.copy()
    stretched[KNEES] = 1.1
    stretched[HIP_PITCHES] = -0.55
    machine.send(Command(position=stretched, **gains(20.0, 0.5)))
    machine.wait(0.1)
    machine.send(Command(position=POSE, **gains(30.0, 1.5)))
    machine.wait(0.7)
    return machine


@pytest.fixture(scope="module")
def machine() -> VirtualRobot:
    return hopped()


@pytest.fixture(scope="module")
def seen(machine: VirtualRobot) -> Capture:
    return machine.capture()


def test_samples_are_a_millisecond_apart_from_the_clocks_zero(seen: Capture) -> None:
    # The physics has been taken to the instant that the last state was measured at.
    assert len(seen.time) == 700
    np.testing.assert_allclose(seen.time, np.arange(700) / 1000.0, atol=1e-12)
    assert seen.dt == pytest.approx(1e-3)
    assert np.linalg.norm(seen.orientation, axis=1) == pytest.approx(1.0, abs=1e-12)


def posed(model: mujoco.MjModel, seen: Capture, samples: Sequence[int]) -> Iterator[mujoco.MjData]:
    """Put a model into the poses of samples."""
    data = mujoco.MjData(model)
    joints = [model.joint(name).qposadr[0] for name in ROBOT.joint_names]
    for sample in samples:
        data.qpos[:3] = seen.position[sample]
        data.qpos[3:7] = seen.orientation[sample]
        data.qpos[joints] = seen.joint_position[sample]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        yield data


def test_feet_are_where_the_trunk_and_the_joints_put_them(seen: Capture) -> None:
    model = ROBOT.build_spec().compile()
    samples = (0, 120, 250, 699)
    sites = [model.site(f"{leg}_foot").id for leg in ("FR", "FL", "HR", "HL")]
    for sample, data in zip(samples, posed(model, seen, samples), strict=True):
        np.testing.assert_allclose(seen.foot_position[sample], data.site_xpos[sites], atol=1e-12)


def test_positions_are_what_velocities_add_up_to(seen: Capture) -> None:
    for place, speed in (
        (seen.position, seen.velocity),
        (seen.joint_position, seen.joint_velocity),
    ):
        moved = np.cumsum(0.5 * (speed[1:] + speed[:-1]), axis=0) * seen.dt
        np.testing.assert_allclose(place[1:] - place[0], moved, atol=0.01 * np.ptp(place))


def test_a_foot_touches_where_its_sphere_is_below_the_floor(seen: Capture) -> None:
    np.testing.assert_array_equal(seen.contact, seen.foot_position[..., 2] < 0.0175)
    airborne = ~seen.contact.any(axis=1)
    assert 0.05 < airborne.mean() < 0.9
    assert seen.contact[0].all()
    assert not seen.other_contact.any()


def test_parts_that_touch_are_those_that_reach_below_the_floor() -> None:
    # Drives without torque let it sink onto its thighs.
    machine = connected(base="ground", start=Start(settle_s=0.5), capture_rate_hz=100.0)
    machine.send(Command(position=POSE, **gains(0.0, 0.0)))
    machine.wait(1.5)
    capture = machine.capture()
    spec = ROBOT.build_spec()
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0))
    floor.name = "floor"
    model = spec.compile()
    geoms = []
    for geom in np.flatnonzero(model.geom_conaffinity):
        name = model.geom(geom).name
        if name != "floor" and not name.endswith("_foot_collision"):
            geoms.append(geom)
    expected = []
    for data in posed(model, capture, range(len(capture.time))):
        parts: list[str] = []
        for geom in geoms:
            distance = mujoco.mj_geomDistance(
                model, data, model.geom("floor").id, geom, 1.0, np.zeros(6)
            )
            part = model.body(model.geom_bodyid[geom]).name
            if distance < 0.0 and part not in parts:
                parts.append(part)
        expected.append("+".join(parts))
    assert capture.other_parts.tolist() == expected
    np.testing.assert_array_equal(capture.other_contact, capture.other_parts != "")
    assert expected[0] == ""
    assert any("+" in parts for parts in expected)


def test_in_the_air_the_trunk_and_legs_fall_together(seen: Capture) -> None:
    # Momentum of the whole robot, from the capture alone, changes by gravity.
    model = ROBOT.build_spec().compile()
    plant = Plant(ROBOT, SIM_PARAMS, legs_of(ROBOT), 0.25e-3, Ground()).model
    for body in range(1, model.nbody):
        name = model.body(body).name
        model.body_mass[body] = plant.body(name).mass[0]
        model.body_ipos[body] = plant.body(name).ipos
    airborne = np.flatnonzero(~seen.contact.any(axis=1))
    flight = airborne[airborne < airborne[0] + 40]
    centre = []
    for data in posed(model, seen, flight):
        centre.append(data.subtree_com[1].copy())
    fit = np.polyfit(seen.time[flight], np.array(centre), 2)
    np.testing.assert_allclose(2.0 * fit[0], [0.0, 0.0, -9.81], atol=0.05)


def test_power_is_what_the_battery_gives(seen: Capture) -> None:
    # Before any command, current squared times resistance.
    heat = 0.0
    for joint, torque in zip(ROBOT.joints, seen.torque[0], strict=True):
        constant, resistance = joint.drive.motor
        scale = SIM_PARAMS.joints[joint.name].torque_scale
        current = float(torque) / (scale * constant)
        heat += current**2 * resistance
    assert seen.electrical_power[0] == pytest.approx(heat, rel=0.02)
    assert heat > 1.0
    # The open-circuit voltage less what its resistance takes, a state later.
    machine = SIM_PARAMS.machine
    drop = machine.bus_resistance * seen.electrical_power / seen.bus_voltage
    assert np.corrcoef(drop[1:-3], machine.bus_voltage - seen.bus_voltage[4:])[0, 1] > 0.9
    assert seen.electrical_power.max() > 200.0


def test_a_snapshot_is_the_last_sample(machine: VirtualRobot, seen: Capture) -> None:
    now = machine.snapshot()
    assert now.time == pytest.approx([0.699])
    for part in fields(Capture):
        snapshot = getattr(now, part.name)[0]
        sample = getattr(seen, part.name)[-1]
        # The battery has sagged a little further since: it does so after each state.
        tolerance = 1e-3 if part.name == "bus_voltage" else 1e-12
        if part.name == "other_parts":
            assert snapshot == sample
            continue
        np.testing.assert_allclose(snapshot, sample, rtol=tolerance)


def test_capture_does_not_change_the_motion() -> None:
    captured = hopped(capture_rate_hz=1000.0)
    not_captured = hopped(capture_rate_hz=None)
    captured_faster = hopped(capture_rate_hz=4000.0)
    captured.capture()
    captured.snapshot()
    for machine in (captured, not_captured, captured_faster):
        machine.wait(0.75)
    position = captured.snapshot().position
    np.testing.assert_array_equal(position, not_captured.snapshot().position)
    np.testing.assert_array_equal(position, captured_faster.snapshot().position)
    fast_capture = captured_faster.capture()
    assert len(fast_capture.time) == 4 * 749 + 1
    np.testing.assert_array_equal(fast_capture.position[::4], captured.capture().position)


@pytest.mark.parametrize("rate", [300.0, 1500.0])
def test_samples_between_states_are_taken_at_the_steps_nearest_to_them(rate: float) -> None:
    every_step = hopped(capture_rate_hz=4000.0).capture()
    capture = hopped(capture_rate_hz=rate).capture()
    steps = np.rint(np.arange(len(capture.time)) * 4000.0 / rate).astype(int)
    assert steps[-1] < len(every_step.time) <= steps[-1] + 4000.0 / rate + 1.0
    for part in fields(Capture):
        expected = getattr(every_step, part.name)[steps]
        np.testing.assert_array_equal(getattr(capture, part.name), expected)


def test_capture_outlives_the_connection_and_is_stored(seen: Capture, tmp_path: Path) -> None:
    other = hopped()
    other.close()
    assert len(other.capture().time) == len(seen.time)
    other.connect()
    assert len(other.capture().time) == 0
    assert np.isnan(other.capture().dt)
    path = tmp_path / "hop.capture.npz"
    save_capture(path, seen)
    back = load_capture(path)
    for part in fields(Capture):
        loaded = getattr(back, part.name)
        saved = getattr(seen, part.name)
        assert loaded.dtype == saved.dtype
        np.testing.assert_array_equal(loaded, saved)


def test_a_capture_of_an_earlier_pronk_does_not_know_the_parts(
    seen: Capture, tmp_path: Path
) -> None:
    lying = replace(
        seen,
        other_contact=np.ones(len(seen.time), dtype=bool),
        other_parts=np.full(len(seen.time), "trunk"),
    )
    arrays = {part.name: getattr(lying, part.name) for part in fields(Capture)}
    del arrays["other_parts"]
    path = tmp_path / "earlier.capture.npz"
    save_arrays(path, {"schema": SCHEMA}, arrays)
    back = load_capture(path)
    assert set(back.other_parts) == {""}
    for name, array in arrays.items():
        np.testing.assert_array_equal(getattr(back, name), array)
    save_capture(path, lying)
    assert set(load_capture(path).other_parts) == {"trunk"}


def test_files_that_are_no_capture(seen: Capture, tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    arrays = {}
    for part in fields(Capture):
        arrays[part.name] = getattr(seen, part.name)
    missing = dict(arrays)
    del missing["contact"]
    for schema, stored, named in (
        ("pronk/capture/9", arrays, "pronk/capture/9"),
        (SCHEMA, {**arrays, "torque": seen.torque[:, :3]}, "torque"),
        (SCHEMA, missing, "capture"),
    ):
        save_arrays(path, {"schema": schema}, stored)
        with pytest.raises(ArtefactError, match=named):
            load_capture(path)
    with pytest.raises(ArtefactError, match="contact"):
        replace(seen, contact=seen.contact[:5])


def test_nothing_is_captured_on_the_bench_or_unconnected() -> None:
    bench = connected(legs=("FR",))
    for machine in (bench, VirtualRobot(ROBOT, SIM_PARAMS, base="ground")):
        for look in (machine.capture, machine.snapshot):
            with pytest.raises(HardwareError, match=r"ground|connect"):
                look()
