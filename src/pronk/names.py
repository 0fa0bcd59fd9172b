"""Names of joints and robots, which are printed and become names of files."""

from __future__ import annotations

from collections.abc import Iterable

from pronk.errors import PronkError

_MAX_NAMES = 1000
"""Largest number of joints of a robot."""
_MAX_NAME_BYTES = 120
"""Longest name of a file without its ending; file systems take 255 bytes in all."""
_FORBIDDEN_CHARACTERS = frozenset('\\$<>|*?"`')
_FORBIDDEN_FIRST_CHARACTERS = (".", "-")


def file_name(name: str) -> str:
    """Return a name of a file for a checked name; no two names share one.

    The slash of namespaced models becomes `%2F`.
    """
    return name.replace("%", "%25").replace("/", "%2F")


def check_names(names: Iterable[str], where: str, kind: type[PronkError]) -> None:
    """Refuse names that cannot be printed or, by `file_name`, cannot name a file.

    Args:
        names: Names of joints or robots.
        where: Where they stand, for the message.
        kind: Class of the error.
    """
    for count, name in enumerate(names, start=1):
        if count > _MAX_NAMES:
            raise kind(f"{where}: more than {_MAX_NAMES} names; expected those of joints.")
        size = len(file_name(name).encode(errors="replace"))
        usable = (
            0 < size <= _MAX_NAME_BYTES
            and name.isprintable()
            and name == name.strip()
            and not name.startswith(_FORBIDDEN_FIRST_CHARACTERS)
            and _FORBIDDEN_CHARACTERS.isdisjoint(name)
        )
        if not usable:
            raise kind(
                f"{where}: the name {name[:40]!r} cannot be used; expected 1 to {_MAX_NAME_BYTES} "
                f"printable characters without {' '.join(sorted(_FORBIDDEN_CHARACTERS))}, and no "
                "space, dot or dash in front; rename it."
            )
