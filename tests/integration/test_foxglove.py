"""Logs for Foxglove: decoded by the official packages they give MuJoCo's forward kinematics."""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from command_line import accepted, refused
from log_files import write_csv, write_mcap
from pronk.deploy.runtime.log import DeployLogWriter
from pronk.deploy.runtime.records import TICK
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.segment import Segment
from pronk.identify.logs.sweep_writer import LogHeader, McapLogWriter
from pronk.robots import load_robot
from pronk.robots.model import free_spec

pytest.importorskip("foxglove_schemas_protobuf", reason="needs pronk[foxglove]")
pytest.importorskip("mcap_protobuf", reason="needs pronk[foxglove]")

MODEL = """
<mujoco model="odd_arm">
  <compiler angle="radian"/>
  <asset>
    <mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.3"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="upper" pos="0.1 -0.2 1" quat="0.9 0.1 -0.3 0.2">
      <joint name="shoulder" axis="0.2 1 0.1" pos="0.01 0 0.02" range="-1.5 1.5" armature="0.01"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0.1 0" mass="0.4" rgba="0.2 0.4 0.6 1"/>
      <body name="bracket" pos="0.2 0 0.05" euler="0.3 0.4 0.5">
        <geom type="box" size="0.01 0.02 0.03" mass="0.1"/>
        <body name="fore" pos="0 0.1 0">
          <joint name="elbow" axis="0 1 0" range="-1 2" armature="0.005"/>
          <geom type="mesh" mesh="wedge" mass="0.2" pos="0.03 0.02 0.01" euler="0.1 0.2 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="20" kv="1" forcerange="-8 8"/>
    <position joint="elbow" kp="10" kv="0.5" forcerange="-4 4"/>
  </actuator>
</mujoco>
"""
JOINTS = ("shoulder", "elbow")
RATE_HZ = 200.0


@pytest.fixture
def robot_file(tmp_path: Path) -> Path:
    path = tmp_path / "odd_arm.xml"
    path.write_text(MODEL)
    return path


def wave(seed: int = 0) -> JointLog:
    """Two joints that move for four seconds."""
    times = np.arange(800) / RATE_HZ + 0.3
    phases = np.random.default_rng(seed).uniform(0.0, 6.0, 2)
    angles = 0.5 * np.sin(3.0 * times[:, None] + phases)
    return JointLog(
        robot="odd_arm",
        joints=JOINTS,
        time=times,
        command=1.1 * angles,
        position=angles,
        velocity=1.5 * np.cos(3.0 * times[:, None] + phases),
        segments=(Segment(kind="chirp", joints=("elbow",), start=0.4, stop=3.0, amplitude=0.5),),
        pose=np.zeros(2),
        units=("rad", "rad"),
    )


def decoded(path: Path) -> tuple[dict[str, list[Any]], dict[str, list[int]], dict[str, Any]]:
    """Messages, log times and schemas by topic, as the official packages read them."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    messages: dict[str, list[Any]] = defaultdict(list)
    log_times: dict[str, list[int]] = defaultdict(list)
    schemas = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded_message in reader.iter_decoded_messages():
            messages[channel.topic].append(decoded_message)
            log_times[channel.topic].append(message.log_time)
            schemas[channel.topic] = schema
    return messages, log_times, schemas


def matrix(transform: Any) -> np.ndarray:
    """The 4 x 4 matrix of a transform."""
    rotation = np.zeros(9)
    turn = transform.rotation
    mujoco.mju_quat2Mat(rotation, np.array([turn.w, turn.x, turn.y, turn.z]))
    result = np.eye(4)
    result[:3, :3] = rotation.reshape(3, 3)
    shift = transform.translation
    result[:3, 3] = (shift.x, shift.y, shift.z)
    return result


def placed(frame: str, transforms: dict[str, Any]) -> np.ndarray:
    """Place of a frame in the world, through its parents."""
    result = np.eye(4)
    while frame != "world":
        result = matrix(transforms[frame]) @ result
        frame = transforms[frame].parent_frame_id
    return result


def largest_pose_error(
    model: mujoco.MjModel, messages: dict[str, list[Any]], seconds: np.ndarray, angles: np.ndarray
) -> float:
    """Largest difference of a frame to MuJoCo's forward kinematics over all instants [m, 1]."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    static = {frame.child_frame_id: frame for frame in messages["/tf_static"][0].transforms}
    error = 0.0
    for message in messages["/tf"]:
        transforms = static | {frame.child_frame_id: frame for frame in message.transforms}
        now = message.transforms[0].timestamp.ToNanoseconds() / 1e9
        row = int(np.argmin(np.abs(seconds - now)))
        for column, joint in enumerate(JOINTS):
            data.qpos[model.joint(joint).qposadr[0]] = angles[row, column]
        mujoco.mj_forward(model, data)
        for body in range(1, model.nbody):
            place = placed(model.body(body).name, transforms)
            error = max(error, np.abs(place[:3, 3] - data.xpos[body]).max())
            error = max(error, np.abs(place[:3, :3].ravel() - data.xmat[body]).max())
    return error


def test_frames_are_forward_kinematics_on_the_wall_clock(robot_file: Path, tmp_path: Path) -> None:
    log = wave()
    path = tmp_path / "elbow.mcap"
    before = time.time()
    write_mcap(path, log)
    after = time.time()
    out = tmp_path / "elbow.3d.mcap"
    accepted("log", "foxglove", path, "--robot", robot_file)
    messages, log_times, schemas = decoded(out)
    start_s = log_times["/tf"][0] / 1e9
    assert before - 0.2 <= start_s <= after
    assert log_times["/tf"][-1] / 1e9 - start_s == pytest.approx(
        log.time[-1] - log.time[0], abs=0.02
    )
    assert np.diff(log_times["/tf"]).min() >= 1.9e7  # 50 Hz or less
    seconds = start_s + log.time - log.time[0]
    model = mujoco.MjModel.from_xml_path(str(robot_file))
    assert len(messages["/tf"]) == pytest.approx(4.0 * 50.0, abs=2)
    assert largest_pose_error(model, messages, seconds, log.position) < 1e-6
    assert schemas["/tf"].name == "foxglove.FrameTransforms"
    assert schemas["/robot"].name == "foxglove.SceneUpdate"
    assert "elbow" in messages["/remarks"][0].message
    assert messages["/remarks"][0].timestamp.ToNanoseconds() / 1e9 - start_s == pytest.approx(
        0.1, abs=1e-4
    )


def test_joint_states_have_every_sample_in_the_units_of_the_schema(
    robot_file: Path, tmp_path: Path
) -> None:
    log = wave()
    path = tmp_path / "elbow.csv"
    write_csv(path, log)
    accepted("log", "foxglove", path, "--robot", robot_file, "--unit", "rad")
    messages, log_times, schemas = decoded(tmp_path / "elbow.3d.mcap")
    assert schemas["/joint_states"].name == "foxglove.JointStates"
    positions = []
    velocities = []
    for message in messages["/joint_states"]:
        assert [joint.name for joint in message.joints] == list(JOINTS)
        positions.append([joint.position for joint in message.joints])
        velocities.append([joint.velocity for joint in message.joints])
        assert not message.joints[0].HasField("effort")
    commands = []
    for message in messages["/joint_commands"]:
        commands.append([joint.position for joint in message.joints])
    np.testing.assert_array_equal(positions, log.position)
    np.testing.assert_array_equal(velocities, log.velocity)
    np.testing.assert_array_equal(commands, log.command)
    steps_s = np.diff(log_times["/joint_states"]) / 1e9
    np.testing.assert_allclose(steps_s, 1.0 / RATE_HZ, atol=1e-6)
    # A table has no wall clock: its end is that of the file.
    assert log_times["/joint_states"][-1] == pytest.approx(path.stat().st_mtime_ns, abs=1e6)


def test_schemas_are_those_of_the_package(robot_file: Path, tmp_path: Path) -> None:
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from mcap_protobuf.schema import build_file_descriptor_set

    path = tmp_path / "elbow.mcap"
    write_mcap(path, wave())
    accepted("log", "foxglove", path, "--robot", robot_file)
    _, _, schemas = decoded(tmp_path / "elbow.3d.mcap")
    expected = build_file_descriptor_set(FrameTransforms).SerializeToString()
    assert schemas["/tf"].encoding == "protobuf"
    assert sorted(schemas["/tf"].data) == sorted(expected)


def test_shapes_are_where_the_model_has_them(robot_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "elbow.mcap"
    write_mcap(path, wave())
    accepted("log", "foxglove", path, "--robot", robot_file)
    messages, _, _ = decoded(tmp_path / "elbow.3d.mcap")
    (scene,) = messages["/robot"]
    entities = {entity.frame_id: entity for entity in scene.entities}
    assert set(entities) == {"upper", "bracket", "fore"}
    assert all(entity.frame_locked for entity in scene.entities)
    ends = []
    for sphere in entities["upper"].spheres:
        centre = sphere.pose.position
        ends.append((centre.x, centre.y, centre.z))
        assert sphere.size.x == pytest.approx(0.04)
    np.testing.assert_allclose(sorted(ends), [(0, 0, 0), (0.2, 0.1, 0)], atol=1e-9)
    (cylinder,) = entities["upper"].cylinders
    assert cylinder.size.z == pytest.approx(np.hypot(0.2, 0.1))
    assert (cylinder.top_scale, cylinder.bottom_scale) == (1.0, 1.0)
    assert cylinder.color.b == pytest.approx(0.6)
    (box,) = entities["bracket"].cubes
    assert (box.size.x, box.size.y, box.size.z) == pytest.approx((0.02, 0.04, 0.06))
    # The corners of the mesh in the frame of its body, whatever MuJoCo makes of its own frame.
    (mesh,) = entities["fore"].triangles
    origin = np.array([mesh.pose.position.x, mesh.pose.position.y, mesh.pose.position.z])
    turn = mesh.pose.orientation
    corners = []
    for point in mesh.points:
        corner = np.zeros(3)
        quaternion = np.array([turn.w, turn.x, turn.y, turn.z])
        mujoco.mju_rotVecQuat(corner, np.array([point.x, point.y, point.z]), quaternion)
        corners.append(corner + origin)
    rotation = np.zeros(4)
    mujoco.mju_euler2Quat(rotation, np.array([0.1, 0.2, 0.3]), "xyz")
    expected = []
    for vertex in ((0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)):
        corner = np.zeros(3)
        mujoco.mju_rotVecQuat(corner, np.array(vertex, dtype=float), rotation)
        expected.append(corner + np.array([0.03, 0.02, 0.01]))
    assert len(corners) == 4
    for corner in expected:
        assert min(np.linalg.norm(corner - other) for other in corners) < 1e-6
    assert sorted(set(mesh.indices)) == [0, 1, 2, 3]
    assert len(mesh.indices) == 12


def test_run_of_a_policy_tilts_with_its_attitude(tmp_path: Path) -> None:
    robot = load_robot("mini_cheetah")
    path = tmp_path / "run.mcap"
    joints = list(robot.joint_names)
    writer = DeployLogWriter(path, {"robot": robot.name, "joints": joints, "link": "sim"})
    rng = np.random.default_rng(3)
    base_height = free_spec(robot).compile().key("default").qpos[2]
    attitudes = []
    for number in range(100):
        tick = np.zeros((), dtype=TICK)
        tick["tick"] = number
        tick["begun"] = 5.0 + 0.02 * number
        tick["position"] = rng.uniform(-0.5, 0.5, 12)
        tick["sent"] = np.nan if number < 10 else 0.1
        roll = 0.01 * number
        attitude = (np.cos(roll / 2), np.sin(roll / 2), 0.0, 0.0)
        attitudes.append(attitude)
        tick["orientation"] = attitude
        writer.write(np.frombuffer(tick.tobytes(), dtype=TICK)[0])
    writer.end(complete=True, figures={})
    said = accepted("log", "foxglove", path, "--robot", "mini_cheetah")
    assert "base was not measured" in said
    messages, log_times, _ = decoded(tmp_path / "run.3d.mcap")
    assert log_times["/tf"][0] / 1e9 < time.time() + 10.0
    assert log_times["/tf"][0] / 1e9 > 1.7e9
    assert len(messages["/joint_commands"]) == 90
    for message, attitude in zip(messages["/tf"], attitudes, strict=True):
        frames = {frame.child_frame_id: frame for frame in message.transforms}
        trunk = frames["trunk"]
        assert trunk.parent_frame_id == "world"
        turn = trunk.rotation
        np.testing.assert_allclose((turn.w, turn.x, turn.y, turn.z), attitude, atol=1e-9)
        assert trunk.translation.z == pytest.approx(base_height)
        assert len(frames) == 13


def test_log_times_of_a_recording_are_the_wall_clock(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = time.time()
    writer = McapLogWriter(path, LogHeader(robot="r", joints=("a",)))
    for k in range(10):
        writer.sample(1000.0 + 0.1 * k, [0.0], [0.1 * k])
    writer.end()
    after = time.time()
    messages, log_times = decoded_json(path)
    assert before - 1e-3 <= log_times["/sweep/sample"][0] / 1e9 <= after
    np.testing.assert_allclose(np.diff(log_times["/sweep/sample"]) / 1e9, 0.1, atol=1e-6)
    assert messages["/sweep/sample"][0]["t"] == 1000.0
    np.testing.assert_allclose(read_log(path).time, 1000.0 + 0.1 * np.arange(10))


def decoded_json(path: Path) -> tuple[dict[str, list[Any]], dict[str, list[int]]]:
    """Messages and log times of pronk's own topics."""
    from mcap.reader import make_reader

    messages: dict[str, list[Any]] = defaultdict(list)
    log_times: dict[str, list[int]] = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            messages[channel.topic].append(json.loads(message.data))
            log_times[channel.topic].append(message.log_time)
    return messages, log_times


def test_refusals(robot_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "elbow.mcap"
    write_mcap(path, wave())
    out = tmp_path / "out.mcap"
    words = ("log", "foxglove", path, "--out", out)
    assert "--robot" in refused(*words)
    assert "elbow" in refused(*words, "--robot", "so101")
    assert ".mcap" in refused("log", "foxglove", path, "--robot", robot_file, "--out", "x.bag")
    assert "itself" in refused(
        "log", "foxglove", path, "--robot", robot_file, "--out", path, "--overwrite"
    )
    monkeypatch.setitem(sys.modules, "foxglove_schemas_protobuf.FrameTransforms_pb2", None)
    assert "pronk[foxglove]" in refused(*words, "--robot", robot_file)
    assert not out.exists()
    monkeypatch.undo()
    accepted(*words, "--robot", robot_file)
    assert "--overwrite" in refused(*words, "--robot", robot_file)
