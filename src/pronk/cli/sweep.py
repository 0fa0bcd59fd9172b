"""`pronk sweep`: plan, check, excite, record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from pronk.cli import confirm, console, sweep_wire
from pronk.cli.choices import Layout
from pronk.cli.sweep_virtual import record_virtual as record_virtual
from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.excitation.plan import SweepPlan
    from pronk.excitation.signals import Signal
    from pronk.robots.robot import Robot


SignalName = Literal["chirp", "log-chirp", "multisine", "sine-steps"]
"""Excitation signals."""


AMPLITUDES = (0.25, 0.125)
"""The paper's amplitude (F3) and half of it, so that friction shows [rad]."""


def sweep(
    robot: tyro.conf.Positional[str],
    out: Path,
    link: str = "sim",
    interface: str | None = None,
    layout: Layout | None = None,
    port: int | None = None,
    domain: int | None = None,
    release: Annotated[bool, tyro.conf.arg(name="disable-onboard-controller")] = False,
    real_time: bool = True,
    sim_params: Path | None = None,
    joints: tuple[str, ...] = (),
    signal: SignalName = "chirp",
    amplitude: tuple[float, ...] = (),
    repeats: int = 3,
    seed: int = 0,
    plan_only: bool = False,
    overwrite: bool = False,
    yes: bool = False,
    json_file: console.JsonFile = None,
) -> None:
    """Excite every joint: plan, check against the limits, excite, record.

    Args:
        robot: Robot, for instance mini_cheetah.
        out: Folder for the logs, one MCAP per joint.
        link: sim, the virtual robot in this program; lcm or dds, by wire; or a URI such as
            dds://eth0, lcm://eth0?layout=wtw.
        interface: Network interface to a real robot; without it nothing leaves here.
        layout: Messages on LCM; cheetah if left out.
        port: UDP port of LCM.
        domain: Domain of DDS.
        release: Make the robot's own controller let go of the joints.
        real_time: Ask for real-time scheduling (by wire).
        sim_params: Parameters of the virtual robot, instead of the shipped one.
        joints: Joints to excite; repeat it. All if left out.
        signal: Excitation signal.
        amplitude: Peak of the command in rad; repeat it for several.
        repeats: Times each amplitude is repeated.
        seed: Of the virtual robot's noise.
        plan_only: Show what it would do to the robot and leave.
        overwrite: Replace logs that are already there.
        yes: No confirmation before real hardware moves.
        json_file: Also write the figures to this file.
    """
    from pronk.links.address import SIM, Address
    from pronk.robots import load_robot

    machine = load_robot(robot)
    virtual = link.partition(":")[0] == SIM
    options = {"layout": layout, "port": port, "domain": domain}
    address = Address.parse(link, interface, **options)
    if virtual and (address.interface not in (None, "bench") or release):
        raise HardwareError(
            f"{address}: the virtual robot of a sweep is on the bench, without a wire; leave out "
            "--interface and --disable-onboard-controller; give --seed and --sim-params."
        )
    if virtual:
        seed = int(address.options.get("seed", seed))
        params = address.options.get("params")
        sim_params = sim_params if params is None else Path(str(params))
    elif sim_params is not None:
        raise HardwareError("--sim-params is of --link sim; give it to `pronk simulate` instead.")
    names = [part for entry in joints or () for part in entry.split(",") if part]
    with console.progress() as report:
        report("forecast", 0.0)
        plan = make(machine, names or None, signal, tuple(amplitude or AMPLITUDES), repeats)
        report("forecast", 1.0)
    show_plan(plan)
    plan.check()
    figures: dict[str, Any] = {
        "robot": machine.name,
        "link": str(address),
        "duration_s": plan.duration_s,
        "plan": plan.rows(),
        "logs": [],
    } | ({"virtual": True} if virtual else {})
    if plan_only:
        console.write_json(json_file, figures)
        console.say("next: the same command without --plan-only")
        return
    if virtual:
        with console.progress() as report:
            paths = record_virtual(
                machine,
                plan,
                out,
                sim_params=sim_params,
                seed=seed,
                overwrite=overwrite,
                progress=report.bar("excite the virtual robot"),
            )
        figures["logs"] = paths
        console.say(f"wrote {len(paths)} logs of the virtual robot to {out}")
    else:
        if not address.local and not yes:
            confirm.before_it_moves(machine.name, str(address))
        with console.progress() as report:
            recorded = sweep_wire.record_wire(
                machine,
                plan,
                out,
                address,
                release=release,
                overwrite=overwrite,
                real_time=real_time,
                progress=report.bar(f"excite over {address.kind}"),
            )
        figures |= {
            "virtual": recorded.virtual,
            "logs": recorded.logs,
            "servo": recorded.servo,
        }
        sweep_wire.tell(recorded, out)
    console.write_json(json_file, figures)
    console.following(
        f"pronk response {out}",
        f"pronk match {out} --robot {robot} --out {out}/gains.yaml",
    )


def make_signal(name: SignalName) -> Signal:
    """The signal of that name with its usual settings."""
    from pronk.excitation import signals

    kinds = {
        "chirp": signals.Chirp,
        "log-chirp": signals.LogChirp,
        "multisine": signals.Multisine,
        "sine-steps": signals.SineSteps,
    }
    made: Signal = kinds[name]()
    return made


def make(
    robot: Robot,
    joints: Sequence[str] | None,
    signal: SignalName,
    amplitudes: Sequence[float],
    repeats: int | Sequence[int],
) -> SweepPlan:
    """The plan of a sweep, one joint after another."""
    from pronk.excitation.plan import make_plan

    return make_plan(robot, joints, make_signal(signal), amplitudes=amplitudes, repeats=repeats)


def show_plan(plan: SweepPlan) -> None:
    """Print what the sweep will do to each joint, against its limits."""
    made = console.table(
        f"Plan: {len(plan.asks)} questions, {plan.duration_s:.0f} s of the robot's time; "
        "worst case over what is uncertain",
        "joint",
        "amplitude [rad]",
        "position [rad]",
        "of",
        "speed [rad/s]",
        "of",
        "torque [N m]",
        "of",
        "power [W]",
        "bus [A]",
    )
    for row in plan.rows():
        low, high = float(row["lowest_rad"]), float(row["highest_rad"])
        console.row(
            made,
            str(row["joint"]),
            f"{row['amplitude_rad']:g}",
            f"{low:.2f} to {high:.2f}",
            f"{float(row['range_low_rad']):.2f} to {float(row['range_high_rad']):.2f}",
            f"{float(row['speed_rad_s']):.1f}",
            f"{float(row['no_load_speed_rad_s']):.1f}",
            f"{float(row['torque_nm']):.1f}",
            f"{float(row['effort_limit_nm']):.1f}",
            f"{float(row['electrical_power_w']):.0f}",
            f"{float(row['bus_current_a']):.1f}",
        )
    console.show(made)
