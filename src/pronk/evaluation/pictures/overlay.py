"""Text and lines on frames: command, time, height, distances, and that the robot is virtual."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from pronk.evaluation.pictures.film import Film

Array = NDArray[np.float64]
Point = tuple[float, float]

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
_DARK, _GREY = (24, 28, 34, 215), (90, 97, 106, 255)
_ACCENT, _ZERO = (214, 95, 10, 235), (255, 176, 82, 255)
_REFERENCE = 400.0
"""Height of the image for which sizes are given [px]."""


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
    """Project points of the world into an image.

    Args:
        points: [m]. (N, 3)
        look: Where the camera looks [m]. (3,)
        azimuth: Of the camera's view [rad].
        size: Width and height [px].

    Returns:
        Right and down of the upper left corner [px]; NaN behind the camera. (N, 2)
    """
    c, s = math.cos(ELEVATION), math.sin(ELEVATION)
    ahead = np.array([math.cos(azimuth) * c, math.sin(azimuth) * c, s])
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    relative = np.asarray(points) - (look - DISTANCE * ahead)
    depth = relative @ ahead
    scale = (
        0.5 * size[1] / math.tan(math.radians(0.5 * FOV_DEG)) / np.where(depth > 0, depth, np.nan)
    )
    down = relative @ np.cross(right, ahead)
    return np.stack(
        [0.5 * size[0] + scale * (relative @ right), 0.5 * size[1] - scale * down], axis=1
    )


def draw_frame(image: Image.Image, film: Film, frame: int) -> None:
    """Write title, time, height, speed and distances on a frame, in place."""
    scale = image.height / _REFERENCE
    pad = 10.0 * scale
    draw = ImageDraw.Draw(image, "RGBA")
    _distances(draw, film, frame, image.size)
    _title(draw, film, image.width)
    bottom, height = image.height - pad, film.qpos[frame, 2]
    if film.events:
        words = f"lift-off {film.time[frame] - film.events.liftoff:+.2f} s    trunk {height:.2f} m"
    else:
        words = f"{film.time[frame] - film.time[0]:.2f} s    trunk {height:.2f} m"
    x = _label(draw, words, (pad, bottom), "ld", 13.0 * scale)
    if film.rate[frame] < 1.0:
        words = f"1/{1.0 / film.rate[frame]:g} speed"
        x = _label(draw, words, (x + 0.5 * pad, bottom), "ld", 13.0 * scale)
    if film.jumping[frame]:
        corner = (x + 0.5 * pad, bottom)
        _label(draw, "jump!", corner, "ld", 13.0 * scale, fill=_ACCENT, ink=_WHITE)
    _height_plot(draw, film, frame, (image.width - pad, bottom), scale)


def draw_strip(image: Image.Image, film: Film) -> None:
    """Write title, and label, time and height of each of the side-by-side poses, in place."""
    scale = image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    _title(draw, film, image.width)
    step = image.width / len(film.labels)
    for k, (label, since) in enumerate(zip(film.labels, film.pose_time.tolist(), strict=True)):
        words = f"{since + 0.0:+.2f} s, {film.pose_qpos[k, 2]:.2f} m"
        words = f"{label}\n{words}" if label else words
        bottom = image.height - 10.0 * scale
        _label(draw, words, ((k + 0.5) * step, bottom), "md", 14.0 * scale)


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
    fill: tuple[int, int, int, int] = _PANEL,
    ink: tuple[int, int, int, int] = _INK,
) -> float:
    """Write lines of text of a size [px] in a box and return the box's right edge [px].

    `anchor` names the point of the box that is at `corner`: l, m or r, and a (top) or d (bottom).
    """
    inner, lines = 0.45 * size, text.count("\n") + 1
    left, _, right, _ = draw.multiline_textbbox((0, 0), text, font=_font(size))
    width, height = right - left + 2 * inner, (1.35 * lines - 0.2) * size + inner
    x = corner[0] - width * {"l": 0.0, "m": 0.5, "r": 1.0}[anchor[0]]
    y = corner[1] - height * {"a": 0.0, "d": 1.0}[anchor[1]]
    draw.rounded_rectangle((x, y, x + width, y + height), 0.35 * size, fill=fill)
    place, align = (x + inner - left, y + 0.5 * inner), "center" if anchor[0] == "m" else "left"
    draw.multiline_text(place, text, font=_font(size), fill=ink, align=align)
    return x + width


def _title(draw: ImageDraw.ImageDraw, film: Film, width: int) -> None:
    scale = draw.im.size[1] / _REFERENCE
    pad = 10.0 * scale
    words = f"{film.title}\n{film.note}" if film.note else film.title
    _label(draw, words, (pad, pad), "la", 15.0 * scale)
    if film.virtual:
        corner = (width - pad, pad)
        _label(draw, "virtual robot", corner, "ra", 13.0 * scale, fill=_DARK, ink=_WHITE)


def _distances(draw: ImageDraw.ImageDraw, film: Film, frame: int, size: tuple[int, int]) -> None:
    """Write the distances [m] beside every tape, at the end nearer to the camera."""
    scale = size[1] / _REFERENCE
    nearer = -1.12 if math.sin(film.azimuth - film.direction) > 0.0 else 1.12
    places = tape_points(film, nearer)
    pixels = project(np.array([*places.values()]), film.look[frame], film.azimuth, size)
    for mark, (x, y) in zip(places, pixels.tolist(), strict=True):
        if 0.0 <= x <= size[0] and 0.0 <= y <= size[1] - 56.0 * scale:
            text = f"{TAPE_M * mark:.1f}" if mark else "0 m"
            ink = _WHITE if mark else _ZERO
            draw.text((x, y), text, font=_font(11.0 * scale), fill=ink, anchor="mt")


def _height_plot(
    draw: ImageDraw.ImageDraw, film: Film, frame: int, corner: Point, scale: float
) -> None:
    """Plot the trunk's height over time in a box with the given lower right corner."""
    (right, bottom), inner = corner, 6.0 * scale
    left, top = right - 150.0 * scale, bottom - 54.0 * scale
    draw.rounded_rectangle((left, top, right, bottom), inner, fill=_PANEL)
    height, time = film.qpos[:, 2], film.time
    high = max(0.5, 1.08 * float(height.max()))

    def at(moment: float, z: float) -> Point:
        share = (moment - time[0]) / max(time[-1] - time[0], 1e-9)
        x = left + inner + (right - left - 2 * inner) * share
        return x, bottom - inner - (bottom - top - 2 * inner) * z / high

    if film.events:
        box = (*at(film.events.liftoff, high), *at(film.events.touchdown, 0.0))
        draw.rectangle(box, fill=(*_ACCENT[:3], 45))
    points = [at(t, z) for t, z in zip(time.tolist(), height.tolist(), strict=True)]
    draw.line(points, fill=_GREY, width=max(1, round(1.2 * scale)))
    draw.line(points[: frame + 1], fill=_INK, width=max(1, round(2.0 * scale)))
    draw.circle(points[frame], 3.2 * scale, fill=_ACCENT)
