"""Write the notebooks of examples/notebooks from the cells below.

    python scripts/make_notebooks.py

Notebooks are JSON; their cells are kept here, where they can be read and reviewed.
"""

from __future__ import annotations

import json
from pathlib import Path

OUT = Path(__file__).resolve().parents[1] / "examples" / "notebooks"

READ_OPTIONS = """\
folder = Path("../csv_to_isaaclab")
robot = pronk.load_robot(folder / "robot.yaml")
columns = {
    "time": "t_ms",
    "command.hip": "hip_des",
    "position.hip": "hip_act",
    "command.knee": "knee_des",
    "position.knee": "knee_act",
}
options = pronk.ReadOptions(unit="deg", time_unit="ms", columns=columns)
"""
"""Lines that both notebooks read the logs of the leg with."""

LOG_TO_GAINS = [
    """# From a log to gains

A CSV file of two joints, degrees and milliseconds, becomes gains for Isaac Lab. The log is of a simulated leg whose
drives differ from what `robot.yaml` states; see `examples/csv_to_isaaclab/record.py`.""",
    """
from pathlib import Path

import pronk

READ_OPTIONS_HERE
log = pronk.read_log(folder / "chirp.csv", robot=robot, options=options)
print(log.joints, f"{log.rate_hz:.0f} Hz, {len(log.time)} samples")
""",
    """## What did the joint do?

The frequency response is the share of a sine that arrives, and how late. One response an amplitude.""",
    """
for response in pronk.response(log, "knee"):
    slow = response.band(0.5, 2.0)
    fast = response.band(8.0, 12.0)
    print(f"amplitude {response.amplitude:.2f} rad:"
          f" gain {response.gain[slow].mean():.2f} below 2 Hz, {response.gain[fast].mean():.2f} at 10 Hz,"
          f" lowest coherence {response.coherence[slow].min():.3f}")
""",
    """## Match

`drive_gains` are the gains that were on the drives, here those of `robot.yaml`. They decide the nominal curves; the
matched gains do not depend on them.""",
    """
drive_gains = {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints}
result = pronk.match([log], robot, "isaaclab-implicit", drive_gains=drive_gains)
for name, joint in result.gains.joints.items():
    low, high = joint.stiffness.total95
    print(f"{name}: {joint.stiffness.value:.2f} N m/rad (95 %: {low:.2f} to {high:.2f}),"
          f" {joint.damping.value:.3f} N m s/rad, friction {joint.frictionloss.value:.2f} N m,"
          f" delay {1000 * joint.delay_s.value:.1f} ms, error {joint.quality.error_db:.2f} dB")
""",
    "result.plot()",
    "## Write the configuration",
    """
text = pronk.export(result.gains, "isaaclab-implicit", robot=robot)
print(text)
""",
]

WHERE_IT_MATTERS = [
    """# Where the match matters

The same gains are put into several simulators. Each is another joint; the gains that respond alike differ.""",
    """
import pronk
from pronk.identify.match.translate import stated_gains, translate
from pronk.identify.simulators.profiles import load_profiles, profile

pendulum = pronk.load_robot("../pendulum/robot.yaml")
# A drive with a control loop of 10 kHz: the explicit law at 0.1 ms.
drive = stated_gains(pendulum, {"swing": (17.0, 0.4)}, profile("mjlab,timestep_s=0.0001"))
for name, framework in load_profiles().items():
    _, translations = translate(drive, pendulum, framework)
    swing = translations["swing"]
    stiffness, damping = swing.after
    print(f"{name:20} copied gains: {swing.before_db:4.2f} dB off;"
          f" use {stiffness:5.2f} / {damping:.3f}: {swing.after_db:.3f} dB")
""",
    """## On a log

The same leg as in the other notebook, matched for two actuators, then replayed on a log that neither match has seen.""",
    """
from pathlib import Path

READ_OPTIONS_HERE
chirp = pronk.read_log(folder / "chirp.csv", robot=robot, options=options)
fresh = pronk.read_log(folder / "fresh.csv", robot=robot, options=options)
drive_gains = {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints}
result = pronk.match([chirp], robot, drive_gains=drive_gains)
prediction = pronk.predict(fresh, robot, result.gains, drive_gains=drive_gains)
for replay in prediction.joints:
    print(f"{replay.joint}: {1000 * replay.rmse_nominal:.1f} mrad with nominal gains,"
          f" {1000 * replay.rmse_nominal_delayed:.1f} with their best delay,"
          f" {1000 * replay.rmse_matched:.1f} matched")
""",
    """Five milliseconds of delay and a torque that is ten per cent low are invisible to the eye; a policy meets them at every
step. `docs/results.md` has what that does to jumps.""",
]


def notebook(cells: list[str]) -> str:
    """Return a notebook as JSON; a cell that begins with a line break or a name is code."""
    written = []
    for number, text in enumerate(cells):
        source = text.strip("\n").replace("READ_OPTIONS_HERE\n", READ_OPTIONS)
        is_code = text.startswith("\n") or source.startswith("result.")
        cell: dict[str, object] = {
            "cell_type": "code" if is_code else "markdown",
            "id": f"cell-{number}",
            "metadata": {},
            "source": source.splitlines(keepends=True),
        }
        if is_code:
            cell |= {"execution_count": None, "outputs": []}
        written.append(cell)
    body = {
        "cells": written,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(body, indent=1) + "\n"


def main() -> None:
    """Write the notebooks."""
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "log_to_gains.ipynb").write_text(notebook(LOG_TO_GAINS), encoding="utf-8")
    (OUT / "where_the_match_matters.ipynb").write_text(notebook(WHERE_IT_MATTERS), encoding="utf-8")


if __name__ == "__main__":
    main()
