"""The folder of one trial: what lies where in it, and whether it may be written to.

trials.csv      one row a jump
summary.json    what was run, and the sums
captures/       what was seen
videos/         what was painted of it
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from pronk.errors import PronkError
from pronk.evaluation.pictures.video import ENDINGS
from pronk.evaluation.result import SUMMARY, TABLE

CAPTURES = "captures"
"""Folder of what was seen, beside the table."""
VIDEOS = "videos"
"""Folder of what was painted, beside the table."""


def prepare(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder of a trial, before anything is computed.

    Args:
        out: The folder.
        overwrite: Take a folder that holds a trial, and delete that trial's own files.

    Raises:
        PronkError: It is no folder, holds something, or cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise PronkError(f"--out {out}: a file; expected the name of a folder.")
    try:
        filled = out.is_dir() and any(out.iterdir())
        old = (out / SUMMARY, out / TABLE)
        if filled and not overwrite:
            raise PronkError(
                f"--out {out}: already holds something; give another folder, or --overwrite to "
                "replace the trial in it."
            )
        # An interrupted trial leaves captures alone.
        if filled and not any(path.exists() for path in (*old, out / CAPTURES)):
            raise PronkError(
                f"--out {out}: holds no trial to overwrite; give a new or an empty folder."
            )
        out.mkdir(parents=True, exist_ok=True)
        # A folder that cannot be written to is found out now, not after an hour.
        with tempfile.NamedTemporaryFile(dir=out):
            pass
        painted = (path for ending in ENDINGS for path in (out / VIDEOS).glob(f"*{ending}"))
        for path in (*old, *(out / CAPTURES).glob("*.npz"), *painted):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise PronkError(
            f"--out {out}: cannot be written to ({error.strerror}); give another folder."
        ) from None
