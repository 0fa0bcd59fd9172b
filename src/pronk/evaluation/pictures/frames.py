"""Frames and strips of a film, painted offscreen by MuJoCo.

The GL backend (MUJOCO_GL) must be chosen before mujoco is first imported;
`pronk.evaluation.pictures.video` does so in a process of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pronk.evaluation.pictures import overlay
from pronk.evaluation.pictures.film import Film
from pronk.evaluation.pictures.stage import STUDIO_HEIGHT_M, Tape, View, outdoors, studio
from pronk.robots import load_robot
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

WIDTH, HEIGHT = 640, 400
"""Of a frame [px]."""
STRIP_HEIGHT = 400
"""Of a strip [px]."""
_OVERSAMPLE = 2
"""Pixels painted for each pixel shown, each way."""
_STUDIO_ELEVATION = math.radians(-5.0)
_STUDIO_DISTANCE = 3.0
_GAP_M = 0.06
"""Between the robots of a strip."""
_MARGIN_M = 0.2
"""Beside the first and the last robot of a strip, and under their feet."""


class Painter:
    """Paints poses of a robot on a stage."""

    def __init__(self, robot: Robot, stage: Any, width: int, height: int) -> None:
        """Open a GL context.

        Args:
            robot: Who is on the stage.
            stage: mujoco.MjModel of `pronk.evaluation.pictures.stage`, made for the size of
            `pixels`.
            width: Of the images [px].
            height: Of the images [px].
        """
        self._model = stage
        self._datas: list[Any] = []
        self._columns = np.array([stage.joint(name).qposadr[0] for name in robot.joint_names])
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
        wide, high = pixels(width, height)
        self._renderer: Any = mujoco.Renderer(stage, high, wide, max_geom=4000)

    def paint(self, poses: Array, view: View) -> Image.Image:
        """Paint robots, all in one image.

        Args:
            poses: Trunk position, orientation and joints of each, in file order. (N, 7 + joints)
            view: From where.
        """
        model, renderer = self._model, self._renderer
        while len(self._datas) < len(poses):
            self._datas.append(mujoco.MjData(model))
        for data, pose in zip(self._datas, poses, strict=False):
            data.qpos[:7] = pose[:7]
            data.qpos[self._columns] = pose[7:]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = view.look
        camera.distance = view.distance
        camera.azimuth = math.degrees(view.azimuth)
        camera.elevation = math.degrees(view.elevation)
        renderer.update_scene(self._datas[0], camera, self._option)
        moving, nothing = mujoco.mjtCatBit.mjCAT_DYNAMIC.value, mujoco.MjvPerturb()
        for data in self._datas[1 : len(poses)]:
            mujoco.mjv_addGeoms(model, data, self._option, nothing, moving, renderer.scene)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 1
        return Image.fromarray(renderer.render()).reduce(_OVERSAMPLE)

    def close(self) -> None:
        """Close the GL context; some backends complain when the interpreter does it."""
        self._renderer.close()


def pixels(width: int, height: int) -> tuple[int, int]:
    """What is painted for an image of a size [px]."""
    return width * _OVERSAMPLE, height * _OVERSAMPLE


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One painted frame, without words."""

    index: int
    image: Image.Image
    view: View
    tape: Tape

    def worded(self, film: Film, width: int) -> Image.Image:
        """The frame at some width [px], with its words."""
        size = (width, round(width * self.image.height / self.image.width))
        image = self.image.copy()
        if size != image.size:
            image = image.resize(size, Image.Resampling.BOX)
        if not film.ground.terrain:
            overlay.draw_tape(image, self.tape, self.view)
        overlay.draw_words(image, film, self.index)
        return image


def frames(film: Film, *, width: int = WIDTH, height: int = HEIGHT) -> Iterator[Frame]:
    """Paint a film, one frame at a time.

    Args:
        film: The plan.
        width: Of the frames [px].
        height: Of the frames [px].
    """
    robot = load_robot(film.robot)
    azimuth = film.azimuth + film.quarter
    tape = Tape(film.origin, film.direction, _reach(film))
    size = pixels(width, height)
    stage = outdoors(robot, size=size, ground=film.ground, tape=tape, azimuth=azimuth)
    painter = Painter(robot, stage, width, height)
    try:
        for index in range(film.frames):
            view = View(look=film.look[index], azimuth=azimuth)
            image = painter.paint(film.qpos[index : index + 1], view)
            yield Frame(index=index, image=image, view=view, tape=tape)
    finally:
        painter.close()


def strip(film: Film) -> Image.Image:
    """The poses of a jump side by side, seen from the side, at their true heights.

    Args:
        film: The plan, of a jump.
    """
    robot = load_robot(film.robot)
    turned = _across(film.pose_qpos, 0.5 * math.pi - film.azimuth - 0.5 * film.quarter)
    widths = _widths(robot, turned)
    step = float(max(widths[:-1] + widths[1:])) / 2.0 + _GAP_M
    turned[:, 0] = step * np.arange(len(turned))
    turned[:, 1] = 0.0
    extent = float(turned[-1, 0] + 0.5 * (widths[0] + widths[-1])) + 2 * _MARGIN_M
    per_metre = STRIP_HEIGHT / STUDIO_HEIGHT_M
    width = 2 * round(0.5 * extent * per_metre)
    stage = studio(
        robot,
        size=pixels(width, STRIP_HEIGHT),
        elevation=_STUDIO_ELEVATION,
        reach=float(turned[-1, 0]),
    )
    middle = 0.5 * (turned[-1, 0] + 0.5 * (widths[-1] - widths[0]))
    floor = 0.5 * STUDIO_HEIGHT_M - _MARGIN_M
    view = View(
        look=np.array([middle, 0.0, floor]),
        azimuth=0.5 * math.pi,
        elevation=_STUDIO_ELEVATION,
        distance=_STUDIO_DISTANCE,
    )
    painter = Painter(robot, stage, width, STRIP_HEIGHT)
    try:
        image = painter.paint(turned, view)
    finally:
        painter.close()

    def at(x: float, z: float) -> tuple[float, float]:
        down = (z - floor) * math.cos(_STUDIO_ELEVATION) * per_metre
        return 0.5 * width + (x - middle) * per_metre, 0.5 * STRIP_HEIGHT - down

    overlay.draw_strip(image, film, [at(*pose[[0, 2]]) for pose in turned], at)
    return image


def _across(qpos: Array, turn: float) -> Array:
    """Poses turned about the world's z axis, (N, 7 + joints)."""
    turned = qpos.copy()
    c, s = math.cos(turn), math.sin(turn)
    turned[:, 0], turned[:, 1] = c * qpos[:, 0] - s * qpos[:, 1], s * qpos[:, 0] + c * qpos[:, 1]
    a, b = math.cos(0.5 * turn), math.sin(0.5 * turn)
    w, x, y, z = qpos[:, 3:7].T
    turned[:, 3:7] = np.stack([a * w - b * z, a * x - b * y, a * y + b * x, a * z + b * w], axis=1)
    return turned


def _widths(robot: Robot, poses: Array) -> Array:
    """Extent of each robot along x [m], (N,)."""
    model = robot.build_spec().compile()
    data = mujoco.MjData(model)
    columns = np.array([model.joint(name).qposadr[0] for name in robot.joint_names])
    found = []
    for pose in poses:
        data.qpos[:7] = pose[:7]
        data.qpos[columns] = pose[7:]
        mujoco.mj_kinematics(model, data)
        found.append(2.0 * np.abs(data.geom_xpos[:, 0] - pose[0]).max())
    return np.array(found)


def _reach(film: Film) -> tuple[float, float]:
    """First and last place of the trunk along the way [m]."""
    way = film.qpos[:, :2] - film.origin
    along = way @ (math.cos(film.direction), math.sin(film.direction))
    return float(along.min()), float(along.max())
