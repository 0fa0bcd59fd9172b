"""Names of joints and robots, which are printed and, by `file_name`, become names of files."""

from __future__ import annotations

from collections.abc import Iterable

from pronk.errors import PronkError

_MOST_NAMES, _NAME_BYTES = 1000, 120
"""Most joints; longest name of a file without its ending (file systems take 255 bytes in all)."""
_NOT_IN_NAMES = frozenset('\\$<>|*?"`')


def file_name(name: str) -> str:
    """Name of a file for a checked name; other for each: `/` (of namespaced models) becomes %2F."""
    return name.replace("%", "%25").replace("/", "%2F")


def check_names(names: Iterable[str], where: str, kind: type[PronkError]) -> None:
    """Refuse names of joints and robots that cannot be printed or, by `file_name`, name a file."""
    for count, name in enumerate(names, 1):
        size = len(file_name(name).encode(errors="replace"))
        if count > _MOST_NAMES:
            raise kind(f"{where}: more than {_MOST_NAMES} names; expected those of joints.")
        bad = _NOT_IN_NAMES.intersection(name) or not name.isprintable() or name[:1] in ".-"
        if not 0 < size <= _NAME_BYTES or bad or name != name.strip():
            raise kind(
                f"{where}: the name {name[:40]!r} cannot be used; expected 1 to {_NAME_BYTES} "
                f"printable characters without {' '.join(sorted(_NOT_IN_NAMES))}, and no space, "
                "dot or dash in front; rename it."
            )
