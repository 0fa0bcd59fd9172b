"""Words and lines on frames: command, time, height, and that the robot is a virtual one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pronk.evaluation.pictures.film import Film

if TYPE_CHECKING:
    from pronk.evaluation.pictures.stage import Tape, View

_INK = (24, 28, 34)
_PAPER = (255, 255, 255)
_PANEL = (250, 250, 250, 200)
_FAINT = (90, 97, 106)
_ACCENT = (214, 95, 10)
_ZERO = (255, 176, 82)
_REFERENCE = 400.0
"""Height of the image for which sizes are given [px]."""
_STRIP_WORDS = 1.4
"""How much larger words are on a strip, which is wide and is shown smaller."""
_BAR = 42.0
"""Height of what lies along the lower edge of a frame [px]."""


@cache
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(8.0, round(size)))


def draw_words(image: Image.Image, film: Film, frame: int) -> None:
    """Write title, time, height and speed of the film on a frame, in place."""
    scale = image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    pad = 10.0 * scale
    _panel(draw, film, (pad, pad), scale)
    if film.virtual:
        _badge(draw, "virtual robot", (image.width - pad, pad), scale)
    bottom = image.height - pad
    since = film.time[frame] - (film.marks.liftoff if film.marks else film.time[0])
    words = f"{'lift-off ' if film.marks else ''}{since:+.2f} s    trunk {film.height[frame]:.2f} m"
    if not film.marks:
        words = words.replace("+", "")
    x = _tag(draw, words, (pad, bottom), scale)
    if film.rate[frame] < 1.0:
        x = _tag(draw, f"1/{1.0 / film.rate[frame]:g} speed", (x + pad / 2, bottom), scale)
    if film.jumping[frame]:
        _tag(draw, "jump!", (x + pad / 2, bottom), scale, ground=(*_ACCENT, 235), ink=_PAPER)
    _trace(draw, film, frame, (image.width - pad, bottom), scale)


def draw_tape(image: Image.Image, tape: Tape, view: View) -> None:
    """Write the distances [m] beside every tape, at the end that is nearer to the camera."""
    scale = image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    ahead = (math.cos(view.azimuth), math.sin(view.azimuth), 0.0)
    side = -1.12 if float(tape.across @ ahead) > 0.0 else 1.12
    places = np.array([tape.place(mark, side) for mark in tape.marks])
    font = _font(11.0 * scale)
    for mark, (x, y) in zip(
        tape.marks, view.pixels(places, image.width, image.height).tolist(), strict=True
    ):
        if 0.0 <= x <= image.width and 0.0 <= y <= image.height - (_BAR + 14.0) * scale:
            text = f"{0.2 * mark:.1f}" if mark else "0 m"
            ink = _ZERO if mark == 0 else _PAPER
            draw.text((x, y), text, font=font, fill=ink, anchor="mt")


def draw_strip(
    image: Image.Image,
    film: Film,
    spots: list[tuple[float, float]],
    at: Callable[[float, float], tuple[float, float]],
) -> None:
    """Write title, heights and labels on a strip, in place.

    Args:
        image: The strip.
        film: Whose.
        spots: Pixels of the trunks' origins.
        at: Pixel of a place along the strip and a height [m].
    """
    scale = _STRIP_WORDS * image.height / _REFERENCE
    draw = ImageDraw.Draw(image, "RGBA")
    pad = 10.0 * scale
    _panel(draw, film, (pad, pad), scale)
    if film.virtual:
        _badge(draw, "virtual robot", (image.width - pad, pad), scale)
    font, small = _font(14.0 * scale), _font(11.0 * scale)
    _, bottom = at(0.0, 0.0)
    for mark in range(1, 5):
        _, y = at(0.0, 0.2 * mark)
        text = f"{0.2 * mark:.1f} m"
        draw.text((image.width - pad, y - 1), text, font=small, fill=_FAINT, anchor="rd")
    draw.line(spots, fill=(*_ACCENT, 190), width=max(1, round(1.6 * scale)))
    dot = 3.6 * scale
    labelled = zip(film.labels, film.pose_time, film.pose_qpos[:, 2], spots, strict=True)
    for label, since, height, (x, y) in labelled:
        draw.ellipse((x - dot, y - dot, x + dot, y + dot), fill=_ACCENT, outline=_PAPER)
        below = bottom + 27.0 * scale
        draw.text((x, below), label, font=font, fill=_PAPER, anchor="ms")
        when = f"{since:+.2f} s" if abs(since) >= 0.005 else "0.00 s"
        words = f"{when}, {height:.2f} m"
        draw.text((x, below + 16.0 * scale), words, font=small, fill=_PAPER, anchor="ms")


def _panel(
    draw: ImageDraw.ImageDraw, film: Film, corner: tuple[float, float], scale: float
) -> None:
    x, y = corner
    title, note = _font(18.0 * scale), _font(12.0 * scale)
    width = draw.textlength(film.title, font=title)
    if film.note:
        width = max(width, draw.textlength(film.note, font=note))
    height = (44.0 if film.note else 28.0) * scale
    inner = 8.0 * scale
    draw.rounded_rectangle((x, y, x + width + 2 * inner, y + height), 5.0 * scale, fill=_PANEL)
    draw.text((x + inner, y + 14.0 * scale), film.title, font=title, fill=_INK, anchor="lm")
    if film.note:
        draw.text((x + inner, y + 33.0 * scale), film.note, font=note, fill=_FAINT, anchor="lm")


def _badge(draw: ImageDraw.ImageDraw, text: str, corner: tuple[float, float], scale: float) -> None:
    """A tag whose upper right corner is given."""
    right, top = corner
    font = _font(12.0 * scale)
    width = draw.textlength(text, font=font) + 14.0 * scale
    box = (right - width, top, right, top + 22.0 * scale)
    draw.rounded_rectangle(box, 11.0 * scale, fill=(*_INK, 215))
    draw.text((right - width / 2, top + 11.0 * scale), text, font=font, fill=_PAPER, anchor="mm")


def _tag(
    draw: ImageDraw.ImageDraw,
    text: str,
    corner: tuple[float, float],
    scale: float,
    *,
    ground: tuple[int, int, int, int] = _PANEL,
    ink: tuple[int, int, int] = _INK,
) -> float:
    """A tag whose lower left corner is given; returns its right edge."""
    left, bottom = corner
    font = _font(13.0 * scale)
    width = draw.textlength(text, font=font) + 14.0 * scale
    box = (left, bottom - 24.0 * scale, left + width, bottom)
    draw.rounded_rectangle(box, 5.0 * scale, fill=ground)
    middle = (left + 7.0 * scale, bottom - 12.0 * scale)
    draw.text(middle, text, font=font, fill=ink, anchor="lm")
    return left + width


def _trace(
    draw: ImageDraw.ImageDraw, film: Film, frame: int, corner: tuple[float, float], scale: float
) -> None:
    """The trunk's height over time, flight shaded, with a dot at this frame."""
    if film.frames < 2:
        return
    right, bottom = corner
    left, top = right - 150.0 * scale, bottom - 54.0 * scale
    inner = 6.0 * scale
    draw.rounded_rectangle((left, top, right, bottom), 5.0 * scale, fill=_PANEL)
    low, high = 0.0, max(0.5, float(film.height.max()) * 1.08)
    first, last = float(film.time[0]), float(film.time[-1])

    def at(time: float, height: float) -> tuple[float, float]:
        x = left + inner + (right - left - 2 * inner) * (time - first) / (last - first)
        y = bottom - inner - (bottom - top - 2 * inner) * (height - low) / (high - low)
        return x, y

    if film.marks:
        a, b = at(film.marks.liftoff, high), at(film.marks.touchdown, low)
        draw.rectangle((*a, *b), fill=(*_ACCENT, 45))
    points = [at(t, z) for t, z in zip(film.time.tolist(), film.height.tolist(), strict=True)]
    draw.line(points, fill=_FAINT, width=max(1, round(1.2 * scale)))
    if frame:
        draw.line(points[: frame + 1], fill=_INK, width=max(1, round(2.0 * scale)))
    x, y = points[frame]
    dot = 3.2 * scale
    draw.ellipse((x - dot, y - dot, x + dot, y + dot), fill=_ACCENT)
