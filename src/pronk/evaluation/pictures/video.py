"""Videos of captures and trials: an MP4, a small GIF, and a strip of still frames.

Painting happens in a process of its own (`render`): the GL backend must be chosen before mujoco is
imported, and a crash of OpenGL does not end the trial.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Container, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

from pronk import opengl
from pronk.errors import PronkError
from pronk.evaluation.jump_events import jump_events
from pronk.evaluation.pictures import film as films
from pronk.evaluation.pictures.film import Film, plan
from pronk.evaluation.results import Results, Row
from pronk.virtual import capture as captures

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
    if chosen := opengl.requested():
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
        progress: Called with the share that is done, 0 to 1.

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
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", _MODULE, *words],
            env=environment(backend),
            stdout=subprocess.PIPE,
            stderr=errors,
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
            errors.seek(0)
            said = [line.strip() for line in errors if line.strip()]
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
        tell: Called with one sentence: what cannot be written, and what is missing for it.
        progress: Called with the share that is done, 0 to 1.

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


SLOW = 4.0
"""How many times slower than real time a flight is shown."""
_BEFORE_S = 0.8
_AFTER_S = 2.5
"""Around the jump input, for a robot that did not jump."""


def films_of(
    found: Results, folder: Path, *, cases: Container[str] | None = None, slow: float = SLOW
) -> Iterator[tuple[str, Film]]:
    """Plan a film of each policy with each command.

    A robot that did not jump is shown as it did not.

    Args:
        found: The trial.
        folder: Where its captures are.
        cases: Names of the commands that are shown; all if None.
        slow: How many times slower than real time the flight is shown.

    Yields:
        A name for the files, and the film.

    Raises:
        ArtefactError: A capture is missing or damaged.
    """
    for subject in found.subjects:
        for case in found.cases:
            if cases is not None and case.name not in cases:
                continue
            kept = next((row for row in found.of(subject.name, case.name) if row.capture), None)
            if kept is not None:
                yield _stem(kept), _film(found, kept, folder, slow)


def record_all(
    found: Results,
    folder: Path,
    out: Path,
    *,
    tell: Callable[[str], None],
    cases: Container[str] | None = None,
    slow: float = SLOW,
    at_once: int = 1,
    progress: Callable[[float], None] | None = None,
) -> tuple[Path, ...]:
    """Write MP4, GIF and strip of each of `films_of`, as far as this machine can.

    Args:
        found: The trial.
        folder: Where its captures are.
        out: Where the files go.
        tell: Called with one sentence: what cannot be written, and what is missing for it.
        cases: Names of the commands that are shown; all if None.
        slow: How many times slower than real time the flight is shown.
        at_once: How many films are painted at once; not more than there are cores.
        progress: Called with the share that is done, 0 to 1.

    Returns:
        The files that were written; none where nothing can be painted.
    """
    if lack := no_gl():
        tell(lack)
        return ()
    planned = list(films_of(found, folder, cases=cases, slow=slow))
    shares = [0.0] * len(planned)

    def paint(index: int) -> tuple[tuple[Path, ...], list[str]]:
        stem, film = planned[index]
        errors: list[str] = []

        def share(part: float) -> None:
            shares[index] = part
            if progress is not None:
                progress(sum(shares) / len(shares))

        return record(film, out, stem, tell=errors.append, progress=share), errors

    with ThreadPoolExecutor(max(1, at_once)) as threads:
        painted = list(threads.map(paint, range(len(planned))))
    # What one film lacks the others lack too: report it once.
    for text in dict.fromkeys(text for _, errors in painted for text in errors):
        tell(text)
    return tuple(path for paths, _ in painted for path in paths)


def _film(found: Results, row: Row, folder: Path, slow: float) -> Film:
    seen = captures.load(folder / row.capture)
    marks = jump_events(seen, row.script, began=row.began)
    on = row.began + row.script.on
    return plan(
        seen,
        robot=found.robot,
        title=row.case if "," in row.case else f"{row.case} m/s",
        note=f"policy: {row.policy}" + ("" if marks else ", no jump"),
        virtual=found.virtual,
        marks=marks,
        start=None if marks else on - _BEFORE_S,
        end=None if marks else on + _AFTER_S,
        slow=slow,
    )


def _stem(row: Row) -> str:
    """A name for files, without what a shell or a link would trip over."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", f"{row.policy}_{row.case}")
