"""Moving pictures and strips of still frames that lie beside a trial, small enough for a page."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

from pronk.errors import ArtefactError
from pronk.evaluation.results import SUMMARY
from pronk.report.shell import Picture

LARGEST_BYTES = 1_500_000
"""A moving picture larger than this is made smaller before it goes into the page."""
SMALL_WIDTH = 320
"""Width that it is made smaller to [px]."""
EVERY = 2
"""Of its frames, every which is kept."""


@dataclass(frozen=True, kw_only=True)
class Clips:
    """What a trial's folder has to look at."""

    moving: tuple[Picture, ...]
    strips: tuple[Picture, ...]
    films: tuple[str, ...]
    """Names of video files, which a page only names: they are large."""

    def __bool__(self) -> bool:
        """True if there is anything."""
        return bool(self.moving or self.strips or self.films)


def clips(folder: Path) -> Clips:
    """Everything to look at in a folder and in those in it, in the order of their names.

    Raises:
        ArtefactError: A picture is damaged.
    """
    return Clips(
        moving=tuple(_moving(path) for path in _files(folder, "gif")),
        strips=tuple(_still(path) for path in _files(folder, "png")),
        films=tuple(str(path.relative_to(folder)) for path in _files(folder, "mp4")),
    )


def _files(folder: Path, kind: str) -> list[Path]:
    # A folder with a trial of its own is a part of its own, with its pictures.
    inner = [path for path in folder.iterdir() if path.is_dir() and not (path / SUMMARY).exists()]
    return sorted(path for place in (folder, *inner) for path in place.glob(f"*.{kind}"))


def _words(path: Path) -> str:
    return f"{path.stem.replace('_', ' ')}, virtual robot"


def _still(path: Path) -> Picture:
    coded = base64.b64encode(_checked(path)).decode("ascii")
    return Picture(
        src=f"data:image/png;base64,{coded}",
        alt=f"Still frames: {_words(path)}",
        caption=_words(path),
    )


def _moving(path: Path) -> Picture:
    data = _checked(path)
    coded = base64.b64encode(smaller(data) if len(data) > LARGEST_BYTES else data).decode("ascii")
    return Picture(
        src=f"data:image/gif;base64,{coded}",
        alt=f"Moving picture: {_words(path)}",
        caption=_words(path),
    )


def _checked(path: Path) -> bytes:
    """The bytes of a picture that can be opened.

    Raises:
        ArtefactError: It cannot.
    """
    from PIL import Image

    data = path.read_bytes()
    try:
        with Image.open(io.BytesIO(data)) as opened:
            opened.load()
    except Exception as error:
        raise ArtefactError(
            f"{path}: no picture that can be opened ({type(error).__name__}); delete it, or let "
            "`pronk trial` make it anew."
        ) from error
    return data


def smaller(data: bytes) -> bytes:
    """A GIF at most `SMALL_WIDTH` wide with every `EVERY`-th frame, at its own speed."""
    from PIL import Image, ImageSequence

    with Image.open(io.BytesIO(data)) as film:
        scale = min(1.0, SMALL_WIDTH / film.width)
        size = (max(1, round(film.width * scale)), max(1, round(film.height * scale)))
        frames: list[Image.Image] = []
        times: list[int] = []
        for i, frame in enumerate(ImageSequence.Iterator(film)):
            shown = int(frame.info.get("duration", 40))
            if i % EVERY:
                times[-1] += shown
            else:
                frames.append(frame.convert("RGB").resize(size))
                times.append(shown)
    out = io.BytesIO()
    frames[0].save(
        out, format="GIF", save_all=True, append_images=frames[1:], duration=times, loop=0
    )
    return out.getvalue()
