"""Replays: a log the fit never saw, answered by the simulator with naive and with matched gains.

`pronk predict` writes one `*.prediction.npz` per log (plain arrays and a JSON header, no pickle);
the page and the figure of "before and after in time" are made from it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pronk.errors import ArtefactError
from pronk.files import written_whole
from pronk.report import style

SCHEMA = "pronk/prediction/1"

Array = NDArray[np.float64]

_ARRAYS = ("time", "command", "measured", "naive", "matched")
_SCALARS = ("joint", "signal", "rmse_naive", "rmse_matched", "r2_naive", "r2_matched", "unit")


@dataclass(frozen=True, kw_only=True)
class Replay:
    """One joint's answer to one question, measured and simulated, on the same instants."""

    joint: str
    time: Array
    """Instants [s], shape (n,)."""
    command: Array
    """Position command in force [rad], shape (n,)."""
    measured: Array
    """[rad], shape (n,)."""
    naive: Array
    """Simulated with the gains of the real drive [rad], shape (n,)."""
    matched: Array
    """Simulated with the matched gains [rad], shape (n,)."""
    rmse_naive: float
    """Root mean square of simulated less measured, over every segment [rad]."""
    rmse_matched: float
    r2_naive: float
    """Share of the measured variance that the simulation explains."""
    r2_matched: float
    signal: str = "unknown"
    """Kind of the signal that was replayed."""
    unit: str = "rad"
    """Unit of the positions."""


def save(path: Path, replays: Sequence[Replay], *, virtual: bool, source: str) -> None:
    """Write replays of one log, whole or not at all."""
    header = {
        "schema": SCHEMA,
        "virtual": virtual,
        "source": source,
        "replays": [{name: getattr(r, name) for name in _SCALARS} for r in replays],
    }
    arrays = {f"{i}/{name}": getattr(r, name) for i, r in enumerate(replays) for name in _ARRAYS}
    with written_whole(path) as aside, aside.open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """All replays of one log."""

    replays: tuple[Replay, ...]
    virtual: bool
    source: str


def load(path: Path) -> Prediction:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            if header.get("schema") != SCHEMA:
                raise ArtefactError(
                    f"{path}: schema {header.get('schema')!r}; this pronk reads {SCHEMA!r}."
                )
            replays = tuple(
                Replay(**entry, **{name: stored[f"{i}/{name}"] for name in _ARRAYS})
                for i, entry in enumerate(header["replays"])
            )
            return Prediction(
                replays=replays, virtual=bool(header["virtual"]), source=str(header["source"])
            )
    except ArtefactError:
        raise
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `pronk predict LOG` writes one.") from None
    except Exception as error:
        raise ArtefactError(
            f"{path}: not a prediction of pronk ({type(error).__name__}); "
            "`pronk predict LOG` writes one."
        ) from error


def busiest_window(replay: Replay, seconds: float) -> slice:
    """The window of this length in which the error of the naive simulation varies most.

    The variance, not the mean square: a joint that rests beside its command is not the picture.
    """
    rate = (len(replay.time) - 1) / float(replay.time[-1] - replay.time[0])
    width = min(max(2, round(seconds * rate)), len(replay.time))
    error = replay.naive - replay.measured
    total = np.concatenate(([0.0], np.cumsum(error)))
    power = np.concatenate(([0.0], np.cumsum(error**2)))
    mean = (total[width:] - total[:-width]) / width
    variance = (power[width:] - power[:-width]) / width - mean**2
    start = int(np.argmax(variance))
    return slice(start, start + width)


def figure(replay: Replay, *, virtual: bool, seconds: float = 1.5) -> Figure:
    """Command, measured, naive and matched in time, and what is left over, below.

    Args:
        replay: One joint's replay.
        virtual: The measured curve is the virtual robot's.
        seconds: Length of the window shown, by `busiest_window` [s].
    """
    window = busiest_window(replay, seconds)
    time = replay.time[window]
    measured = replay.measured[window]
    robot = "measured on the virtual robot" if virtual else "measured"
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 4.8), layout="constrained")
        top, bottom = drawn.subplots(2, 1, sharex=True, height_ratios=[3.0, 1.4])
        top.step(time, replay.command[window], where="post", color=style.COMMAND, linewidth=0.7)
        top.plot(time, measured, **style.MEASURED_LINE)
        top.plot(time, replay.naive[window], **style.NAIVE_LINE)
        top.plot(time, replay.matched[window], **style.MATCHED_LINE)
        top.set_ylabel(f"position [{replay.unit}]")
        asked = "log" if replay.signal == "unknown" else replay.signal.replace("_", " ")
        top.set_title(f"{style.joint_words(replay.joint)}: a {asked} replayed")
        bottom.axhline(0.0, color="#666666", linewidth=0.8)
        bottom.plot(time, replay.naive[window] - measured, **style.NAIVE_LINE)
        bottom.plot(time, replay.matched[window] - measured, **style.MATCHED_LINE)
        bottom.set_ylabel(f"error [{replay.unit}]")
        bottom.set_xlabel("time [s]")
        bottom.set_xlim(time[0], time[-1])
        handles = [
            Line2D([], [], color=style.COMMAND, linewidth=0.7, label="command"),
            Line2D([], [], label=robot, **style.MEASURED_LINE),
            Line2D([], [], label=f"naive: RMSE {replay.rmse_naive:.4f}", **style.NAIVE_LINE),
            Line2D([], [], label=f"matched: RMSE {replay.rmse_matched:.4f}", **style.MATCHED_LINE),
        ]
        drawn.legend(handles=handles, loc="outside lower center", ncols=4)
    return drawn
