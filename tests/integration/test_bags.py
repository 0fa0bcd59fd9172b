"""Bags of ROS 1 and ROS 2: joints by name, topics by type, Unitree's messages, hostile files."""

from __future__ import annotations

import bz2
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import accepted, refused
from pronk.errors import LogError, PronkError
from pronk.files import SIZE_LIMIT
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import find_logs, read_log
from pronk.identify.logs.unitree import DEFINITIONS, QUADRUPED_JOINTS
from pronk.report.motion import read_motion
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from ros_bags import CONTROLLER_STATE, START_NS, Build, Builder, Message, write_bag

GO2 = load_robot("go2")
NAMES = ("elbow", "lift", "pan")
"""The joints as a broadcaster sends them: in alphabetical order."""
ORDER = ("pan", "lift", "elbow")
"""The joints as the controller takes them."""
COUNT = 1000
TIME = 0.01 * np.arange(COUNT)
CHIRP = 0.2 * np.sin(2.0 * np.pi * (0.5 * TIME + 0.15 * TIME**2))
POSITION = 0.95 * np.interp(TIME - 0.02, TIME, CHIRP)
KINDS = ("mcap", "sqlite3", "sqlite3 message", "ros1", "ros1 bz2", "ros1 lz4")
STATE = "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


def nano(k: int) -> int:
    return START_NS + 10_000_000 * k


def arm(
    *, finger: bool = False, apart: bool = False, topic: str = "/position_controller/commands"
) -> Build:
    """An arm whose elbow follows a chirp, and a gripper that nobody commands."""

    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        for k in range(COUNT):
            command = builder.numbers([0.3, -0.2, CHIRP[k]])
            messages.append((topic, ARRAY, nano(k), command))
            names = [*NAMES, "finger"] if finger and not apart else [*NAMES]
            position = [POSITION[k], -0.2, 0.3, 0.01][: len(names)]
            state = builder.joint_state(nano(k), names, position)
            messages.append(("/joint_states", STATE, nano(k) + 1000, state))
            if apart:
                other = builder.joint_state(nano(k), ["finger"], [0.01])
                messages.append(("/joint_states", STATE, nano(k) + 2000, other))
        return messages

    return build


def commanded(
    names: Sequence[str] = NAMES,
    *,
    clock_offset_ns: int = 0,
    degrees: bool = False,
    stamped: bool = True,
    stuck: bool = False,
) -> Build:
    """The same arm, commanded by JointStates in another order than the states'."""
    scale = 180.0 / np.pi if degrees else 1.0

    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        for k in range(COUNT):
            values = {NAMES[0]: CHIRP[k], NAMES[1]: -0.2, NAMES[2]: 0.3}
            # The commands are received up to 3 ms late, which their stamps do not show.
            late = int(3e6 * (0.5 + 0.5 * np.sin(0.1 * k)))
            stamp = nano(k) + clock_offset_ns if stamped else 0
            numbers = [scale * values[name] for name in reversed(NAMES)]
            command = builder.joint_state(stamp, [*reversed(names)], numbers)
            messages.append(("/joint_command", STATE, nano(k) + late, command))
            stamp = nano(0 if stuck else k) if stamped else 0
            measured = [scale * value for value in (POSITION[k], -0.2, 0.3)]
            state = builder.joint_state(stamp, names, measured, [0.5, 0.0, 0.0], [1.0, 2.0, 3.0])
            messages.append(("/joint_states", STATE, nano(k) + 4_000_000, state))
        return messages

    return build


def read(path: Path, robot: Any = None, **options: Any) -> JointLog:
    return read_log(path, robot=robot, options=ReadOptions(**options))


def assert_elbow(log: JointLog, *, joint: str = "elbow") -> None:
    column = log.column(joint)
    rows = slice(COUNT - len(log.time), None)
    np.testing.assert_allclose(log.time, TIME[: len(log.time)], atol=1e-8)
    np.testing.assert_allclose(log.command[:, column], CHIRP[rows], atol=1e-12)
    np.testing.assert_allclose(log.position[:, column], POSITION[rows], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_any_kind_gives_the_numbers_by_name(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path / "bag", arm(), kind)
    log = read(path, joint_order=ORDER)
    assert log.joints == NAMES
    assert_elbow(log)
    np.testing.assert_allclose(log.command[:, 1], -0.2)
    np.testing.assert_allclose(log.position[:, 2], 0.3)
    assert len(log.origin.sha256) == 64
    assert find_logs([path]) == [path]
    assert log.excited_joints == ("elbow",)
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix in (".mcap", ".db3")]
        if "message" not in kind:
            assert_elbow(read(files[0], joint_order=",".join(ORDER)))


@pytest.mark.parametrize("apart", [False, True])
def test_a_gripper_without_a_command_is_left_out(tmp_path: Path, apart: bool) -> None:
    path = write_bag(tmp_path / "bag", arm(finger=True, apart=apart))
    log = read(path, joint_order=ORDER)
    assert log.joints == NAMES
    assert_elbow(log)
    assert any("finger" in note and "no command" in note for note in log.notes)


def test_an_order_names_unnamed_messages_alone(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", arm())
    with pytest.raises(LogError, match="--joint-order"):
        read(path)
    with pytest.raises(LogError, match="wrist"):
        read(path, joint_order=("pan", "lift", "wrist"))
    with pytest.raises(LogError, match="2 joint names"):
        read(path, joint_order=("pan", "lift"))


def test_names_of_the_command_decide_not_its_order(tmp_path: Path) -> None:
    log = read(write_bag(tmp_path / "bag", commanded()))
    assert log.joints == NAMES
    assert_elbow(log)
    assert log.velocity is not None
    assert log.torque is not None
    np.testing.assert_allclose(log.velocity[0], [0.5, 0.0, 0.0])
    np.testing.assert_allclose(log.torque[0], [1.0, 2.0, 3.0])
    for word in ("/joint_states", "/joint_command", "header stamps"):
        assert any(word in note for note in log.notes), word


def test_names_of_the_maker_and_stated_names_become_the_robots(tmp_path: Path) -> None:
    names = ("FL_calf_joint", "FL_thigh_joint", "FL_hip_joint")
    path = write_bag(tmp_path / "bag", commanded(names))
    log = read(path, GO2)
    assert log.joints == ("FL_knee", "FL_hip_pitch", "FL_hip_roll")
    assert_elbow(log, joint="FL_knee")
    assert any("FL_calf_joint" in note for note in log.notes)
    other = write_bag(tmp_path / "other", commanded(("k", "FL_thigh_joint", "fl_hip")))
    with pytest.raises(PronkError, match="--joint-names "):
        read(other, GO2)
    assert read(other, GO2, joint_names={"k": "FL_knee"}).joints == log.joints


def test_header_stamps_of_two_clocks_are_not_compared(tmp_path: Path) -> None:
    log = read(write_bag(tmp_path / "bag", commanded(clock_offset_ns=3 * 10**9)))
    assert any("two clocks" in note for note in log.notes)
    assert len(log.time) >= COUNT - 1
    unstamped = read(write_bag(tmp_path / "other", commanded(stamped=False)))
    assert any("times of reception" in note for note in unstamped.notes)
    stuck = read(write_bag(tmp_path / "stuck", commanded(stuck=True)))
    assert any("stand still" in note for note in stuck.notes)
    assert_elbow(stuck)
    # Received in this order, each state follows the command of its own tick.
    assert_elbow(unstamped)


def test_degrees_in_a_bag_are_refused_with_an_option_that_exists(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", commanded(degrees=True))
    sentence = refused("response", path, "--out", tmp_path / "out")
    assert "--unit deg" in sentence
    assert_elbow(read(path, unit="deg"))


@pytest.mark.parametrize("with_array", [False, True])
def test_the_state_of_a_trajectory_controller_holds_both(tmp_path: Path, with_array: bool) -> None:
    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        kind = builder.store.types[CONTROLLER]
        for k in range(COUNT):
            state = kind(
                header=builder.header(nano(k)),
                joint_names=[*NAMES],
                reference=builder.point([CHIRP[k], -0.2, 0.3]),
                feedback=builder.point([POSITION[k], -0.2, 0.3]),
            )
            messages.append(("/arm_controller/state", CONTROLLER, nano(k), state))
            if with_array:
                plain = builder.joint_state(nano(k), NAMES, [POSITION[k], -0.2, 0.3])
                messages.append(("/joint_states", STATE, nano(k), plain))
        return messages

    path = write_bag(tmp_path / "bag", build, definitions={CONTROLLER: CONTROLLER_STATE})
    assert_elbow(read(path))


@pytest.mark.parametrize("points", [1, 2])
def test_trajectories_of_one_point_are_commands(tmp_path: Path, points: int) -> None:
    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        kind = builder.store.types[TRAJECTORY]
        for k in range(COUNT):
            point = builder.point([CHIRP[k], -0.2, 0.3])
            command = kind(header=builder.header(0), joint_names=[*NAMES], points=[point] * points)
            messages.append(("/arm_controller/joint_trajectory", TRAJECTORY, nano(k), command))
            state = builder.joint_state(nano(k), NAMES, [POSITION[k], -0.2, 0.3])
            messages.append(("/joint_states", STATE, nano(k) + 1, state))
        return messages

    path = write_bag(tmp_path / "bag", build)
    if points == 1:
        assert_elbow(read(path))
    else:
        with pytest.raises(LogError, match="2 points"):
            read(path)


def test_a_topic_is_guessed_only_where_one_can_be_meant(tmp_path: Path) -> None:
    def build(builder: Builder) -> list[Message]:
        messages = list(arm()(builder))
        messages += arm(topic="/other/commands")(builder)[::2]
        return messages

    path = write_bag(tmp_path / "bag", build)
    with pytest.raises(LogError, match="--command-topic") as caught:
        read(path, joint_order=ORDER)
    assert "/other/commands" in str(caught.value)
    assert_elbow(read(path, joint_order=ORDER, command_topic="/other/commands"))
    with pytest.raises(LogError, match="types that are read"):
        read(path, measured_topic="/other/commands", joint_order=ORDER)


@pytest.mark.parametrize("topic", ["/effort_controller/commands", "/controller/commands"])
def test_torques_are_not_taken_for_positions(tmp_path: Path, topic: str) -> None:
    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        torque = np.gradient(np.gradient(POSITION, TIME), TIME)
        for k in range(COUNT):
            messages.append((topic, ARRAY, nano(k), builder.numbers([0.0, 0.0, torque[k]])))
            state = builder.joint_state(nano(k), NAMES, [POSITION[k], -0.2, 0.3])
            messages.append(("/joint_states", STATE, nano(k) + 1000, state))
        return messages

    with pytest.raises(LogError, match="--command-topic"):
        read(write_bag(tmp_path / "bag", build), joint_order=ORDER)


def test_joints_of_two_publishers_that_move_at_once_are_refused(tmp_path: Path) -> None:
    def build(builder: Builder) -> list[Message]:
        messages: list[Message] = []
        for k in range(COUNT):
            command = builder.joint_state(nano(k), ["left", "right"], [CHIRP[k], CHIRP[-k]])
            messages.append(("/joint_command", STATE, nano(k), command))
            for name, value in (("left", POSITION[k]), ("right", POSITION[-k])):
                state = builder.joint_state(nano(k), [name], [value])
                messages.append(("/joint_states", STATE, nano(k) + len(name), state))
        return messages

    with pytest.raises(LogError, match="2 publishers"):
        read(write_bag(tmp_path / "bag", build))


# --- Unitree --------------------------------------------------------------------------------------


def zeros(builder: Builder, name: str, **values: Any) -> Any:
    """A message of a known type, zero where no value is stated."""
    fields: dict[str, Any] = {}
    for field, (kind, description) in builder.store.fielddefs[name][1]:
        if field in values:
            fields[field] = values[field]
        elif kind.name == "BASE":
            fields[field] = 0
        elif kind.name == "NAME":
            fields[field] = zeros(builder, description)
        else:
            (_, base), size = description
            fields[field] = np.zeros(size, dtype=base[0])
    return builder.store.types[name](**fields)


def unitree(
    package: str = "unitree_go",
    *,
    motors: int = 12,
    stiffness: Sequence[float] = (25.0,) * COUNT,
    torque: Sequence[float] = (0.0,) * COUNT,
    passive: Sequence[int] = (),
    moving: int = 5,
    mode_pr: int = 0,
) -> Build:
    """Motors of Unitree's, one of which follows the chirp; the others of the message idle."""

    def build(builder: Builder) -> list[Message]:
        width = 20 if package == "unitree_go" else 35
        messages: list[Message] = []
        for k in range(COUNT):
            commands = []
            states = []
            for motor in range(width):
                used = motor < motors
                pose = 0.1 + 0.01 * motor if used else 0.0
                stopped = motor in passive or not used
                q = CHIRP[k] if motor == moving else 2.146e9 if stopped else pose
                commands.append(
                    zeros(
                        builder,
                        f"{package}/msg/MotorCmd",
                        q=q,
                        kp=0.0 if stopped else stiffness[k],
                        kd=0.0 if stopped else 0.6,
                        tau=torque[k] if motor == moving else 0.0,
                    )
                )
                states.append(
                    zeros(
                        builder,
                        f"{package}/msg/MotorState",
                        q=POSITION[k] if motor == moving else pose,
                        dq=0.5 * motor,
                        tau_est=0.25 * motor,
                    )
                )
            command = zeros(builder, f"{package}/msg/LowCmd", motor_cmd=commands)
            modes = {} if package == "unitree_go" else {"mode_pr": mode_pr}
            state = zeros(builder, f"{package}/msg/LowState", motor_state=states, **modes)
            messages.append(("/lowcmd", f"{package}/msg/LowCmd", nano(k), command))
            messages.append(("/lowstate", f"{package}/msg/LowState", nano(k) + 1000, state))
        return messages

    return build


@pytest.mark.parametrize("without_definitions", [False, True])
def test_a_go2_bag_is_read_with_its_gains(tmp_path: Path, without_definitions: bool) -> None:
    path = write_bag(
        tmp_path / "bag",
        unitree(),
        "sqlite3",
        definitions=DEFINITIONS,
        without_definitions=without_definitions,
    )
    log = read(path, GO2)
    assert log.joints == GO2.joint_names
    moving = GO2.joint_names.index("FL_knee")
    assert log.excited_joints == ("FL_knee",)
    np.testing.assert_allclose(log.command[:, moving], CHIRP, atol=1e-7)
    np.testing.assert_allclose(log.position[:, moving], POSITION, atol=1e-7)
    np.testing.assert_allclose(log.position[:, 7], 0.17, atol=1e-7)
    assert log.velocity is not None
    assert log.torque is not None
    np.testing.assert_allclose(log.velocity[3], 0.5 * np.arange(12))
    np.testing.assert_allclose(log.torque[3], 0.25 * np.arange(12))
    np.testing.assert_allclose(log.stiffness, 25.0)  # type: ignore[arg-type]
    np.testing.assert_allclose(log.damping, 0.6, atol=1e-7)  # type: ignore[arg-type]
    # Without a robot, twelve motors are those of a quadruped.
    assert read(path).joints == QUADRUPED_JOINTS
    assert "FL_knee" in accepted(
        "response", path, "--robot", "go2", "--no-plots", "--out", tmp_path / "out"
    )


def test_the_motion_of_a_bag_is_on_the_clock_of_its_messages(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", unitree(), "sqlite3", definitions=DEFINITIONS)
    os.utime(path, (0.0, 0.0))
    motion = read_motion(path, GO2, lambda: read(path, GO2))
    assert motion.notes == ()
    assert abs(int(motion.time_ns[0]) - START_NS) < 10**9


def test_motors_without_stiffness_are_left_out(tmp_path: Path) -> None:
    build = unitree(passive=(0, 1))
    log = read(write_bag(tmp_path / "bag", build, definitions=DEFINITIONS), GO2)
    assert log.joints == GO2.joint_names[2:]
    assert any("no stiffness" in note for note in log.notes)


def test_gains_that_change_before_the_excitation_are_cut_away(tmp_path: Path) -> None:
    ramp = np.concatenate([np.linspace(0.0, 25.0, 100), np.full(COUNT - 100, 25.0)])
    build = unitree(stiffness=ramp.tolist())
    log = read(write_bag(tmp_path / "bag", build, definitions=DEFINITIONS), GO2)
    np.testing.assert_allclose(log.stiffness, 25.0)  # type: ignore[arg-type]
    assert len(log.time) == COUNT - 99
    np.testing.assert_allclose(log.command[:, 5], CHIRP[99:], atol=1e-7)


@pytest.mark.parametrize("changed", ["stiffness", "torque"])
def test_what_a_position_command_does_not_say_is_refused(tmp_path: Path, changed: str) -> None:
    values = np.linspace(10.0, 30.0, COUNT).tolist()
    path = write_bag(tmp_path / "bag", unitree(**{changed: values}), definitions=DEFINITIONS)  # type: ignore[arg-type]
    with pytest.raises(LogError, match=r"gains change|added torque"):
        read(path, GO2)


def test_humanoids_need_an_order_where_it_is_not_known(tmp_path: Path) -> None:
    build = unitree("unitree_hg", motors=27)
    path = write_bag(tmp_path / "bag", build, definitions=DEFINITIONS)
    for robot in (None, GO2):
        with pytest.raises(LogError, match="--joint-order"):
            read(path, robot)
    order = ",".join(f"m{k}" for k in range(27))
    log = read(path, joint_order=order)
    assert log.joints == tuple(order.split(","))
    np.testing.assert_allclose(log.command[:, 5], CHIRP, atol=1e-7)


G1_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
G1_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll")
G1_WRIST = ("wrist_pitch", "wrist_yaw")
G1_MOTORS = {
    "left_hip_pitch_joint": 0,
    "left_knee_joint": 3,
    "right_hip_yaw_joint": 8,
    "right_ankle_roll_joint": 11,
    "waist_yaw_joint": 12,
    "left_shoulder_pitch_joint": 15,
    "left_elbow_joint": 18,
    "right_shoulder_roll_joint": 23,
    "right_wrist_roll_joint": 26,
}
"""Numbers of motors in the enumeration G1JointIndex of unitree_sdk2, for 23 and for 29 joints."""


def humanoid(folder: Path, *, whole: bool) -> RobotSpec:
    """A robot with the joints of a G1 of 29 or of 23 joints, in an order of its own."""
    names = ["waist_yaw_joint"]
    if whole:
        names += ["waist_roll_joint", "waist_pitch_joint"]
    for side in ("right", "left"):
        for part in (*G1_ARM, *(G1_WRIST if whole else ()), *G1_LEG):
            names.append(f"{side}_{part}_joint")
    bodies = ""
    servos = ""
    for name in names:
        bodies += (
            f'<body name="{name}_link"><joint name="{name}" range="-2 2" armature=".01"/>'
            '<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2"/></body>'
        )
        servos += f'<position joint="{name}" kp="40" kv="1" forcerange="-50 50"/>'
    path = folder / f"humanoid{len(names)}.xml"
    path.write_text(
        '<mujoco model="g1"><compiler angle="radian"/><worldbody><body name="pelvis" pos="0 0 1">'
        f'<geom size=".1"/>{bodies}</body></worldbody><actuator>{servos}</actuator></mujoco>'
    )
    return load_robot(path)


@pytest.fixture(scope="module")
def humanoids(tmp_path_factory: pytest.TempPathFactory) -> list[RobotSpec]:
    folder = tmp_path_factory.mktemp("g1")
    return [humanoid(folder, whole=True), humanoid(folder, whole=False)]


@pytest.mark.parametrize("joint", G1_MOTORS)
def test_motors_of_a_g1_have_the_numbers_of_unitree(
    tmp_path: Path, joint: str, humanoids: list[RobotSpec]
) -> None:
    build = unitree("unitree_hg", motors=29, moving=G1_MOTORS[joint])
    path = write_bag(tmp_path / "bag", build, definitions=DEFINITIONS)
    for robot in humanoids:
        log = read(path, robot)
        assert log.excited_joints == (joint,)
        np.testing.assert_allclose(log.command[:, log.column(joint)], CHIRP, atol=1e-7)
        for other, motor in G1_MOTORS.items():
            if other != joint:
                resting = log.position[:, log.column(other)]
                np.testing.assert_allclose(resting, 0.1 + 0.01 * motor, atol=1e-7)


def test_linkages_of_a_g1_are_not_taken_for_its_joints(tmp_path: Path) -> None:
    build = unitree("unitree_hg", motors=29, moving=4, mode_pr=1)
    path = write_bag(tmp_path / "bag", build, definitions=DEFINITIONS)
    with pytest.raises(LogError, match="mode_pr"):
        read(path, humanoid(tmp_path, whole=True))
    order = ",".join(f"m{k}" for k in range(29))
    assert read(path, joint_order=order).excited_joints == ("m4",)


# --- Hostile and damaged files --------------------------------------------------------------------


def test_a_bag_that_was_cut_is_refused_by_its_name(tmp_path: Path) -> None:
    for kind, name in (("mcap", "a.mcap"), ("sqlite3", "a.db3"), ("ros1", "a.bag")):
        whole = write_bag(tmp_path / kind, commanded(), kind)
        files = [whole] if whole.is_file() else [*whole.glob("*.mcap"), *whole.glob("*.db3")]
        (tmp_path / name).write_bytes(files[0].read_bytes()[: files[0].stat().st_size // 2])
        with pytest.raises(LogError, match=name):
            read(tmp_path / name)


def test_a_database_that_computes_its_messages_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM "
            "n) SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000) AS data FROM n"
        )
    database.close()
    with pytest.raises(LogError, match="computed"):
        read(path)


def test_chunks_that_unpack_to_much_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = write_bag(tmp_path / "bag", commanded(), "ros1 bz2")
    data = whole.read_bytes()
    start = data.index(b"BZh")
    bomb = bz2.compress(bytes(2**26))
    # The bomb takes the place of the beginning of a chunk.
    whole.write_bytes(data[:start] + bomb + data[start + len(bomb) :])
    monkeypatch.setenv(SIZE_LIMIT, "8")
    with pytest.raises(LogError, match=r"8 MiB|cannot be decoded"):
        read(whole)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_images_in_a_bag_take_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    def build(builder: Builder) -> list[Message]:
        messages = list(commanded()(builder))
        image = "sensor_msgs/msg/CompressedImage"
        noise = np.random.default_rng(0).integers(0, 255, 2**20, dtype=np.uint8)
        for k in range(8):
            picture = builder.store.types[image](
                header=builder.header(nano(k)), format="jpeg", data=noise
            )
            messages.append(("/camera", image, nano(k), picture))
        return messages

    path = write_bag(tmp_path / "bag", build, kind)
    monkeypatch.setenv(SIZE_LIMIT, "4")
    assert_elbow(read(path))
    with pytest.raises(LogError, match=r"/camera \(sensor_msgs/msg/CompressedImage\)"):
        read(path, command_topic="/elsewhere")


def test_metadata_that_names_a_file_elsewhere_is_not_followed(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", commanded())
    (file,) = folder.glob("*.mcap")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace(file.name, "../../../etc/passwd"))
    with pytest.raises(LogError, match="passwd"):
        read(folder)
