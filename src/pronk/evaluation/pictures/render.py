"""The process that paints.

    python -m pronk.evaluation.pictures.render FILM [--mp4 F] [--gif F] [--strip F]

Started by `video`, which chooses the GL backend for it (MUJOCO_GL). It writes one line to standard
output for each frame, `k/n`; one line to standard error says what went wrong.
Without a film it paints one small picture, to see whether this machine can.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import mujoco
from PIL import Image

from pronk.errors import PronkError
from pronk.evaluation.pictures import film as films
from pronk.evaluation.pictures import frames
from pronk.evaluation.pictures.film import FPS, Film
from pronk.files import written_whole

GIF_WIDTH = 360
"""[px]"""
_GIF_BEFORE_S = 0.6
_GIF_AFTER_S = 0.8
_GIF_SKIP = 2
"""A GIF takes one frame of so many."""
_GIF_COLOURS = 80
_PALETTE_FRAMES = 5


class Encoder:
    """Writes frames into an MP4 (H.264, 4:2:0, which every browser plays)."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        """Start ffmpeg.

        Args:
            path: The file.
            size: Width and height [px].
        """
        import imageio_ffmpeg

        parameters = ["-crf", "23", "-preset", "veryfast", "-movflags", "+faststart"]
        self._writer = imageio_ffmpeg.write_frames(
            str(path),
            size,
            fps=FPS,
            codec="libx264",
            quality=None,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=[*parameters, "-threads", "1"],
        )
        self._writer.send(None)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def write(self, image: Image.Image) -> None:
        """Add a frame."""
        self._writer.send(image.tobytes())

    def __exit__(self, *_: object) -> None:
        """Finish the file."""
        self._writer.close()


def in_gif(film: Film) -> range:
    """Which frames a GIF shows: the jump and a little around it, every second one."""
    first, last = 0, film.frames
    if film.marks:
        around = (film.time >= film.marks.liftoff - _GIF_BEFORE_S) & (
            film.time <= film.marks.touchdown + _GIF_AFTER_S
        )
        first, last = int(around.argmax()), film.frames - int(around[::-1].argmax())
    return range(first, last, _GIF_SKIP)


def write_gif(path: Path, images: list[Image.Image]) -> None:
    """Write an animation that loops.

    Args:
        path: The file.
        images: RGB, all of one size.
    """
    # One palette for all, without dither: what stands still is then not stored again.
    width, height = images[0].size
    chosen = images[:: max(1, len(images) // _PALETTE_FRAMES)]
    montage = Image.new("RGB", (width, height * len(chosen)))
    for row, image in enumerate(chosen):
        montage.paste(image, (0, row * height))
    palette = montage.quantize(_GIF_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *rest = [i.quantize(palette=palette, dither=Image.Dither.NONE) for i in images]
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=round(1000.0 * _GIF_SKIP / FPS),
        loop=0,
    )


def render(
    film: Film, *, mp4: Path | None, gif: Path | None, strip: Path | None, width: int, height: int
) -> None:
    """Paint a film into whichever files are named, each whole or not at all."""
    if strip is not None:
        with written_whole(strip) as aside:
            frames.strip(film).save(aside, format="PNG", optimize=True)
    if mp4 is None and gif is None:
        return
    kept = set(in_gif(film)) if gif is not None else set()
    images = []
    with ExitStack() as stack:
        encoder: Encoder | None = None
        if mp4 is not None:
            aside = stack.enter_context(written_whole(mp4))
            encoder = stack.enter_context(Encoder(aside, (width, height)))
        for frame in frames.frames(film, width=width, height=height):
            if encoder is not None:
                encoder.write(frame.worded(film, width))
            if frame.index in kept:
                images.append(frame.worded(film, GIF_WIDTH))
            sys.stdout.write(f"{frame.index + 1}/{film.frames}\n")
            sys.stdout.flush()
    if gif is not None:
        with written_whole(gif) as aside:
            write_gif(aside, images)


def probe() -> None:
    """Paint one small picture."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><light/><geom size='1'/></worldbody></mujoco>"
    )
    renderer: Any = mujoco.Renderer(model, 32, 32)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer.update_scene(data)
    painted = renderer.render()
    renderer.close()
    if not painted.any():
        raise PronkError("the picture is black.")


def main(arguments: list[str]) -> int:
    """Run one command line of the module and return its exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("film", type=Path, nargs="?")
    for name in ("--mp4", "--gif", "--strip"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--width", type=int, default=frames.WIDTH)
    parser.add_argument("--height", type=int, default=frames.HEIGHT)
    options = vars(parser.parse_args(arguments))
    path = options.pop("film")
    try:
        if path is None:
            probe()
        else:
            render(films.load(path), **options)
    except Exception as error:
        sys.stderr.write(f"{type(error).__name__}: {' '.join(str(error).split())}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
