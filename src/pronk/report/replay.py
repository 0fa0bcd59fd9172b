"""Replays in time: before and after, from `*.prediction.npz`."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pronk.match.prediction import JointPrediction
from pronk.report import style


def busiest_window(replay: JointPrediction, seconds: float) -> slice:
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


def figure(replay: JointPrediction, *, virtual: bool, seconds: float = 1.5) -> Figure:
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
