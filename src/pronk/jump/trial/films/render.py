"""The process that renders a film offscreen by MuJoCo.

    python -m pronk.jump.trial.films.render [FILM [FILE.mp4|FILE.gif|FILE.png ...]]

`video` starts it with a GL backend (MUJOCO_GL), which must be chosen before mujoco is imported.
A failure is one line on standard error. Without a film it renders one small image, as a check of
the backend.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.files import load_artefact, written_whole
from pronk.jump.trial.films.film import FPS, SCHEMA, Film
from pronk.robots import load_robot

Point = tuple[float, float]
"""Right and down of the upper left corner of an image [px]."""
Colour = tuple[int, int, int, int]
"""Red, green, blue and opacity, 0 to 255."""

FOV_DEG = 40.0
"""Vertical field of view of the camera [deg]."""
ELEVATION = math.radians(-13.0)
"""Elevation of the camera's view, negative down [rad]."""
DISTANCE = 1.9
"""Distance from the camera to where it looks [m]."""
TAPE_M = 0.2
"""Distance from tape to tape [m]."""
TAPE_HALF_M = 0.26
"""Half the length of a tape, which lies across the direction of travel [m]."""

_INK = (24, 28, 34, 255)
_WHITE = (255, 255, 255, 255)
_PANEL = (250, 250, 250, 200)
_DARK = (24, 28, 34, 215)
_GREY = (90, 97, 106, 255)
_ACCENT = (214, 95, 10, 235)
_FLIGHT = (214, 95, 10, 45)
_REFERENCE = 400.0
"""Height of the image for which sizes are given [px]."""

WIDTH = 640
"""Width of a frame [px]."""
HEIGHT = 400
"""Height of a frame [px]."""
STRIP_WIDTH = 270
"""Width of a pose in a strip [px]."""
GIF_WIDTH = 360
"""Width of a GIF [px]."""
_GIF_BEFORE_S = 0.6
"""Time before lift-off that a GIF shows [s]."""
_GIF_AFTER_S = 0.8
"""Time after touchdown that a GIF shows [s]."""
_GIF_SKIP = 2
"""A GIF has every second frame."""
_GIF_COLOURS = 80
"""Number of colours of a GIF."""
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
    joint_qpos = [model.joint(name).qposadr[0] for name in load_robot(film.robot).joint_names]
    camera = mujoco.MjvCamera()
    camera.distance = DISTANCE
    camera.elevation = math.degrees(ELEVATION)
    camera.azimuth = math.degrees(film.azimuth)
    option = mujoco.MjvOption()
    option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    pose_look = film.pose_qpos[:, :3].copy()
    pose_look[:, 2] = film.look[:, 2].mean()
    poses = np.vstack([film.qpos, film.pose_qpos])
    looks = np.vstack([film.look, pose_look])
    with closing(mujoco.Renderer(model, HEIGHT * _OVERSAMPLE, WIDTH * _OVERSAMPLE)) as renderer:
        for pose, look in zip(poses, looks, strict=True):
            data.qpos[:7] = pose[:7]
            data.qpos[joint_qpos] = pose[7:]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            camera.lookat[:] = look
            renderer.update_scene(data, camera, option)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 1
            yield Image.fromarray(renderer.render()).reduce(_OVERSAMPLE)


# ---- text and lines on frames ----


def tape_points(film: Film, side: float) -> dict[int, Array]:
    """Return points on the tapes under the film.

    Args:
        film: The film.
        side: Place across a tape: -1 and 1 are its right and left end [1].

    Returns:
        Points [m] (3,) by distance from lift-off in units of 0.2 m.
    """
    along = np.array([math.cos(film.direction), math.sin(film.direction), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    travelled = (film.qpos[:, :2] - film.origin) @ along[:2]
    begin = math.floor(travelled.min() / TAPE_M) - 2
    end = math.ceil(travelled.max() / TAPE_M) + 5
    origin = np.array([*film.origin, 0.0])
    points = {}
    for mark in range(begin, end):
        points[mark] = origin + mark * TAPE_M * along + side * TAPE_HALF_M * across
    return points


def project(points: Array, look: Array, azimuth: float, size: tuple[int, int]) -> Array:
    """Project points of the world into an image.

    Args:
        points: Points [m]. (N, 3)
        look: Point that the camera looks at [m]. (3,)
        azimuth: Azimuth of its view [rad].
        size: Width and height of the image [px].

    Returns:
        Right and down of the upper left corner [px], NaN behind the camera. (N, 2)
    """
    cosine = math.cos(ELEVATION)
    sine = math.sin(ELEVATION)
    ahead = np.array([math.cos(azimuth) * cosine, math.sin(azimuth) * cosine, sine])
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    relative = np.asarray(points) - (look - DISTANCE * ahead)
    depth = relative @ ahead
    focal = 0.5 * size[1] / math.tan(math.radians(0.5 * FOV_DEG))
    scale = focal / np.where(depth > 0, depth, np.nan)
    x = scale * (relative @ right)
    y = scale * (relative @ np.cross(right, ahead))
    return np.stack([0.5 * size[0] + x, 0.5 * size[1] - y], axis=1)


def draw_frame(image: Image.Image, film: Film, frame: int) -> None:
    """Write title, tape distances, time, jump input and height of one frame, in place."""
    scale = image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    _draw_distances(draw, film, frame, image.size)
    _draw_title(draw, film, image.size)
    is_jumping = bool(film.jumping[frame])
    if film.events is None:
        words = [f"{film.time[frame] - film.time[0]:+.2f} s"]
    else:
        words = [f"lift-off {film.time[frame] - film.events.liftoff:+.2f} s"]
    words.append(f"trunk {film.qpos[frame, 2]:.2f} m")
    if film.rate[frame] < 1.0:
        words.append(f"1/{1.0 / film.rate[frame]:g} speed")
    if is_jumping:
        words.append("jump!")
    corner = (14.0 * scale, image.height - 14.0 * scale)
    fill = _ACCENT if is_jumping else _PANEL
    ink = _WHITE if is_jumping else _INK
    _draw_label(draw, "    ".join(words), corner, "ld", 13.0 * scale, fill=fill, ink=ink)
    _HeightPlot.of(film, image.size).draw_on(draw, film, frame)


def _draw_distances(
    draw: ImageDraw.ImageDraw, film: Film, frame: int, size: tuple[int, int]
) -> None:
    """Write the distance at the end of every tape that is nearer to the camera."""
    width, height = size
    scale = height / _REFERENCE
    near_side = -1.12 if math.sin(film.azimuth - film.direction) > 0.0 else 1.12
    points = tape_points(film, near_side)
    pixels = project(np.array(list(points.values())), film.look[frame], film.azimuth, size)
    for mark, (x, y) in zip(points, pixels.tolist(), strict=True):
        if 0.0 <= x <= width and 0.0 <= y <= height - 56.0 * scale:
            text = f"{TAPE_M * mark:.1f}" if mark else "0 m"
            draw.text((x, y), text, font=_font(11.0 * scale), fill=_WHITE, anchor="mt")


def draw_strip(image: Image.Image, film: Film) -> None:
    """Write title, and label, time and height of each of the side-by-side poses, in place."""
    scale = image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    _draw_title(draw, film, image.size)
    step = image.width / len(film.labels)
    for index, label in enumerate(film.labels):
        since = float(film.pose_time[index]) + 0.0  # no -0.00
        text = f"{label}\n{since:+.2f} s, {film.pose_qpos[index, 2]:.2f} m".strip()
        corner = ((index + 0.5) * step, image.height - 14.0 * scale)
        _draw_label(draw, text, corner, "md", 14.0 * scale)


@cache
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(8.0, round(size)))


def _draw_label(
    draw: ImageDraw.ImageDraw,
    text: str,
    corner: Point,
    anchor: str,
    size: float,
    *,
    fill: Colour = _PANEL,
    ink: Colour = _INK,
) -> None:
    """Write lines of text in a box.

    Args:
        draw: The image.
        text: The lines.
        corner: Place of the anchor.
        anchor: Pillow's name of the corner of the text that is there.
        size: Size of the letters [px].
        fill: Colour of the box.
        ink: Colour of the text.
    """
    margin = 0.35 * size
    font = _font(size)
    align = "center" if anchor[0] == "m" else "left"
    x_min, y_min, x_max, y_max = draw.multiline_textbbox(
        corner, text, font=font, anchor=anchor, align=align
    )
    box = (x_min - margin, y_min - margin, x_max + margin, y_max + margin)
    draw.rounded_rectangle(box, margin, fill=fill)
    draw.multiline_text(corner, text, fill=ink, font=font, anchor=anchor, align=align)


def _draw_title(draw: ImageDraw.ImageDraw, film: Film, size: tuple[int, int]) -> None:
    """Write the title, and that the robot is virtual, into the upper corners."""
    width, height = size
    scale = height / _REFERENCE
    pad = 14.0 * scale
    _draw_label(draw, f"{film.title}\n{film.note}".strip(), (pad, pad), "la", 15.0 * scale)
    corner = (width - pad, pad)
    _draw_label(draw, "virtual robot", corner, "ra", 13.0 * scale, fill=_DARK, ink=_WHITE)


class _HeightPlot(NamedTuple):
    """A small plot of the trunk's height over time, in the lower right corner of an image."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    """Edges of its box [px]."""
    margin: float
    """Width of the box around the plot [px]."""
    begin: float
    """First time [s]."""
    seconds: float
    """Time that it shows [s]."""
    highest: float
    """Height at its upper edge [m]."""
    scale: float
    """Size of the image over the reference [1]."""

    @classmethod
    def of(cls, film: Film, size: tuple[int, int]) -> _HeightPlot:
        """Return the plot of a film, in an image of a width and height [px]."""
        width, height = size
        scale = height / _REFERENCE
        right = width - 10.0 * scale
        bottom = height - 10.0 * scale
        return cls(
            x_min=right - 150.0 * scale,
            y_min=bottom - 54.0 * scale,
            x_max=right,
            y_max=bottom,
            margin=6.0 * scale,
            begin=float(film.time[0]),
            seconds=max(float(film.time[-1] - film.time[0]), 1e-9),
            highest=max(0.5, 1.08 * float(film.qpos[:, 2].max())),
            scale=scale,
        )

    def point(self, time: float, height: float) -> Point:
        """Return the place of a time [s] and a height [m] in the image."""
        width = self.x_max - self.x_min - 2.0 * self.margin
        depth = self.y_max - self.y_min - 2.0 * self.margin
        x = self.x_min + self.margin + width * (time - self.begin) / self.seconds
        y = self.y_max - self.margin - depth * height / self.highest
        return x, y

    def draw_on(self, draw: ImageDraw.ImageDraw, film: Film, frame: int) -> None:
        """Draw it, with the present frame marked."""
        box = (self.x_min, self.y_min, self.x_max, self.y_max)
        draw.rounded_rectangle(box, self.margin, fill=_PANEL)
        if film.events is not None:
            x_min, y_min = self.point(film.events.liftoff, self.highest)
            x_max, y_max = self.point(film.events.touchdown, 0.0)
            draw.rectangle((x_min, y_min, x_max, y_max), fill=_FLIGHT)
        points = []
        for time, height in zip(film.time.tolist(), film.qpos[:, 2].tolist(), strict=True):
            points.append(self.point(time, height))
        draw.line(points, fill=_GREY, width=max(1, round(1.2 * self.scale)))
        draw.line(points[: frame + 1], fill=_INK, width=max(1, round(2.0 * self.scale)))
        draw.circle(points[frame], 3.2 * self.scale, fill=_ACCENT)


# ---- files ----


def gif_frames(film: Film) -> range:
    """Return the frames of the GIF: those of the jump and a little around it."""
    if film.events is None:
        return range(0, len(film.time), _GIF_SKIP)
    first = np.searchsorted(film.time, film.events.liftoff - _GIF_BEFORE_S)
    end = np.searchsorted(film.time, film.events.touchdown + _GIF_AFTER_S, "right")
    return range(int(first), int(end), _GIF_SKIP)


def write_gif(path: Path, frames: list[Image.Image]) -> None:
    """Write an animation that loops, with one palette and no dither, so that it is small."""
    samples = frames[:: max(1, len(frames) // 5)]
    montage = Image.fromarray(np.vstack([np.asarray(image) for image in samples]))
    palette = montage.quantize(_GIF_COLOURS, Image.Quantize.MAXCOVERAGE)
    quantized = []
    for image in frames:
        quantized.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    quantized[0].save(
        path,
        "GIF",
        save_all=True,
        append_images=quantized[1:],
        duration=round(1000.0 * _GIF_SKIP / FPS),
        loop=0,
    )


def open_mp4(path: Path) -> Any:
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


def render_film(film: Film, files: Mapping[str, Path]) -> None:
    """Render a film into files by suffix (.mp4, .gif, .png), each whole or not at all."""
    gif_indices = gif_frames(film) if ".gif" in files else range(0)
    gif_images: list[Image.Image] = []
    strip_parts: list[Any] = []
    with ExitStack() as stack:
        partial_files = {}
        for suffix, path in files.items():
            partial_files[suffix] = stack.enter_context(written_whole(path))
        mp4 = None
        if ".mp4" in files:
            mp4 = stack.enter_context(closing(open_mp4(partial_files[".mp4"])))
            mp4.send(None)
        for index, image in enumerate(images(film)):
            if index >= len(film.time):
                margin = (WIDTH - STRIP_WIDTH) // 2
                strip_parts.append(np.asarray(image)[:, margin : margin + STRIP_WIDTH])
                continue
            if index in gif_indices:
                size = (GIF_WIDTH, GIF_WIDTH * HEIGHT // WIDTH)
                small = image.resize(size, Image.Resampling.BOX)
                draw_frame(small, film, index)
                gif_images.append(small)
            if mp4 is not None:
                draw_frame(image, film, index)
                mp4.send(image.tobytes())
        if ".gif" in files:
            write_gif(partial_files[".gif"], gif_images)
        if ".png" in files:
            strip = Image.fromarray(np.hstack(strip_parts))
            draw_strip(strip, film)
            strip.save(partial_files[".png"], "PNG", optimize=True)


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


def render_command_line() -> None:
    """Render the film that the command line names, or check the backend without one."""
    paths = [Path(argument) for argument in sys.argv[1:]]
    if not paths:
        check_gl()
        return
    film = load_artefact(paths[0], Film, SCHEMA, what="a film", writer="pronk trial")
    render_film(film, {path.suffix: path for path in paths[1:]})


if __name__ == "__main__":
    try:
        render_command_line()
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {' '.join(str(error).split())}")
