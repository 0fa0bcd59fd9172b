"""Video of a capture: an MP4, a small GIF, and a strip of still frames.

Painting happens in a process of its own (`render`): the GL backend must be chosen before mujoco is
imported, and a GL that crashes must not take a trial along. A machine without GPU or display paints
with Mesa's software renderer, about 0.1 s a frame.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

from pronk import opengl
from pronk.errors import PronkError
from pronk.evaluation.pictures import film as films
from pronk.evaluation.pictures.film import Film

WIDTH, HEIGHT = 640, 400
"""Of an MP4 [px]; both even."""
ENDINGS = (".mp4", ".gif", ".png")
"""What `record` writes."""

_PROBE_S = 60.0
_MODULE = "pronk.evaluation.pictures.render"


class VideoError(PronkError):
    """This machine cannot make a video; the message names what it lacks."""


def no_gl() -> str | None:
    """Why nothing can be painted here, as one sentence; None if it can."""
    try:
        find_gl()
    except VideoError as error:
        return str(error)
    return None


def no_encoder() -> str | None:
    """Why no MP4 can be written here, as one sentence; None if one can."""
    try:
        importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except ImportError:
        return "an MP4 needs imageio-ffmpeg; install it with `pip install 'pronk[video]'`."
    except RuntimeError:
        return (
            "imageio-ffmpeg was installed without its ffmpeg; install one with "
            "`apt-get install ffmpeg`."
        )
    return None


@cache
def find_gl() -> str:
    """The GL backend (a value of MUJOCO_GL) that paints offscreen here; found by trying.

    One that is set in the environment is tried first.

    Raises:
        VideoError: None does.
    """
    candidates = ["egl", "osmesa"] if sys.platform.startswith("linux") else [""]
    if chosen := opengl.asked():
        candidates = [chosen] + [name for name in candidates if name != chosen]
    for name in candidates:
        try:
            done = subprocess.run(
                [sys.executable, "-m", _MODULE],
                env=environment(name),
                capture_output=True,
                timeout=_PROBE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            continue
        if done.returncode == 0:
            return name
    raise VideoError(
        f"no video: of {' and '.join(candidates) or 'the system'} no OpenGL paints offscreen here; "
        "`apt-get install libosmesa6` gives one that needs neither GPU nor display."
    )


def environment(backend: str) -> dict[str, str]:
    """The environment of a process that paints.

    Args:
        backend: A value of MUJOCO_GL; empty for MuJoCo's own choice.
    """
    changed = dict(os.environ)
    # PyOpenGL must agree with MuJoCo, which sets this itself.
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        changed.pop(name, None)
    if backend:
        changed["MUJOCO_GL"] = backend
    # Mesa's threads cost more than they give at this size.
    changed.setdefault("LP_NUM_THREADS", "1")
    return changed


def shoot(
    film: Film,
    *,
    mp4: Path | None = None,
    gif: Path | None = None,
    strip: Path | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Paint a film into whichever files are named, each written whole or not at all.

    Args:
        film: From `pronk.evaluation.pictures.film.plan`.
        mp4: The video.
        gif: A smaller animation of the jump.
        strip: The poses of the jump side by side, PNG.
        width: Of the video [px], even.
        height: Of the video [px], even.
        progress: Told the share that is done, 0 to 1.

    Raises:
        VideoError: This machine cannot, or painting failed.
        PronkError: A strip of a film without a jump, or an odd size.
    """
    if strip is not None and not film.labels:
        raise PronkError(f"{strip}: a strip shows a jump, and {film.title!r} has none.")
    if width <= 0 or height <= 0 or width % 2 or height % 2:
        raise PronkError(f"a video of {width} x {height} pixels; expected even numbers above 0.")
    if mp4 is not None and (lack := no_encoder()):
        raise VideoError(lack)
    backend = find_gl()
    files = {"--mp4": mp4, "--gif": gif, "--strip": strip}
    words = [word for name, path in files.items() if path for word in (name, str(path))]
    with tempfile.TemporaryDirectory() as folder:
        plan = Path(folder) / "film.npz"
        films.save(plan, film)
        words += ["--width", str(width), "--height", str(height), str(plan)]
        _paint(words, backend, progress)


def _paint(words: list[str], backend: str, progress: Callable[[float], None] | None) -> None:
    """Run the process that paints."""
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        process = subprocess.Popen(
            [sys.executable, "-m", _MODULE, *words],
            env=environment(backend),
            stdout=subprocess.PIPE,
            stderr=complaints,
            text=True,
        )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                done, _, whole = line.strip().partition("/")
                if progress is not None and done.isdigit() and whole.isdigit():
                    progress(int(done) / int(whole))
            status = process.wait()
        finally:
            process.kill()
            process.wait()
        if status:
            complaints.seek(0)
            said = [line.strip() for line in complaints if line.strip()]
            last = said[-1].rstrip(".") if said else f"the process ended with {status}"
            raise VideoError(
                f"painting with MUJOCO_GL={backend or 'its default'} failed ({last}); another one "
                "may do: set MUJOCO_GL to egl or osmesa."
            )


def record(
    film: Film,
    folder: Path,
    stem: str,
    *,
    tell: Callable[[str], None],
    progress: Callable[[float], None] | None = None,
) -> tuple[Path, ...]:
    """Write `stem`.mp4, `stem`.gif and, of a jump, `stem`.png into a folder, as far as one can.

    Args:
        film: From `pronk.evaluation.pictures.film.plan`.
        folder: Where to.
        stem: Name of the files, without an ending.
        tell: Told in one sentence what cannot be written, and what is missing for it.
        progress: Told the share that is done, 0 to 1.

    Returns:
        The files that were written; none where nothing can be painted.
    """
    mp4, gif, strip = (folder / f"{stem}{ending}" for ending in ENDINGS)
    if lack := no_gl():
        tell(lack)
        return ()
    video: Path | None = mp4
    if lack := no_encoder():
        tell(lack)
        video = None
    picture = strip if film.labels else None
    try:
        shoot(film, mp4=video, gif=gif, strip=picture, progress=progress)
    except VideoError as error:
        tell(str(error))
        return ()
    return tuple(path for path in (video, gif, picture) if path is not None)
