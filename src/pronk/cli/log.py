"""`pronk log`: guess how a log is read, or write its motion for Foxglove."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from pronk.cli import console
from pronk.cli.options import Reading
from pronk.errors import LogError
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.identify.logs.inspection import LogGuess
    from pronk.identify.logs.joint_log import JointLog

LogAction = Literal["inspect", "foxglove"]


def log(
    action: tyro.conf.Positional[LogAction],
    path: tyro.conf.Positional[Path],
    robot: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
    yes: bool = False,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Guess how a log is read and write that down, or write its motion for Foxglove.

    Columns, units, rate and joints are told by names and values. Where two readings are plausible
    both are named, and an option decides.

    The action foxglove writes an MCAP file that Foxglove shows in 3D: links, shapes, joint states
    with units, on the wall clock.

    Example:
        pronk log inspect chirp.csv --robot robot.yaml --unit deg --yes
        pronk log foxglove chirp.csv --robot robot.yaml --out chirp.3d.mcap

    Args:
        action: inspect: guess, show, and with --yes write chirp.log.yaml beside chirp.csv for every
            later command. foxglove: write the motion of the robot for Foxglove's 3D panel.
        path: The log; for foxglove also that of a policy's run (pronk deploy --log).
        robot: A name, or a path to a robot.yaml, MJCF or URDF; for the names of the joints, and for
            foxglove for the links.
        out: File that foxglove writes; the log's name with the ending .3d.mcap if left out.
        overwrite: Replace a file of foxglove that exists.
        yes: Write the description.
        reading: How logs are read; what is stated is not guessed.
    """
    if action == "foxglove":
        return _write_foxglove(path, robot, out, reading, overwrite=overwrite)
    from pronk.identify.logs.description import description_path, write_description
    from pronk.identify.logs.inspection import inspect_log
    from pronk.robots import load_robot

    robot_spec = load_robot(robot) if robot else None
    guess = inspect_log(path, robot_spec, reading.options())
    console.show(guess_table(guess))
    for reason in guess.reasons:
        console.say(f"note: {reason}")
    excited: tuple[str, ...] = ()
    if guess.log is not None:
        excited = guess.log.excited_joints
        for remark in guess.log.notes:
            console.say(f"note: {remark}")
        console.say(f"excited: {', '.join(excited) or 'no joint'}")
    figures = {
        "columns": {column.name: column.reading for column in guess.columns if column.reading},
        "unit": guess.options.unit,
        "time_unit": guess.options.time_unit,
        "questions": guess.questions,
        "excited": excited,
    }
    if guess.questions:
        for question in guess.questions:
            console.say(f"open: {question}")
        if yes:
            raise LogError(
                f"{path}: nothing was written, as not everything can be told: "
                f"{'; '.join(guess.questions)}."
            )
        return console.Outcome(figures=figures)
    robot_words = f" --robot {shlex.quote(robot)}" if robot else ""
    command = f"pronk response {shlex.quote(str(path))}{robot_words}"
    if not yes:
        repeated = f"pronk log inspect {shlex.quote(str(path))}{robot_words}{reading.words()} --yes"
        console.say(f"nothing was written; --yes writes {description_path(path)}")
        return console.Outcome(figures=figures, following=[repeated])
    written = write_description(path, guess.options)
    return console.Outcome(figures=figures, wrote=[written], following=[command])


def _write_foxglove(
    path: Path, robot: str | None, out: Path | None, reading: Reading, *, overwrite: bool
) -> console.Outcome:
    """Write the motion of a robot in a log for Foxglove."""
    from pronk.files import require_new
    from pronk.report.foxglove import write_foxglove
    from pronk.report.motion import read_motion
    from pronk.robots import load_robot

    if robot is None:
        raise LogError(
            "pronk log foxglove needs --robot: a name, or the path of a robot.yaml, MJCF or URDF, "
            "for the links."
        )
    target = out or path.with_name(f"{path.name.split('.')[0]}.3d.mcap")
    if target.suffix != ".mcap":
        raise LogError(f"--out {target}: expected a name that ends in .mcap.")
    require_new(target, "--out", overwrite=overwrite, kind=LogError)
    if target.resolve() == path.resolve():
        raise LogError(f"--out {target} is the log itself; give another name.")
    robot_spec = load_robot(robot)

    def read_joint_log() -> JointLog:
        logs = reading.read([path], robot_spec)
        if len(logs) != 1:
            raise LogError(f"{path}: {len(logs)} logs; give one of them.")
        return logs[0]

    motion = read_motion(path, robot_spec, read_joint_log)
    frames = write_foxglove(target, robot_spec, motion)
    for note in motion.notes:
        console.say(f"note: {note}")
    seconds = float(motion.time_ns[-1] - motion.time_ns[0]) / 1e9
    console.say(f"{frames} frames in {seconds:.1f} s; open {target} in Foxglove, 3D panel")
    return console.Outcome(figures={"frames": frames, "seconds": seconds}, wrote=[target])


def guess_table(guess: LogGuess) -> Table:
    """Return the table of a guess: each column with what it is taken for and its first values."""
    rows = []
    for column in guess.columns:
        samples = [*column.samples, "", "", ""][:3]
        reading = column.reading or "not read"
        rows.append((column.name, reading, column.unit or None, *samples))
    return Table(
        title=f"Guess at {guess.path.name} ({guess.options.format})",
        columns=(
            Column(heading="in the file"),
            Column(heading="read as"),
            Column(heading="unit"),
            Column(heading="1st row"),
            Column(heading="2nd row"),
            Column(heading="3rd row"),
        ),
        rows=tuple(rows),
    )
