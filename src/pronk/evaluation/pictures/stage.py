"""Stages and camera of a film: outdoors with a tape every 20 cm (paper E7), and a studio.

The models are for kinematics and drawing only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.robots.robot import Robot
from pronk.virtual.ground import Ground

Array = NDArray[np.float64]

TAPE_M = 0.2
"""From tape to tape."""
TAPE_HALF_M = 0.26
"""Half the length of a tape, which lies across the way of travel."""
FOV_DEG = 40.0
"""Vertical field of view outdoors."""
STUDIO_HEIGHT_M = 1.2
"""What the studio's camera, an orthographic one, sees from bottom to top."""

_HAZE = (0.87, 0.90, 0.93)
_SKY = (0.47, 0.60, 0.74)
_FLOOR = ((0.43, 0.46, 0.49), (0.46, 0.49, 0.52))
_EDGE = (0.36, 0.39, 0.42)
_TAPE = (0.93, 0.93, 0.90, 1.0)
_ZERO = (1.0, 0.55, 0.10, 1.0)
_BLOCK = (0.62, 0.55, 0.45, 1.0)
_WALL = (0.90, 0.91, 0.93, 1.0)
_RULE = (0.74, 0.77, 0.81, 1.0)
_WALL_M = 0.75
"""From the way of travel to the wall."""
_ROUND = 20
"""Slices of a cylinder: enough to look round at this size, and vertices are what costs time."""
_MERE = {"contype": 0, "conaffinity": 0, "group": 2}


class Tape:
    """Stripes across the way of travel, at whole multiples of 20 cm from its zero."""

    def __init__(
        self, origin: tuple[float, float], direction: float, reach: tuple[float, float]
    ) -> None:
        """Lay it out.

        Args:
            origin: Its zero [m].
            direction: Of the way, in the world [rad].
            reach: First and last distance from zero that must be on it [m].
        """
        self.direction = direction
        self.along = np.array([math.cos(direction), math.sin(direction), 0.0])
        self.across = np.array([-self.along[1], self.along[0], 0.0])
        self.origin = np.array([*origin, 0.0])
        first, last = math.floor(reach[0] / TAPE_M) - 2, math.ceil(reach[1] / TAPE_M) + 4
        self.marks = tuple(range(first, last + 1))
        """In units of 20 cm."""

    def place(self, mark: int, side: float = 0.0) -> Array:
        """Where a stripe is; `side` -1 and 1 are its right and left end [m], (3,)."""
        return self.origin + mark * TAPE_M * self.along + side * TAPE_HALF_M * self.across

    def add_to(self, world: Any) -> None:
        """Stick it to the floor of a mujoco.MjSpec's world."""
        for mark in self.marks:
            world.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=(0.012 if mark % 5 == 0 else 0.006, TAPE_HALF_M, 0.0005),
                pos=self.place(mark) + np.array([0.0, 0.0, 0.0008]),
                quat=_turned(self.direction),
                rgba=_ZERO if mark == 0 else _TAPE,
                **_MERE,
            )


def outdoors(
    robot: Robot, *, size: tuple[int, int], ground: Ground, tape: Tape, azimuth: float
) -> Any:
    """A wide floor under the sky.

    Args:
        robot: Whose `build_spec` is drawn.
        size: Width and height of the largest image [px].
        ground: Floor and blocks.
        tape: On the floor; left out where there are blocks.
        azimuth: Of the camera's view, in the world [rad]; the sun is behind the camera.

    Returns:
        mujoco.MjModel
    """
    spec = _stage(robot, size, azimuth, ground.floor)
    # Shadows are cast around the sun's place, which must keep up with the robot.
    spec.light("sun").mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    spec.visual.global_.fovy = FOV_DEG
    spec.visual.rgba.haze = (*_HAZE, 1.0)
    spec.visual.map.fogstart, spec.visual.map.fogend = 5.0, 14.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=_SKY,
        rgb2=_HAZE,
        width=128,
        height=768,
    )
    for box in ground.terrain:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=box.half_size,
            pos=box.center,
            rgba=_BLOCK,
            **_MERE,
        )
    if not ground.terrain:
        tape.add_to(spec.worldbody)
    return spec.compile()


def studio(robot: Robot, *, size: tuple[int, int], elevation: float, reach: float) -> Any:
    """A floor and a wall with a line every 20 cm of height, for a camera that looks along +y.

    Args:
        robot: Whose `build_spec` is drawn; it is to stand at y = 0.
        size: Width and height of the largest image [px].
        elevation: Of the camera's view, negative down [rad]. The lines are put so that they are
            seen where heights over y = 0 are.
        reach: Largest x of a robot; the first one is at 0 [m].

    Returns:
        mujoco.MjModel
    """
    spec = _stage(robot, size, 0.5 * math.pi, 0.0)
    spec.visual.headlight.ambient = (0.55, 0.55, 0.56)
    spec.visual.headlight.diffuse = (0.3, 0.3, 0.3)
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.shadowclip = 0.5 * reach + 2.0
    spec.light("sun").pos += (0.5 * reach, 0.0, 0.0)
    spec.visual.global_.orthographic = 1
    spec.visual.global_.fovy = STUDIO_HEIGHT_M
    wide, high = 20.0, 3.0
    wall = {"type": mujoco.mjtGeom.mjGEOM_BOX, **_MERE}
    spec.worldbody.add_geom(
        size=(wide, 0.01, high), pos=(0.0, _WALL_M + 0.01, high), rgba=_WALL, **wall
    )
    for mark in range(1, 8):
        height = mark * TAPE_M + _WALL_M * math.tan(elevation)
        spec.worldbody.add_geom(
            size=(wide, 0.001, 0.0025), pos=(0.0, _WALL_M - 0.001, height), rgba=_RULE, **wall
        )
    return spec.compile()


def _stage(robot: Robot, size: tuple[int, int], azimuth: float, floor: float) -> Any:
    """Robot, floor and light."""
    spec = robot.build_spec()
    look = spec.visual
    look.global_.offwidth, look.global_.offheight = size
    look.quality.offsamples = 0  # frames are painted twice as large, which looks better
    look.quality.shadowsize = 2048
    look.quality.numslices, look.quality.numstacks = _ROUND, _ROUND // 2
    look.headlight.ambient = (0.38, 0.38, 0.40)
    look.headlight.diffuse = (0.22, 0.22, 0.22)
    look.headlight.specular = (0.0, 0.0, 0.0)
    look.map.zfar = 60.0
    look.map.shadowclip = 1.6
    spec.stat.extent, spec.stat.center = 1.0, (0.0, 0.0, 0.3)
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    ahead = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    shining = 0.18 * right + 0.32 * ahead + (0.0, 0.0, -1.0)
    sun = spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=-3.0 * shining,
        dir=shining,
    )
    sun.diffuse, sun.specular = (0.62, 0.61, 0.58), (0.25, 0.25, 0.25)
    # A checkerboard of 1 m squares, edged.
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=_FLOOR[0],
        rgb2=_FLOOR[1],
        markrgb=_EDGE,
        width=512,
        height=512,
    )
    material = spec.add_material(
        name="floor", texrepeat=(1.0, 1.0), texuniform=True, specular=0.05, shininess=0.1
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(0.0, 0.0, 0.5),
        pos=(0.0, 0.0, floor),
        material="floor",
        **_MERE,
    )
    return spec


def _turned(yaw: float) -> tuple[float, float, float, float]:
    return (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))


_ELEVATION = math.radians(-13.0)
_DISTANCE = 1.9


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera with perspective."""

    look: Array
    """Where it looks [m]. (3,)"""
    azimuth: float
    """Of its view, in the world [rad]."""
    elevation: float = _ELEVATION
    """Of its view, negative down [rad]."""
    distance: float = _DISTANCE
    """From where it looks [m]."""

    def pixels(self, points: Array, width: int, height: int) -> Array:
        """Where points of the world are in an image.

        Args:
            points: [m]. (N, 3)
            width: Of the image [px].
            height: Of the image [px].

        Returns:
            Right and down of the upper left corner [px]; NaN for points behind the camera. (N, 2)
        """
        cosine = math.cos(self.elevation)
        ahead = np.array(
            [
                math.cos(self.azimuth) * cosine,
                math.sin(self.azimuth) * cosine,
                math.sin(self.elevation),
            ]
        )
        right = np.array([math.sin(self.azimuth), -math.cos(self.azimuth), 0.0])
        up = np.cross(right, ahead)
        relative = np.asarray(points) - (self.look - self.distance * ahead)
        depth = relative @ ahead
        depth = np.where(depth > 1e-6, depth, np.nan)
        focal = 0.5 * height / math.tan(math.radians(0.5 * FOV_DEG))
        x = 0.5 * width + focal * (relative @ right) / depth
        y = 0.5 * height - focal * (relative @ up) / depth
        return np.stack([x, y], axis=-1)
