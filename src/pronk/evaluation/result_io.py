"""A sheet: one JSON file of what else was tried, beside a trial's table.

Every sheet says what was run (policies with their hashes, the parameters, seed, versions), what its
figures mean, and has one entry a run; what is summed up in it is for the reader, and is summed up
anew from the entries when a sheet is read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from pronk.errors import ArtefactError
from pronk.evaluation.metrics import Figure
from pronk.evaluation.result import Subject
from pronk.evaluation.run import versions
from pronk.files import write_text
from pronk.robots.robot import Robot

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where the numbers of a sheet come from."""

    robot: str
    virtual: bool
    """True: measured on pronk's virtual robot."""
    subjects: tuple[Subject, ...]
    sim_params: Mapping[str, Any]
    """The virtual robot's body: its file and the hash of it."""
    seed: int
    versions: Mapping[str, str] = field(default_factory=versions)
    seconds: float = math.nan
    """Wall time, the only number that a repeat changes [s]."""


def origin(
    robot: Robot, subjects: Sequence[Subject], *, about: Mapping[str, Any] | None, seed: int
) -> Origin:
    """Where the numbers of a virtual robot come from."""
    return Origin(
        robot=robot.name,
        virtual=True,
        subjects=tuple(subjects),
        sim_params=dict(about or {}),
        seed=seed,
    )


def definitions(figures: Mapping[str, Figure]) -> dict[str, Any]:
    """What figures mean, for a sheet."""
    return {name: asdict(figure) for name, figure in figures.items()}


def save(path: Path, schema: str, where: Origin, body: Mapping[str, Any]) -> Path:
    """Write a sheet, whole or not at all; returns its path.

    Args:
        path: Where to.
        schema: What the sheet is.
        where: Its origin.
        body: The rest; numbers that are not known become null, dataclasses mappings.
    """
    told = {"schema": schema, "origin": asdict(where), **body}
    write_text(path, json.dumps(_plain(told), indent=1, allow_nan=False) + "\n")
    return path


@contextmanager
def load(path: Path, schema: str, *, writer: str) -> Iterator[tuple[Origin, dict[str, Any]]]:
    """Read a sheet: its origin and the whole of it.

    Args:
        path: The file.
        schema: That this pronk reads.
        writer: The command that writes one, for errors.

    Raises:
        ArtefactError: Missing, damaged or of another schema, also where the block finds so.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `{writer}` writes it.") from None
    except (OSError, ValueError) as error:
        raise ArtefactError(f"{path}: cannot be read ({type(error).__name__}).") from None
    found = body.get("schema") if isinstance(body, dict) else None
    if found != schema:
        raise ArtefactError(f"{path}: schema {found!r}; this pronk reads {schema!r}.")
    try:
        told = dict(body["origin"])
        told["subjects"] = tuple(Subject(**entry) for entry in told["subjects"])
        yield entry_of(Origin, told), body
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ArtefactError(
            f"{path}: damaged ({type(error).__name__}: {error}); `{writer}` writes it anew."
        ) from error


def entry_of(kind: type[T], entry: Mapping[str, Any]) -> T:
    """Build a flat dataclass from its mapping: lists become tuples, null an unknown number.

    Args:
        kind: The dataclass.
        entry: Its fields.

    Raises:
        TypeError: A field is missing or unknown.
    """
    numbers = {one.name for one in fields(kind) if one.type == "float"}  # type: ignore[arg-type]
    values = {name: _tuples(value) for name, value in entry.items()}
    return kind(
        **{
            name: math.nan if value is None and name in numbers else value
            for name, value in values.items()
        }
    )


def _tuples(value: Any) -> Any:
    return tuple(_tuples(part) for part in value) if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if hasattr(value, "__dataclass_fields__"):
        return _plain(asdict(value))
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
