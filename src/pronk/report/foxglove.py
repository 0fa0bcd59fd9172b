"""The motion of a robot as an MCAP file that Foxglove shows in three dimensions.

The messages are those of the package `foxglove-schemas-protobuf`:

- `/tf`, foxglove.FrameTransforms: each link in its parent at 50 Hz, and once, on `/tf_static`, the
  links that do not move in their parent;
- `/robot`, foxglove.SceneUpdate, once: the shapes of the links, fixed to their frames;
- `/joint_states`, `/joint_commands`, foxglove.JointStates: rad, rad/s and N m, as that schema says;
- `/remarks`, foxglove.Log: excitations, changes of mode, faults.

Shapes are a scene and no URDF, as a URDF refers to files of meshes, which a log would not hold, and
an MJCF has what no URDF can say: bodies with several joints, ellipsoids, classes of materials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.files import written_whole
from pronk.report.motion import RobotMotion
from pronk.robots import MODEL_SUFFIXES, robot_file_path
from pronk.robots.load import read_robot_file
from pronk.robots.model import free_spec
from pronk.robots.robot import RobotSpec
from pronk.robots.source_model import read_source

FRAME_RATE_HZ = 50.0
"""Highest rate of the frames [Hz]; a screen shows 60."""
SHOWN_GROUPS = 3
"""Geoms of groups below this are shown, as in MuJoCo's viewer; the others are for contacts."""
MOST_TRIANGLES = 100_000
"""Triangles of all meshes up to which meshes are shown; of a robot with more each mesh is its
bounding box."""
WORLD = "world"
"""Frame of the ground."""


@dataclass(frozen=True)
class _Schemas:
    """Classes of messages of `foxglove-schemas-protobuf`, and the writer that fits them."""

    frames: Any
    scene: Any
    joints: Any
    log: Any
    writer: Any


def write_foxglove(path: Path, robot: RobotSpec, motion: RobotMotion) -> int:
    """Write the motion of a robot, whole or not at all.

    Args:
        path: File to write, `.mcap`.
        robot: The robot.
        motion: Its motion.

    Returns:
        Number of instants at which the frames are written.

    Raises:
        PronkError: The packages of the extra `foxglove` are missing, or the file cannot be written.
    """
    schemas = _load_schemas()
    model = free_spec(robot).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    addresses = [int(model.joint(joint).qposadr[0]) for joint in motion.joints]
    base_address = _base_address(model)
    moving = _moving_bodies(model, motion)
    resting = [body for body in range(1, model.nbody) if body not in moving]
    frame_numbers = np.unique((motion.time_ns - motion.time_ns[0]) * FRAME_RATE_HZ // 1e9)
    seconds = (motion.time_ns - motion.time_ns[0]) / 1e9
    rows = np.searchsorted(seconds, frame_numbers / FRAME_RATE_HZ)
    with written_whole(path) as temporary, temporary.open("wb") as stream:
        writer = schemas.writer(stream)
        first_ns = int(motion.time_ns[0])
        scene = _scene(schemas, robot, first_ns)
        writer.write_message("/robot", scene, first_ns, first_ns)
        for time_ns, sentence in motion.remarks:
            remark = schemas.log(level=schemas.log.INFO, message=sentence, name="pronk")
            remark.timestamp.FromNanoseconds(time_ns)
            writer.write_message("/remarks", remark, time_ns, time_ns)
        mujoco.mj_kinematics(model, data)
        static = _frames(schemas, model, data, resting, first_ns)
        writer.write_message("/tf_static", static, first_ns, first_ns)
        for row in rows:
            data.qpos[addresses] = motion.position[row]
            if motion.orientation is not None and base_address is not None:
                quaternion = motion.orientation[row]
                if np.isfinite(quaternion).all():
                    data.qpos[base_address + 3 : base_address + 7] = quaternion
            mujoco.mj_kinematics(model, data)
            time_ns = int(motion.time_ns[row])
            frames = _frames(schemas, model, data, moving, time_ns)
            writer.write_message("/tf", frames, time_ns, time_ns)
        for row, time in enumerate(motion.time_ns):
            time_ns = int(time)
            measured = _joint_states(schemas, motion, row)
            writer.write_message("/joint_states", measured, time_ns, time_ns)
            if np.isfinite(motion.command[row]).any():
                commanded = _joint_commands(schemas, motion, row)
                writer.write_message("/joint_commands", commanded, time_ns, time_ns)
        writer.add_metadata("pronk", {"robot": robot.name, "notes": "; ".join(motion.notes)})
        writer.finish()
    return len(rows)


def _load_schemas() -> _Schemas:
    """Import the messages; a PronkError says how the packages are installed."""
    try:
        from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
        from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
        from foxglove_schemas_protobuf.Log_pb2 import Log
        from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
        from mcap_protobuf.writer import Writer
    except ImportError as error:
        raise PronkError(
            f"logs for Foxglove need the package {error.name}; install it with "
            "`pip install 'pronk[foxglove]'`."
        ) from None
    return _Schemas(FrameTransforms, SceneUpdate, JointStates, Log, Writer)


def _base_address(model: mujoco.MjModel) -> int | None:
    """Return where the position of the free joint begins; None for a robot with a fixed base."""
    free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return int(model.jnt_qposadr[free_joints[0]]) if len(free_joints) else None


def _moving_bodies(model: mujoco.MjModel, motion: RobotMotion) -> list[int]:
    """Return the bodies that move in their parent, as the log has a joint between the two."""
    moving = []
    for body in range(1, model.nbody):
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            is_free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
            turned = is_free and motion.orientation is not None
            if turned or model.joint(joint).name in motion.joints:
                moving.append(body)
                break
    return moving


def _frames(
    schemas: _Schemas,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: Sequence[int],
    time_ns: int,
) -> Any:
    """Return the place of some bodies in their parents."""
    message = schemas.frames()
    for body in bodies:
        parent = int(model.body_parentid[body])
        inverse = np.zeros(4)
        mujoco.mju_negQuat(inverse, data.xquat[parent])
        position = np.zeros(3)
        mujoco.mju_rotVecQuat(position, data.xpos[body] - data.xpos[parent], inverse)
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, inverse, data.xquat[body])
        transform = message.transforms.add()
        transform.timestamp.FromNanoseconds(time_ns)
        transform.parent_frame_id = model.body(parent).name or WORLD
        transform.child_frame_id = model.body(body).name
        _set_vector(transform.translation, position)
        _set_quaternion(transform.rotation, quaternion)
    return message


def _joint_states(schemas: _Schemas, motion: RobotMotion, row: int) -> Any:
    """Return the measured state of the joints at an instant."""
    message = schemas.joints()
    message.timestamp.FromNanoseconds(int(motion.time_ns[row]))
    for column, name in enumerate(motion.joints):
        joint = message.joints.add()
        joint.name = name
        joint.position = motion.position[row, column]
        if motion.velocity is not None and np.isfinite(motion.velocity[row, column]):
            joint.velocity = motion.velocity[row, column]
        if motion.torque is not None and np.isfinite(motion.torque[row, column]):
            joint.effort = motion.torque[row, column]
    return message


def _joint_commands(schemas: _Schemas, motion: RobotMotion, row: int) -> Any:
    """Return the commanded positions of the joints at an instant."""
    message = schemas.joints()
    message.timestamp.FromNanoseconds(int(motion.time_ns[row]))
    for column, name in enumerate(motion.joints):
        if np.isfinite(motion.command[row, column]):
            joint = message.joints.add()
            joint.name = name
            joint.position = motion.command[row, column]
    return message


# ---- shapes ----


def _scene(schemas: _Schemas, robot: RobotSpec, time_ns: int) -> Any:
    """Return the shapes of all links, each fixed to the frame of its link."""
    path = robot_file_path(robot.source)
    if path.suffix not in MODEL_SUFFIXES:
        path = path.parent / read_robot_file(path).model
    source = read_source(path)
    model = source.model
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    triangles = int(model.mesh_facenum[model.geom_dataid[is_mesh]].sum())
    message = schemas.scene()
    for body in range(1, model.nbody):
        geoms = np.flatnonzero(model.geom_bodyid == body)
        shown = geoms[model.geom_group[geoms] < SHOWN_GROUPS]
        if len(shown) == 0:
            shown = geoms
        if len(shown) == 0:
            continue
        entity = message.entities.add()
        entity.timestamp.FromNanoseconds(time_ns)
        entity.frame_id = source.body_names[body]
        entity.id = source.body_names[body]
        entity.frame_locked = True
        for geom in shown:
            _add_shape(entity, model, int(geom), with_meshes=triangles <= MOST_TRIANGLES)
    return message


def _add_shape(entity: Any, model: mujoco.MjModel, geom: int, *, with_meshes: bool) -> None:
    """Add the shape of a geom; planes, height fields and signed distances are left out."""
    form = mujoco.mjtGeom(model.geom_type[geom])
    size = model.geom_size[geom]
    position = model.geom_pos[geom]
    quaternion = model.geom_quat[geom]
    radius = size[0]
    if form == mujoco.mjtGeom.mjGEOM_BOX:
        _add_solid(entity.cubes, model, geom, position, 2.0 * size)
    elif form == mujoco.mjtGeom.mjGEOM_SPHERE:
        _add_solid(entity.spheres, model, geom, position, np.full(3, 2.0 * radius))
    elif form == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        _add_solid(entity.spheres, model, geom, position, 2.0 * size)
    elif form in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        diameters = 2.0 * np.array([radius, radius, size[1]])
        cylinder = _add_solid(entity.cylinders, model, geom, position, diameters)
        cylinder.bottom_scale = 1.0
        cylinder.top_scale = 1.0
        if form == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half_axis = np.zeros(3)
            mujoco.mju_rotVecQuat(half_axis, np.array([0.0, 0.0, size[1]]), quaternion)
            for end in (position - half_axis, position + half_axis):
                _add_solid(entity.spheres, model, geom, end, np.full(3, 2.0 * radius))
    elif form == mujoco.mjtGeom.mjGEOM_MESH and with_meshes:
        _add_mesh(entity, model, geom)
    elif form == mujoco.mjtGeom.mjGEOM_MESH:
        centre = np.zeros(3)
        mujoco.mju_rotVecQuat(centre, model.geom_aabb[geom, :3], quaternion)
        _add_solid(entity.cubes, model, geom, position + centre, 2.0 * model.geom_aabb[geom, 3:])


def _add_solid(shapes: Any, model: mujoco.MjModel, geom: int, position: Array, size: Array) -> Any:
    """Add a shape of some size [m] with the attitude and the colour of a geom."""
    shape = shapes.add()
    _set_vector(shape.pose.position, position)
    _set_quaternion(shape.pose.orientation, model.geom_quat[geom])
    _set_vector(shape.size, size)
    _set_colour(shape.color, model, geom)
    return shape


def _add_mesh(entity: Any, model: mujoco.MjModel, geom: int) -> None:
    """Add the triangles of a mesh."""
    mesh = model.geom_dataid[geom]
    first_vertex = model.mesh_vertadr[mesh]
    first_face = model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[first_vertex : first_vertex + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]]
    shape = entity.triangles.add()
    _set_vector(shape.pose.position, model.geom_pos[geom])
    _set_quaternion(shape.pose.orientation, model.geom_quat[geom])
    _set_colour(shape.color, model, geom)
    for vertex in vertices:
        _set_vector(shape.points.add(), vertex)
    shape.indices.extend(faces.ravel().tolist())


def _set_vector(vector: Any, values: Array) -> None:
    """Fill a vector or a point."""
    vector.x = values[0]
    vector.y = values[1]
    vector.z = values[2]


def _set_quaternion(quaternion: Any, values: Array) -> None:
    """Fill a quaternion from MuJoCo's order w, x, y, z."""
    quaternion.w = values[0]
    quaternion.x = values[1]
    quaternion.y = values[2]
    quaternion.z = values[3]


def _set_colour(colour: Any, model: mujoco.MjModel, geom: int) -> None:
    """Fill a colour with that of a geom: of its material if it has one."""
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    colour.r = rgba[0]
    colour.g = rgba[1]
    colour.b = rgba[2]
    colour.a = rgba[3]
