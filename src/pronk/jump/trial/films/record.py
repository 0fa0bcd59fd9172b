"""Films of a trial: an MP4, a small GIF and a strip of stills of each command.

A process of its own (`render`) draws them: the GL backend must be chosen before mujoco is
imported, and a crash of OpenGL does not end the trial.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Container
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from pronk import opengl
from pronk.errors import PronkError
from pronk.files import save_artefact
from pronk.jump.trial.films.film import SCHEMA, Film, JumpEvents, plan
from pronk.jump.trial.results import TrialResults
from pronk.jump.virtual import capture as captures
from pronk.robots.robot import RobotSpec

SLOW = 4.0
"""How many times slower than real time a flight is."""
_BEFORE_S, _AFTER_S = 0.8, 2.5
"""Around the jump input, of a robot that did not jump."""
_BEFORE_JUMP_S, _AFTER_JUMP_S = 1.0, 1.2
"""Before lift-off and after touchdown."""
_PROBE_S = 60.0


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
    """The GL backend (a value of MUJOCO_GL) that renders offscreen here; found by trying.

    One that is set in the environment is tried first. Raise `PronkError` if there is none.
    """
    candidates = ["egl", "osmesa"] if sys.platform.startswith("linux") else [""]
    if chosen := opengl.requested():
        candidates = [chosen] + [name for name in candidates if name != chosen]
    for name in candidates:
        with suppress(subprocess.TimeoutExpired):
            if not _run(name, timeout=_PROBE_S).returncode:
                return name
    raise PronkError(
        f"no video: of {' and '.join(candidates) or 'the system'} no OpenGL renders offscreen "
        "here; `apt-get install libosmesa6` gives one that needs neither GPU nor display."
    )


def _run(backend: str, *files: Path, timeout: float | None = None) -> Any:
    """Run `render` with a GL backend, a value of MUJOCO_GL."""
    return subprocess.run(
        [sys.executable, "-m", "pronk.jump.trial.films.render", *files],
        env=environment(backend),
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout,
        check=False,
    )


def environment(backend: str) -> dict[str, str]:
    """The environment of a process that renders with a value of MUJOCO_GL, or MuJoCo's default."""
    # PyOpenGL must agree with MuJoCo, which sets PYOPENGL_PLATFORM itself.
    dropped = ("MUJOCO_GL", "PYOPENGL_PLATFORM")
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    # Mesa's threads cost more than they give at this size.
    return {"LP_NUM_THREADS": "1"} | kept | ({"MUJOCO_GL": backend} if backend else {})


def record_film(film: Film, stem: Path, *, warn: Callable[[str], None]) -> tuple[Path, ...]:
    """Write `stem`.mp4, `stem`.gif and, of a jump, `stem`.png, each whole, and return them.

    `warn` is called with one sentence about what this machine lacks, but for OpenGL: see `find_gl`.
    """
    backend = find_gl()
    endings = [".gif", ".png"] if film.labels else [".gif"]
    if lack := no_encoder():
        warn(lack)
    else:
        endings.insert(0, ".mp4")
    files = tuple(stem.with_name(f"{stem.name}{ending}") for ending in endings)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "film.npz"
        save_artefact(source, film, SCHEMA)
        done = _run(backend, source, *files)
    if done.returncode:
        lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        last = lines[-1].rstrip(".") if lines else f"the process ended with {done.returncode}"
        warn(
            f"rendering with MUJOCO_GL={backend or 'its default'} failed ({last}); another one "
            "may do: set MUJOCO_GL to egl or osmesa."
        )
        return ()
    return files


def films_of(
    found: TrialResults,
    folder: Path,
    *,
    robot: RobotSpec,
    cases: Container[str],
    slow: float = SLOW,
) -> dict[str, Film]:
    """Plan a film of the first run of each subject with each command of `cases`, by file name.

    `folder` has the captures; of `robot` the results have only the name.
    """
    films = {}
    policies = {subject.name for subject in found.subjects}
    for row in found.rows:
        if row.number or not row.capture or row.policy not in policies or row.case not in cases:
            continue
        on = row.began + row.script.on
        events, span = None, (on - _BEFORE_S, on + _AFTER_S)
        if row.figures.found:
            up = on + row.figures.flight.delay
            down = up + row.figures.flight.duration
            events = JumpEvents(on=on, off=row.began + row.script.off, liftoff=up, touchdown=down)
            span = (up - _BEFORE_JUMP_S, down + _AFTER_JUMP_S)
        # The name is without what a shell or a link would trip over.
        films[re.sub(r"[^A-Za-z0-9.+-]+", "_", f"{row.policy}_{row.case}")] = plan(
            captures.load(folder / row.capture),
            robot=robot.source,
            title=row.case if "," in row.case else f"{row.case} m/s",
            note=f"policy: {row.policy}" + ("" if events else ", no jump"),
            events=events,
            span=span,
            slow=slow,
        )
    return films


def record_trial(
    found: TrialResults,
    folder: Path,
    out: Path,
    *,
    robot: RobotSpec,
    cases: Container[str],
    warn: Callable[[str], None],
    slow: float = SLOW,
    at_once: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Path, ...]:
    """Write the files of each of `films_of` into `out`, as far as this machine can.

    `warn` is called once with each sentence about what is missing.
    """
    try:
        find_gl()
    except PronkError as error:
        warn(str(error))
        return ()
    planned = films_of(found, folder, robot=robot, cases=cases, slow=slow)
    warnings: dict[str, None] = {}
    files: list[Path] = []
    with ThreadPoolExecutor(max(1, at_once)) as threads:
        work = partial(record_film, warn=warnings.setdefault)
        stems = [out / name for name in planned]
        for count, written in enumerate(threads.map(work, planned.values(), stems), start=1):
            files += written
            progress(count / len(planned))
    for text in warnings:
        warn(text)
    return tuple(files)
