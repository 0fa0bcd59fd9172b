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
from functools import cache
from pathlib import Path

from pronk.errors import PronkError
from pronk.files import save_artefact
from pronk.jump.trial.films.film import SCHEMA, Film, JumpEvents, plan_film
from pronk.jump.trial.results import TrialResults, TrialRun
from pronk.jump.virtual import capture as captures
from pronk.opengl import requested_opengl
from pronk.robots.robot import RobotSpec

SLOW = 4.0
"""How many times slower than real time a flight is [1]."""
_BEFORE_S = 0.8
"""Time before the jump input that is filmed of a robot that did not jump [s]."""
_AFTER_S = 2.5
"""Time after the jump input that is filmed of a robot that did not jump [s]."""
_BEFORE_JUMP_S = 1.0
"""Time before lift-off that is filmed [s]."""
_AFTER_JUMP_S = 1.2
"""Time after touchdown that is filmed [s]."""
_PROBE_S = 60.0
"""Time within which a GL backend must have rendered one image [s]."""


def missing_encoder() -> str | None:
    """Return one sentence on why no MP4 can be written here; None if one can."""
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
    """Return the GL backend (a value of MUJOCO_GL) that renders offscreen here, by trying.

    One that is set in the environment is tried first.

    Raises:
        PronkError: There is none.
    """
    candidates = ["egl", "osmesa"] if sys.platform.startswith("linux") else [""]
    requested = requested_opengl()
    if requested:
        candidates = [requested, *(name for name in candidates if name != requested)]
    for backend in candidates:
        try:
            if _run_render(backend, timeout_s=_PROBE_S).returncode == 0:
                return backend
        except subprocess.TimeoutExpired:
            continue
    raise PronkError(
        f"no video: of {' and '.join(candidates) or 'the system'} no OpenGL renders offscreen "
        "here; `apt-get install libosmesa6` gives one that needs neither GPU nor display."
    )


def _run_render(
    backend: str, *files: Path, timeout_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run `render` with a GL backend, a value of MUJOCO_GL, and the paths of its command line."""
    return subprocess.run(
        [sys.executable, "-m", "pronk.jump.trial.films.render", *files],
        env=environment(backend),
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout_s,
        check=False,
    )


def environment(backend: str) -> dict[str, str]:
    """Return the environment of a process that renders with a value of MUJOCO_GL.

    An empty one stands for MuJoCo's default.
    """
    variables = dict(os.environ)
    # PyOpenGL must agree with MuJoCo, which sets PYOPENGL_PLATFORM itself.
    variables.pop("MUJOCO_GL", None)
    variables.pop("PYOPENGL_PLATFORM", None)
    # Mesa's threads cost more than they give at this size.
    variables.setdefault("LP_NUM_THREADS", "1")
    if backend:
        variables["MUJOCO_GL"] = backend
    return variables


def record_film(film: Film, stem: Path, *, warn: Callable[[str], None]) -> tuple[Path, ...]:
    """Write `stem`.mp4, `stem`.gif and, of a jump, `stem`.png, each whole.

    Args:
        film: The planned film.
        stem: Path of the files without their endings.
        warn: Called with one sentence about what this machine lacks, but for OpenGL.

    Returns:
        The files that were written.

    Raises:
        PronkError: No OpenGL renders here; see `find_gl`.
    """
    backend = find_gl()
    endings = [".gif"]
    problem = missing_encoder()
    if problem is None:
        endings.insert(0, ".mp4")
    else:
        warn(problem)
    if film.labels:
        endings.append(".png")
    files = tuple(stem.with_name(f"{stem.name}{ending}") for ending in endings)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "film.npz"
        save_artefact(source, film, SCHEMA)
        process = _run_render(backend, source, *files)
    if process.returncode == 0:
        return files
    reason = f"the process ended with {process.returncode}"
    for line in process.stderr.splitlines():
        if line.strip():
            reason = line.strip().rstrip(".")
    warn(
        f"rendering with MUJOCO_GL={backend or 'its default'} failed ({reason}); another one "
        "may do: set MUJOCO_GL to egl or osmesa."
    )
    return ()


def plan_films(
    results: TrialResults,
    folder: Path,
    *,
    robot: RobotSpec,
    cases: Container[str],
    slow: float = SLOW,
) -> dict[str, Film]:
    """Plan a film of the first run of each policy with each command.

    Args:
        results: The trial.
        folder: Folder of the trial, with its captures.
        robot: The robot, of which the results have only the name.
        cases: Names of the commands that are filmed.
        slow: How many times slower than real time a flight is [1].

    Returns:
        The films by the names of their files, without endings.
    """
    policies = [subject.name for subject in results.subjects]
    films = {}
    for row in results.rows:
        is_first = row.number == 0 and row.capture != ""
        if is_first and row.policy in policies and row.case in cases:
            # The name is without what a shell or a link would trip over.
            name = re.sub(r"[^A-Za-z0-9.+-]+", "_", f"{row.policy}_{row.case}")
            films[name] = _plan_run(row, folder, robot, slow)
    return films


def _plan_run(row: TrialRun, folder: Path, robot: RobotSpec, slow: float) -> Film:
    """Plan the film of one run."""
    on = row.began + row.script.on
    flight = row.figures.flight
    note = f"policy: {row.policy}"
    if row.figures.found:
        liftoff = on + flight.delay
        touchdown = liftoff + flight.duration
        events = JumpEvents(
            on=on, off=row.began + row.script.off, liftoff=liftoff, touchdown=touchdown
        )
        span = (liftoff - _BEFORE_JUMP_S, touchdown + _AFTER_JUMP_S)
    else:
        events = None
        span = (on - _BEFORE_S, on + _AFTER_S)
        note += ", no jump"
    return plan_film(
        captures.load_capture(folder / row.capture),
        robot=robot.source,
        title=row.case if "," in row.case else f"{row.case} m/s",
        note=note,
        events=events,
        span=span,
        slow=slow,
    )


def record_trial(
    results: TrialResults,
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
    """Write the films of a trial, as far as this machine can.

    Args:
        results: The trial.
        folder: Folder of the trial, with its captures.
        out: Folder of the films.
        robot: The robot, of which the results have only the name.
        cases: Names of the commands that are filmed.
        warn: Called once with each sentence about what is missing.
        slow: How many times slower than real time a flight is [1].
        at_once: Number of films that are rendered at once.
        progress: Called with the share of the films that are done, 0 to 1.

    Returns:
        The files that were written.
    """
    try:
        find_gl()
    except PronkError as error:
        warn(str(error))
        return ()
    films = plan_films(results, folder, robot=robot, cases=cases, slow=slow)
    warnings: list[str] = []

    def record(name: str) -> tuple[Path, ...]:
        return record_film(films[name], out / name, warn=warnings.append)

    files: list[Path] = []
    with ThreadPoolExecutor(max(1, at_once)) as threads:
        for count, written in enumerate(threads.map(record, films), start=1):
            files += written
            progress(count / len(films))
    for text in dict.fromkeys(warnings):
        warn(text)
    return tuple(files)
