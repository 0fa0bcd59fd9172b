"""The process that renders a film offscreen by MuJoCo.

    python -m pronk.jump.trial.films.render [FILM [FILE.mp4|FILE.gif|FILE.png ...]]

`video` starts it with a GL backend (MUJOCO_GL), which must be chosen before mujoco is imported.
A failure is one line on standard error. Without a film it renders one small image, as a check of
the backend.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.files import load_artefact, written_whole
from pronk.jump.trial.films.film import FPS, SCHEMA, Film
from pronk.robots import load_robot

Point = tuple[float, float]
Colour = tuple[int, int, int, int]

FOV_DEG = 40.0
"""Vertical field of view of the camera."""
ELEVATION = math.radians(-13.0)
"""Of the camera's view, negative down."""
DISTANCE = 1.9
"""From the camera to where it looks [m]."""
TAPE_M = 0.2
"""From tape to tape."""
TAPE_HALF_M = 0.26
"""Half the length of a tape, which lies across the direction of travel."""

_INK, _WHITE, _PANEL = (24, 28, 34, 255), (255, 255, 255, 255), (250, 250, 250, 200)
_DARK, _GREY, _ACCENT = (24, 28, 34, 215), (90, 97, 106, 255), (214, 95, 10, 235)
_REFERENCE = 400.0
"""Height of the image for which sizes are given [px]."""

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


# ---- the scene ----


def stage(film: Film) -> Any:
    """Build a mujoco.MjModel of the robot on its ground, with a tape every 20 cm (paper E7)."""
    spec = mujoco.MjSpec.from_string(_WORLD)
    right = np.array([math.sin(film.azimuth), -math.cos(film.azimuth), 0.0])
    ahead = np.array([math.cos(film.azimuth), math.sin(film.azimuth), 0.0])
    sun = spec.light("sun")
    sun.dir = 0.18 * right + 0.32 * ahead + (0.0, 0.0, -1.0)
    sun.pos = -3.0 * np.array(sun.dir)
    for mark, place in tape_points(film, 0.0).items():
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


# ---- text and lines on frames ----


def tape_points(film: Film, side: float) -> dict[int, Array]:
    """Points on the tapes under the film [m], by distance from lift-off in units of 0.2 m.

    `side` is the place across a tape: -1 and 1 are its right and left end.
    """
    along = np.array([math.cos(film.direction), math.sin(film.direction), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    way = (film.qpos[:, :2] - film.origin) @ along[:2]
    marks = range(math.floor(way.min() / TAPE_M) - 2, math.ceil(way.max() / TAPE_M) + 5)
    origin = np.array([*film.origin, 0.0])
    return {k: origin + k * TAPE_M * along + side * TAPE_HALF_M * across for k in marks}


def project(points: Array, look: Array, azimuth: float, size: tuple[int, int]) -> Array:
    """Project points of the world [m] (N, 3) into an image of a width and height [px].

    `look` is where the camera looks [m] (3,), `azimuth` that of its view [rad]. Returns right and
    down of the upper left corner [px], NaN behind the camera. (N, 2)
    """
    c, s = math.cos(ELEVATION), math.sin(ELEVATION)
    ahead = np.array([math.cos(azimuth) * c, math.sin(azimuth) * c, s])
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    relative = np.asarray(points) - (look - DISTANCE * ahead)
    depth = relative @ ahead
    focal = 0.5 * size[1] / math.tan(math.radians(0.5 * FOV_DEG))
    scale = focal / np.where(depth > 0, depth, np.nan)
    x, y = scale * (relative @ right), scale * (relative @ np.cross(right, ahead))
    return np.stack([0.5 * size[0] + x, 0.5 * size[1] - y], axis=1)


def draw_frame(image: Image.Image, film: Film, frame: int) -> None:
    """Write title, time, height, speed and distances on a frame, in place."""
    scale, size = image.height / _REFERENCE, image.size
    draw = ImageDraw.Draw(image, "RGBA")
    # Distances, at the end of every tape that is nearer to the camera.
    places = tape_points(film, -1.12 if math.sin(film.azimuth - film.direction) > 0.0 else 1.12)
    pixels = project(np.array([*places.values()]), film.look[frame], film.azimuth, size)
    for mark, (x, y) in zip(places, pixels.tolist(), strict=True):
        if 0.0 <= x <= size[0] and 0.0 <= y <= size[1] - 56.0 * scale:
            text = f"{TAPE_M * mark:.1f}" if mark else "0 m"
            draw.text((x, y), text, font=_font(11.0 * scale), fill=_WHITE, anchor="mt")
    _title(draw, film, image.width, scale)
    jumping, zero = film.jumping[frame], film.events.liftoff if film.events else film.time[0]
    parts = [f"{'lift-off ' * bool(film.events)}{film.time[frame] - zero:+.2f} s"]
    parts.append(f"trunk {film.qpos[frame, 2]:.2f} m")
    parts += [f"1/{1.0 / film.rate[frame]:g} speed"] if film.rate[frame] < 1.0 else []
    fill, ink = (_ACCENT, _WHITE) if jumping else (_PANEL, _INK)
    corner = (14.0 * scale, image.height - 14.0 * scale)
    words = "    ".join([*parts, *["jump!"] * bool(jumping)])
    _label(draw, words, corner, "ld", 13.0 * scale, fill=fill, ink=ink)
    _height_plot(draw, film, frame, (size[0] - 10.0 * scale, size[1] - 10.0 * scale), scale)


def draw_strip(image: Image.Image, film: Film) -> None:
    """Write title, and label, time and height of each of the side-by-side poses, in place."""
    scale = image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    _title(draw, film, image.width, scale)
    step = image.width / len(film.labels)
    for k, (label, since) in enumerate(zip(film.labels, film.pose_time.tolist(), strict=True)):
        words = f"{label}\n{since + 0.0:+.2f} s, {film.pose_qpos[k, 2]:.2f} m".strip()
        corner = ((k + 0.5) * step, image.height - 14.0 * scale)
        _label(draw, words, corner, "md", 14.0 * scale)


@cache
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(8.0, round(size)))


def _label(
    draw: ImageDraw.ImageDraw,
    text: str,
    corner: Point,
    anchor: str,
    size: float,
    *,
    fill: Colour = _PANEL,
    ink: Colour = _INK,
) -> None:
    """Write lines of text of a size [px] in a box; `anchor` is Pillow's, of the text's corner."""
    inner, align = 0.35 * size, "center" if anchor[0] == "m" else "left"
    how: Any = {"font": _font(size), "anchor": anchor, "align": align}
    left, top, right, bottom = draw.multiline_textbbox(corner, text, **how)
    box = (left - inner, top - inner, right + inner, bottom + inner)
    draw.rounded_rectangle(box, inner, fill=fill)
    draw.multiline_text(corner, text, fill=ink, **how)


def _title(draw: ImageDraw.ImageDraw, film: Film, width: int, scale: float) -> None:
    pad = 14.0 * scale
    _label(draw, f"{film.title}\n{film.note}".strip(), (pad, pad), "la", 15.0 * scale)
    corner = (width - pad, pad)
    _label(draw, "virtual robot", corner, "ra", 13.0 * scale, fill=_DARK, ink=_WHITE)


def _height_plot(
    draw: ImageDraw.ImageDraw, film: Film, frame: int, corner: Point, scale: float
) -> None:
    """Plot the trunk's height over time in a box with the given lower right corner."""
    (right, bottom), inner, width, depth = corner, 6.0 * scale, 150.0 * scale, 54.0 * scale
    draw.rounded_rectangle((right - width, bottom - depth, right, bottom), inner, fill=_PANEL)
    height, time = film.qpos[:, 2], film.time
    high = max(0.5, 1.08 * float(height.max()))

    def at(moment: float, z: float) -> Point:
        share = (moment - time[0]) / max(time[-1] - time[0], 1e-9)
        x = right - width + inner + (width - 2 * inner) * share
        return x, bottom - inner - (depth - 2 * inner) * z / high

    if film.events:
        box = (*at(film.events.liftoff, high), *at(film.events.touchdown, 0.0))
        draw.rectangle(box, fill=(*_ACCENT[:3], 45))
    points = [at(t, z) for t, z in zip(time.tolist(), height.tolist(), strict=True)]
    draw.line(points, fill=_GREY, width=max(1, round(1.2 * scale)))
    draw.line(points[: frame + 1], fill=_INK, width=max(1, round(2.0 * scale)))
    draw.circle(points[frame], 3.2 * scale, fill=_ACCENT)


# ---- files ----


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
                draw_frame(animation[-1], film, index)
            if mp4 is not None:
                draw_frame(image, film, index)
                mp4.send(image.tobytes())
        if ".gif" in files:
            write_gif(aside[".gif"], animation)
        if ".png" in files:
            still = Image.fromarray(np.hstack(strip))
            draw_strip(still, film)
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
