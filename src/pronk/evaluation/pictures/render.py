"""The process that renders a film offscreen by MuJoCo.

    python -m pronk.evaluation.pictures.render [FILM [FILE.mp4|FILE.gif|FILE.png ...]]

`video` starts it with a GL backend (MUJOCO_GL), which must be chosen before mujoco is imported.
A failure is one line on standard error. Without a film it renders one small image, as a check of
the backend.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from pronk.errors import PronkError
from pronk.evaluation.pictures import overlay
from pronk.evaluation.pictures.film import FPS, SCHEMA, Film
from pronk.evaluation.pictures.overlay import DISTANCE, ELEVATION, FOV_DEG, TAPE_HALF_M
from pronk.files import load_artefact, written_whole
from pronk.robots import load_robot

WIDTH, HEIGHT = 640, 400
"""Of a frame [px]."""
STRIP_WIDTH = 270
"""Of a pose in a strip [px]."""
GIF_WIDTH = 360
"""[px]"""
_GIF_BEFORE_S, _GIF_AFTER_S, _GIF_SKIP = 0.6, 0.8, 2
"""A GIF has every second frame of the jump and a little around it."""
_OVERSAMPLE = 2
"""Pixels rendered for each pixel of the image, each way."""
_WORLD = f"""
<mujoco>
  <statistic extent="1" center="0 0 .3"/>
  <visual>
    <global fovy="{FOV_DEG}" offwidth="{WIDTH * _OVERSAMPLE}" offheight="{HEIGHT * _OVERSAMPLE}"/>
    <quality offsamples="0" shadowsize="2048" numslices="20" numstacks="10"/>
    <headlight ambient=".38 .38 .4" diffuse=".22 .22 .22" specular="0 0 0"/>
    <map zfar="60" shadowclip="1.6" fogstart="5" fogend="14"/>
    <rgba haze=".87 .9 .93 1"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".47 .6 .74" rgb2=".87 .9 .93"
      width="128" height="768"/>
    <texture name="floor" type="2d" builtin="checker" mark="edge" rgb1=".43 .46 .49"
      rgb2=".46 .49 .52" markrgb=".36 .39 .42" width="512" height="512"/>
    <material name="floor" texture="floor" texrepeat="1 1" texuniform="true" specular=".05"
      shininess=".1"/>
  </asset>
  <worldbody>
    <light name="sun" type="directional" mode="trackcom" diffuse=".62 .61 .58"
      specular=".25 .25 .25"/>
    <geom name="floor" type="plane" size="0 0 .5" material="floor" contype="0" conaffinity="0"
      group="2"/>
  </worldbody>
</mujoco>
"""
"""Floor with squares of 1 m, sky and sun."""


def stage(film: Film) -> Any:
    """Build a mujoco.MjModel of the robot on its ground, with a tape every 20 cm (paper E7)."""
    spec = mujoco.MjSpec.from_string(_WORLD)
    right = np.array([math.sin(film.azimuth), -math.cos(film.azimuth), 0.0])
    ahead = np.array([math.cos(film.azimuth), math.sin(film.azimuth), 0.0])
    sun = spec.light("sun")
    sun.dir = 0.18 * right + 0.32 * ahead + (0.0, 0.0, -1.0)
    sun.pos = -3.0 * np.array(sun.dir)
    for mark, place in overlay.tape_points(film, 0.0).items():
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.012 if mark % 5 == 0 else 0.006, TAPE_HALF_M, 0.0005),
            pos=place + np.array([0.0, 0.0, 0.0008]),
            quat=(math.cos(0.5 * film.direction), 0.0, 0.0, math.sin(0.5 * film.direction)),
            rgba=(0.93, 0.93, 0.9, 1.0) if mark else (1.0, 0.55, 0.1, 1.0),
            contype=0,
            conaffinity=0,
            group=2,
        )
    spec.attach(load_robot(film.robot).build_spec(), prefix="", frame=spec.worldbody.add_frame())
    return spec.compile()


def images(film: Film) -> Iterator[Image.Image]:
    """Render the film's frames, then the poses of its strip, without text."""
    model = stage(film)
    data = mujoco.MjData(model)
    columns = [model.joint(name).qposadr[0] for name in load_robot(film.robot).joint_names]
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.distance, camera.elevation = DISTANCE, math.degrees(ELEVATION)
    camera.azimuth = math.degrees(film.azimuth)
    option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    beside = film.pose_qpos[:, :3].copy()
    beside[:, 2] = film.look[:, 2].mean()
    poses, looks = np.vstack([film.qpos, film.pose_qpos]), np.vstack([film.look, beside])
    with closing(mujoco.Renderer(model, HEIGHT * _OVERSAMPLE, WIDTH * _OVERSAMPLE)) as renderer:
        for pose, look in zip(poses, looks, strict=True):
            data.qpos[:7], data.qpos[columns] = pose[:7], pose[7:]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            camera.lookat[:] = look
            renderer.update_scene(data, camera, option)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 1
            yield Image.fromarray(renderer.render()).reduce(_OVERSAMPLE)


def in_gif(film: Film) -> range:
    """Frames of the GIF."""
    if not film.events:
        return range(0, len(film.time), _GIF_SKIP)
    span = film.events.liftoff - _GIF_BEFORE_S, film.events.touchdown + _GIF_AFTER_S
    first, last = np.searchsorted(film.time, span[0]), np.searchsorted(film.time, span[1], "right")
    return range(int(first), int(last), _GIF_SKIP)


def write_gif(path: Path, frames: list[Image.Image]) -> None:
    """Write an animation that loops, with one palette and no dither: what stands still is small."""
    chosen = frames[:: max(1, len(frames) // 5)]
    montage = Image.fromarray(np.vstack([np.asarray(image) for image in chosen]))
    palette = montage.quantize(80, Image.Quantize.MAXCOVERAGE)
    first, *rest = [i.quantize(palette=palette, dither=Image.Dither.NONE) for i in frames]
    duration = round(1000.0 * _GIF_SKIP / FPS)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)


def movie(path: Path) -> Any:
    """Open an MP4 in H.264, 4:2:0, which every browser plays; frames are sent to it."""
    import imageio_ffmpeg

    options = "-crf 23 -preset veryfast -movflags +faststart -threads 1"
    return imageio_ffmpeg.write_frames(
        str(path),
        (WIDTH, HEIGHT),
        fps=FPS,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=options.split(),
    )


def render(film: Film, files: dict[str, Path]) -> None:
    """Render a film into files by suffix (.mp4, .gif, .png), each whole or not at all."""
    kept = set(in_gif(film)) if ".gif" in files else set()
    animation, strip = [], []
    with ExitStack() as stack:
        aside = {end: stack.enter_context(written_whole(path)) for end, path in files.items()}
        mp4 = stack.enter_context(closing(movie(aside[".mp4"]))) if ".mp4" in files else None
        if mp4 is not None:
            mp4.send(None)
        for index, image in enumerate(images(film)):
            if index >= len(film.time):
                left = (WIDTH - STRIP_WIDTH) // 2
                strip.append(np.asarray(image)[:, left : left + STRIP_WIDTH])
                continue
            if index in kept:
                size = (GIF_WIDTH, GIF_WIDTH * HEIGHT // WIDTH)
                animation.append(image.resize(size, Image.Resampling.BOX))
                overlay.draw_frame(animation[-1], film, index)
            if mp4 is not None:
                overlay.draw_frame(image, film, index)
                mp4.send(image.tobytes())
        if ".gif" in files:
            write_gif(aside[".gif"], animation)
        if ".png" in files:
            still = Image.fromarray(np.hstack(strip))
            overlay.draw_strip(still, film)
            still.save(aside[".png"], "PNG", optimize=True)


def check_gl() -> None:
    """Render one small image; raise `PronkError` if it is black."""
    world = "<mujoco><worldbody><light/><geom size='1'/></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(world)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer: Any
    with closing(mujoco.Renderer(model, 32, 32)) as renderer:
        renderer.update_scene(data)
        if not renderer.render().any():
            raise PronkError("the image is black.")


if __name__ == "__main__":
    source, *targets = map(Path, sys.argv[1:] or [""])
    try:
        if targets:
            made = load_artefact(source, Film, SCHEMA, what="a film", writer="pronk trial")
            render(made, {path.suffix: path for path in targets})
        else:
            check_gl()
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {' '.join(str(error).split())}")
