"""The videos of a trial: each command's first jump that was kept, for each policy.

Every film is painted by a process of its own, which one thread here waits for; so two threads paint
two films at once.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pronk.evaluation.jump_events import jump_events
from pronk.evaluation.pictures import video
from pronk.evaluation.pictures.film import Film, plan
from pronk.evaluation.results import Results, Row
from pronk.virtual import capture as captures

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
        tell: Told in one sentence what cannot be written, and what is missing for it.
        cases: Names of the commands that are shown; all if None.
        slow: How many times slower than real time the flight is shown.
        at_once: How many films are painted at once; not more than there are cores.
        progress: Told the share that is done, 0 to 1.

    Returns:
        The files that were written; none where nothing can be painted.
    """
    if lack := video.no_gl():
        tell(lack)
        return ()
    planned = list(films_of(found, folder, cases=cases, slow=slow))
    shares = [0.0] * len(planned)

    def paint(index: int) -> tuple[tuple[Path, ...], list[str]]:
        stem, film = planned[index]
        complaints: list[str] = []

        def share(part: float) -> None:
            shares[index] = part
            if progress is not None:
                progress(sum(shares) / len(shares))

        return video.record(film, out, stem, tell=complaints.append, progress=share), complaints

    with ThreadPoolExecutor(max(1, at_once)) as threads:
        painted = list(threads.map(paint, range(len(planned))))
    # What one film lacks the others lack too: it is told once.
    for text in dict.fromkeys(text for _, complaints in painted for text in complaints):
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
