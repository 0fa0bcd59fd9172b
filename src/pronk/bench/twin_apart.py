"""The virtual robot as a process of its own, for as long as a bench needs it."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from pronk.errors import HardwareError

_READY_S = 60.0
_WRITTEN_S = 120.0
"""In which a virtual robot must be there, and in which it must have written what was seen [s]."""


class TwinApart:
    """`pronk twin` in a process of its own. A context manager; leaving it kills what still runs."""

    def __init__(self, words: list[str], folder: Path) -> None:
        """Remember what to start.

        Args:
            words: After `pronk`.
            folder: For what it says on standard error.
        """
        self._words = words
        self._said = folder / "twin.txt"

    def __enter__(self) -> Self:
        """Start it and wait until it says that it is ready.

        Raises:
            HardwareError: It ended, or was not ready in time; its last words are in the sentence.
        """
        with self._said.open("w", encoding="utf-8") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "pronk.cli", *self._words],
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        late = threading.Timer(_READY_S, self._process.kill)
        late.start()
        try:
            assert self._process.stdout is not None
            if not any(
                line.startswith("ready") for line in iter(self._process.stdout.readline, "")
            ):
                raise self._complaint("was not ready")
        except BaseException:
            self._kill()
            raise
        finally:
            late.cancel()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it, whatever it does."""
        self._kill()

    def stop(self) -> None:
        """Let it write what it has seen, and end.

        Raises:
            HardwareError: It did not, or not in time.
        """
        self._process.terminate()
        try:
            self._process.communicate(timeout=_WRITTEN_S)
        except subprocess.TimeoutExpired:
            raise self._complaint(f"did not end within {_WRITTEN_S:g} s") from None
        if self._process.returncode:
            raise self._complaint(f"ended with status {self._process.returncode}")

    def _kill(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _complaint(self, what: str) -> HardwareError:
        words = self._said.read_text(encoding="utf-8").strip().splitlines()
        return HardwareError(
            f"the virtual robot's process {what}: {words[-1] if words else 'it said nothing'}; "
            f"try `pronk {' '.join(self._words)}` by itself."
        )
