"""Text and lines on frames: command, time, height, distances, and that the robot is virtual."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from pronk.evaluation.pictures.film import Film

Array = NDArray[np.float64]
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
    if film.virtual:
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
