"""`pronk match` and `pronk profiles`: gains, and the frameworks that they can be matched for."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from pronk.cli import console, options
from pronk.cli.options import Reading
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus

if TYPE_CHECKING:
    from pronk.identify.match.result import MatchResult
    from pronk.tables import Table

Mode = Literal["gains", "drive"]
Method = Literal["time", "paper"]


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How gains are fitted."""

    mode: Mode = "gains"
    """gains: stiffness and damping (the paper's). drive: damping, armature, friction and delay at
    known stiffness; by a torque channel armature, friction and torque scale."""
    method: Method = "time"
    """time: gains, dry friction and delay in the time domain, all amplitudes together. paper: gains
    by the magnitude of the largest amplitude, over the paper's whole grid."""
    fitted: Annotated[tuple[str, ...], tyro.conf.arg(name="fit")] = ()
    """With --mode drive: fit this instead; repeat it. What the logs do not identify is refused."""
    gain_uncertainty: float = 0.2
    """With --mode drive: share by which the stated gains and the torque constant may be wrong; it
    counts in the intervals. On recordings of AK80-6 drives it is 0.2."""
    zero_armature: bool = True
    """With --method paper: repeat the paper's search without rotor inertia."""
    segment_s: float | None = None
    """Length of the segments of a response in s, whose inverse is the spacing of its frequencies;
    8, or less for shorter excitations, if left out."""


@dataclass(frozen=True, kw_only=True)
class SimulatorOptions:
    """What is simulated with."""

    simulator: str = "mujoco"
    """mujoco, FILE.py:NAME, or the name of an installed simulator."""
    simulator_python: Path | None = None
    """Python that the simulator runs in (3.11 or later, with NumPy)."""


def match_command(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str,
    out: Path = Path("gains.yaml"),
    frameworks: Annotated[tuple[str, ...], tyro.conf.arg(name="for")] = (),
    drive_gains: tuple[str, ...] = (),
    wide: bool = False,
    fit: FitOptions = FitOptions(),
    engine: SimulatorOptions = SimulatorOptions(),
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Find the gains with which the simulator responds like the robot.

    Example:
        pronk match chirp.csv --robot robot.yaml --drive-gains default \
            --for isaaclab-implicit --out out/gains.yaml

    Args:
        paths: Logs, or folders of logs.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        out: The gains file.
        frameworks: Match for this framework too, into a folder of its name beside the gains file;
            repeat it. A name of `pronk profiles`, or NAME,timestep_s=S,iterations=N,friction=none.
        drive_gains: Gains on the real drives if the logs do not have them: JOINT=STIFFNESS,DAMPING
            or GROUP=STIFFNESS,DAMPING, repeat it; or default, those of the robot's file.
        wide: Print every column: both intervals, errors with the nominal gains, coherence.
        fit: How gains are fitted.
        engine: What is simulated with.
        reading: How logs are read.
    """
    from pronk.identify.match import gains as gains_file
    from pronk.identify.match import tables
    from pronk.identify.match.match import match as match_logs
    from pronk.identify.match.result import save_match
    from pronk.identify.match.settings import MatchSettings
    from pronk.identify.response.response import Estimator
    from pronk.identify.simulators.profiles import profile
    from pronk.robots import load_robot

    robot_spec = load_robot(robot)
    if out.suffix not in (".yaml", ".yml"):
        raise PronkError(f"--out {out}: expected a name that ends in .yaml, as in gains.yaml.")
    mode = fit.mode
    simulator = engine.simulator
    if fit.fitted and mode != "drive":
        raise PronkError("--fit names what --mode drive fits; give --mode drive as well.")
    if frameworks and (mode != "gains" or simulator != "mujoco"):
        raise PronkError(
            f"--for {', '.join(frameworks)} with --mode {mode} and --simulator {simulator}; "
            "frameworks are matched in mode gains with simulator mujoco."
        )
    for framework in frameworks:
        profile(framework).robot(robot_spec)
    gains_on_drives = options.drive_gains(drive_gains)
    logs = reading.read(paths, robot_spec)
    settings = MatchSettings(
        fitted=fit.fitted,
        zero_armature=fit.zero_armature,
        simulator_python=engine.simulator_python,
        estimator=Estimator(segment_s=fit.segment_s),
        gain_uncertainty=fit.gain_uncertainty,
    )
    results: dict[str, MatchResult] = {}
    written: list[Path] = []
    result_paths: list[Path] = []
    with console.progress() as report:
        for name in (simulator, *frameworks):

            def report_stage(stage: str, share: float, name: str = name) -> None:
                report(f"{name} {stage}" if name in frameworks else stage, share)

            result = match_logs(
                logs,
                robot_spec,
                name,
                method=fit.method,
                mode=mode,
                drive_gains=gains_on_drives,
                settings=settings,
                progress=report_stage,
            )
            results[name] = result
            folder = out.parent / name if name in frameworks else out.parent
            gains_file.save_gains(folder / out.name, result.gains)
            save_match(folder / "match.npz", result)
            written.extend([folder / out.name, folder / "match.npz"])
            result_paths.append(folder / "match.npz")

    result = results[simulator]
    members = result.joints_of_groups({joint.name: joint for joint in robot_spec.joints})
    figures = summary(result)
    # Where frameworks are named, their gains are wanted, and those of the simulator are an extra.
    named_first = [*frameworks, simulator]
    common_flags = flags_of_all(results.values()) if frameworks else set()
    for name in named_first:
        print_summary(results[name], name if frameworks else "", common_flags)
    for joint_name, flag in sorted(common_flags):
        console.say(f"{joint_name}: {flag}")
    for note in result.notes:
        console.say(f"note: {note}")
    for name in frameworks or (simulator,):
        shown = results[name]
        suffix = f" for {name}" if frameworks else ""
        shown_tables: list[Table] = []
        if mode == "drive":
            shown_tables.append(tables.drives_table(shown))
        if mode == "gains" or has_compared_responses(shown):
            if wide:
                shown_tables.append(tables.gains_table(shown))
            else:
                shown_tables.append(tables.gains_summary_table(shown))
            shown_tables.append(tables.ranges_table(shown, members))
        positions = tables.positions_table(shown)
        if positions.rows:
            shown_tables.append(positions)
        for table in shown_tables:
            console.show(replace(table, title=f"{table.title}{suffix}"), wide=wide)
    if tables.positions_table(result).rows:
        figures["mode"] = mode
        figures["held"] = {}
        figures["rmse"] = {}
        for name, joint in result.joints.items():
            if joint.fit.held:
                figures["held"][name] = joint.fit.held
            figures["rmse"][name] = {"nominal": joint.fit.nominal_rmse, "matched": joint.fit.rmse}
    for name, reason in result.excluded.items():
        console.say(f"left out: {reason if name in reason else f'{name}: {reason}'}")
    if frameworks:
        comparison = tables.simulators_table(results, members)
        console.show(comparison, wide=wide)
        headings = [column.heading for column in comparison.columns]
        figures["frameworks"] = [dict(zip(headings, row, strict=True)) for row in comparison.rows]
    stated_gains = "".join(f" --drive-gains {shlex.quote(entry)}" for entry in drive_gains)
    used_name = named_first[0]
    used_path = out.parent / used_name / out.name if frameworks else out
    return console.Outcome(
        figures=figures,
        wrote=written,
        # The page that is named first is that of the gains that are wanted.
        pages_of=[*result_paths[1:], result_paths[0]],
        following=next_commands(results[used_name], used_path, f"{stated_gains}{reading.words()}"),
        status=match_status(results.values()),
    )


def match_status(results: Iterable[MatchResult]) -> ExitStatus:
    """Return the exit status of matches of the same logs for several simulators."""
    status = ExitStatus.DONE
    for result in results:
        if result.gains.unmatched:
            return ExitStatus.NO_MATCH
        if result.not_better:
            status = ExitStatus.NOT_BETTER
    return status


def next_commands(result: MatchResult, out: Path, options: str = "") -> list[str]:
    """Return the commands that may follow a match, or what to do about joints that are none.

    Args:
        result: The match.
        out: File of its gains.
        options: Options with which logs were read, for the command that reads another log.
    """
    if result.gains.unmatched:
        return unmatched_commands(result)
    if by_torque_alone(result):
        robot = shlex.quote(str(result.robot_path or result.robot))
        return [f"pronk sweep {robot} --out LOGS, for torque tells no gains: match that sweep"]
    gains_file = shlex.quote(str(out))
    commands = [f"pronk predict FRESH_LOG --gains {gains_file}{options}"]
    target = export_target(result)
    if target is not None:
        file = "robot.xml" if target == "mjcf" else "actuators.py"
        commands.append(f"pronk export {gains_file} --to {target} --out {file}")
    return commands


def export_target(result: MatchResult) -> str | None:
    """Return the export that takes the gains of a match as they are; None if there is none."""
    from pronk.identify.match.export.targets import TARGETS
    from pronk.identify.simulators.profiles import profile, profile_of

    try:
        held = profile_of(result.simulator)
    except PronkError:  # A simulator of which pronk does not know the law.
        return None
    for name, target in TARGETS.items():
        if target.profile and profile(target.profile) == held:
            return name
    return "mjcf"


REMEDIES = {
    "armature": "set armature of {joints} in {robot}: the rotor inertia of the motor times the "
    "gear ratio squared. Where no data sheet has it, the same command with --mode drive fits it, "
    "if the stiffness on the drive is known. Then match the same log again",
    "stability": "set a smaller timestep_s and a larger decimation in {robot} for {joints}, or "
    "give --simulator isaaclab-implicit, and match the same log again",
    "pose": "check the joint order of the file (--joint-order), the signs and how the base hangs, "
    "for {joints}, and match the same log again",
    "effort limit": "record {joints} again with the smaller amplitude that its flag names, or "
    "correct the torque limits in {robot}",
    "compliance": "lower the upper end of band_hz of {joints} in {robot} below the resonance, and "
    "match the same log again",
}
"""What to do about a joint that is no match where the same motion recorded again would be none
either, by the first words of one of its flags."""


def unmatched_commands(result: MatchResult) -> list[str]:
    """Return what to do about the joints of a match that are none, a line for each remedy.

    Args:
        result: The match.
    """
    from pronk.identify.match.result import NO_MATCH

    joints_by_remedy: dict[str, list[str]] = {}
    for name in result.gains.unmatched:
        flags = [flag.removeprefix(NO_MATCH) for flag in result.gains.joints[name].flags]
        remedy = "record"
        for words in REMEDIES:
            if any(flag.startswith(f"{words}: ") for flag in flags):
                remedy = words
                break
        joints_by_remedy.setdefault(remedy, []).append(name)
    robot = result.robot_path or f"the robot's file of {result.robot}"
    if result.robot_path and not result.robot_path.endswith((".yaml", ".yml")):
        robot = f"the file of `pronk robot new {robot}`"
    lines = []
    for remedy, names in joints_by_remedy.items():
        joints = ", ".join(names)
        if remedy == "record":
            lines.append(f"record {joints} again")
        else:
            lines.append(REMEDIES[remedy].format(joints=joints, robot=robot))
    lines[-1] += "; --allow-unmatched exports these gains all the same"
    return lines


def by_torque_alone(result: MatchResult) -> bool:
    """Return whether no joint of a match was compared with a commanded motion."""
    for joint in result.joints.values():
        if joint.responses is not None or not math.isnan(joint.fit.rmse):
            return False
    return True


def has_compared_responses(result: MatchResult) -> bool:
    """Return whether measured and simulated responses of any joint were compared."""
    return any(joint.responses is not None for joint in result.joints.values())


def warnings_of(result: MatchResult) -> list[tuple[str, str]]:
    """Return the flags of a match, each with its joint, but for those of joints that are none."""
    from pronk.identify.match.result import NO_MATCH

    pairs = []
    for name, flags in result.flags.items():
        for flag in flags:
            if not flag.startswith(NO_MATCH):
                pairs.append((name, flag))
    return pairs


def flags_of_all(results: Iterable[MatchResult]) -> set[tuple[str, str]]:
    """Return the flags that several matches of the same logs have in common."""
    flag_sets = [set(warnings_of(result)) for result in results]
    return set.intersection(*flag_sets)


def print_summary(
    result: MatchResult, framework: str = "", printed_elsewhere: Set[tuple[str, str]] = frozenset()
) -> None:
    """Print how many joints were matched, the errors, and every flag.

    Args:
        result: The match.
        framework: What it was matched for, where there are several.
        printed_elsewhere: Joints and flags that are left out.
    """
    begin = f"{framework}: " if framework else ""
    matched = len(result.matched_joints)
    count = len(result.joints)
    if has_compared_responses(result):
        console.say(
            f"{begin}{matched} of {count} joints matched. Gain error in the compared band, RMS "
            f"over the joints: {result.nominal_error_db:.2f} dB with the nominal gains of the real "
            f"drive, {result.error_db:.2f} dB with the matched gains."
        )
    elif any(joint.gains.torque for joint in result.joints.values()):
        console.say(f"{begin}Drives of {count} joints fitted by torque.")
    else:
        console.say(f"{begin}{matched} of {count} joints matched.")
    for name, reasons in result.gains.unmatched.items():
        console.say(f"{begin}{name} is no match: {'; '.join(reasons)}")
    warnings_by_joint: dict[str, list[str]] = {}
    for name, flag in warnings_of(result):
        if (name, flag) not in printed_elsewhere:
            warnings_by_joint.setdefault(name, []).append(flag)
    for name, warnings in warnings_by_joint.items():
        console.say(f"{begin}{name}: {'; '.join(warnings)}")


def summary(result: MatchResult) -> dict[str, Any]:
    """Return the figures of a match for `--json`."""
    figures = result.to_dict()
    return result.summary() | {"gains": figures["joints"], "groups": figures["groups"]}


def profiles(wide: bool = False) -> console.Outcome:
    """List the frameworks that gains can be matched for.

    Example:
        pronk profiles --wide

    Args:
        wide: Print every column: the actuators of each framework and the source as well.
    """
    from dataclasses import asdict

    from pronk.identify.simulators.profiles import load_profiles
    from pronk.tables import Column, Table

    rows = []
    for profile in load_profiles().values():
        rows.append(
            (
                profile.name,
                profile.framework,
                profile.drive_law.label,
                1e3 * profile.timestep_s,
                profile.decimation,
                profile.delay,
                profile.friction,
                profile.source,
            )
        )
    columns = (
        Column(heading="name"),
        Column(heading="framework", is_detail=True),
        Column(heading="law"),
        Column(heading="step", unit="ms", digits=1),
        Column(heading="decimation"),
        Column(heading="delay"),
        Column(heading="friction"),
        Column(heading="source", is_detail=True),
    )
    notes = (
        "law E: explicit; IF: implicit damping; In: implicit stiffness and damping, n iterations.",
        "Gains of one law do not give the same joint in another; see docs/evidence/simulators.md.",
    )
    frameworks = Table(title="Frameworks", columns=columns, rows=tuple(rows), notes=notes)
    console.show(frameworks, wide=wide)
    return console.Outcome(
        figures={"profiles": [asdict(profile) for profile in load_profiles().values()]}
    )
