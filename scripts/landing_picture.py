"""Draw the landings of two policies below each other, from a trial of pronk: docs/landing.png.

    pronk trial policies/matched/policy.onnx --also policies/naive/policy.onnx --commands=-2,0 \
        --jumps 1 --no-video --out out/landing
    python scripts/landing_picture.py out/landing "back 2" docs/landing.png

Each row has the first jump of a policy: apex, touchdown, the lowest moment after it, and 0.5 s
later. At the lowest moment a label says whether anything but feet touches the ground.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from pronk.jump.trial.films.record import plan_films, record_film
from pronk.jump.trial.results import load_results
from pronk.jump.virtual.capture import load_capture
from pronk.robots import load_robot

LANDING_S = 0.3
"""Time after touchdown in which the lowest moment is looked for [s]."""
AFTERWARDS_S = 0.5
"""Time from the lowest moment to the last still [s]."""


def draw_landings(trial_folder: Path, case: str, picture: Path) -> None:
    """Draw the first jump of each policy of a trial with one command."""
    results = load_results(trial_folder)
    robot = load_robot(results.subjects[0].contract["robot"])
    films = plan_films(results, trial_folder, robot=robot, cases=(case,))
    captures = {}
    for row in results.rows:
        if row.number == 0 and row.case == case:
            captures[row.policy] = load_capture(trial_folder / row.capture)
    strips = []
    with tempfile.TemporaryDirectory() as folder:
        for subject, (name, film) in zip(results.subjects, films.items(), strict=True):
            assert film.events is not None, f"{name}: no jump"
            touchdown = film.events.touchdown
            height = film.qpos[:, 2]
            is_landing = (film.time >= touchdown) & (film.time <= touchdown + LANDING_S)
            lowest = int(np.flatnonzero(is_landing)[np.argmin(height[is_landing])])
            moments = (
                film.time[int(np.argmax(height))],
                touchdown,
                film.time[lowest],
                film.time[lowest] + AFTERWARDS_S,
            )
            frames = np.searchsorted(film.time, moments).clip(0, len(film.time) - 1)
            capture = captures[subject.name]
            after = (capture.time >= touchdown) & (capture.time <= touchdown + LANDING_S)
            lowest_label = "lowest, on its feet"
            if capture.other_contact[after].any():
                lowest_label = "lowest, links touch"
            # Only the stills are wanted; a film of a few frames is rendered with them.
            start = int(np.searchsorted(film.time, film.events.liftoff))
            few = slice(start, start + 4)
            still = replace(
                film,
                time=film.time[few],
                rate=film.rate[few],
                qpos=film.qpos[few],
                look=film.look[few],
                labels=("apex", "touchdown", lowest_label, "afterwards"),
                pose_time=film.time[frames] - film.events.liftoff,
                pose_qpos=film.qpos[frames],
            )
            files = record_film(still, Path(folder) / name, warn=print)
            strips.append(np.asarray(Image.open(files[-1]).convert("RGB")))
    Image.fromarray(np.vstack(strips)).quantize(128).save(picture, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trial", type=Path)
    parser.add_argument("case")
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    draw_landings(arguments.trial, arguments.case, arguments.picture)
