"""Names of joints and robots, which become names of files and are printed."""

from __future__ import annotations

from collections.abc import Iterable

from pronk.errors import PronkError

_MOST_NAMES, _NAME_BYTES = 1000, 120
"""Most joints; longest name, which with an ending is a file name of at most 255 bytes."""
_NOT_IN_NAMES = frozenset('/\\$<>|*?"`')


def check_names(names: Iterable[str], where: str, kind: type[PronkError]) -> None:
    """Refuse names of joints and robots that cannot be file names or cannot be printed."""
    for count, name in enumerate(names, 1):
        size = len(name.encode(errors="replace"))
        if count > _MOST_NAMES:
            raise kind(f"{where}: more than {_MOST_NAMES} names; expected those of joints.")
        bad = _NOT_IN_NAMES.intersection(name) or not name.isprintable() or name[:1] in ".-"
        if not 0 < size <= _NAME_BYTES or bad or name != name.strip():
            raise kind(
                f"{where}: the name {name[:40]!r} cannot be used; expected 1 to {_NAME_BYTES} "
                f"printable characters without {' '.join(sorted(_NOT_IN_NAMES))}, and no space, "
                "dot or dash in front; rename it."
            )
