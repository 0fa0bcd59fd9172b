"""`pronk sweep` on a machine over a wire: a real robot, or the virtual one behind its bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pronk.cli import confirm, console

if TYPE_CHECKING:
    from pronk.excitation.plan import SweepPlan
    from pronk.links.address import Address
    from pronk.links.link import Freshness
    from pronk.robots.robot import Robot
    from pronk.runtime.ipc import Event
    from pronk.runtime.run import Recorded


def record_wire(
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    address: Address,
    *,
    release: bool = False,
    overwrite: bool = False,
    real_time: bool = False,
    limits: Mapping[str, float] | None = None,
    fresh: Freshness | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Recorded:
    """Sweep a robot in real time, all joints over one connection of the servo's process.

    Args:
        robot: The robot.
        plan: What to excite; checked by the caller.
        out_dir: Folder for the logs.
        address: Where it is.
        release: Make its own controller let go of the joints first.
        overwrite: Replace logs that are already there.
        real_time: Request real-time scheduling, and report what was granted.
        limits: Other values for scalar limits of the safety filter.
        fresh: How fresh states must be at first; the usual if None.
        progress: Called with the share done, 0 to 1.

    Raises:
        PronkError: The robot may not be moved or the filter stopped it, or a process was killed;
            what was recorded until then stays.
    """
    from pronk.runtime.plan import Link, Plan
    from pronk.runtime.run import run_sweep
    from pronk.runtime.sweep import SweepTask

    rate = Plan.servo_rate_hz
    metadata = {"link": str(address), "servo_rate_hz": f"{rate:g}"}
    task = SweepTask(plan=plan, out_dir=out_dir, overwrite=overwrite, metadata=metadata)
    link = Link(robot=robot.source or robot.name, address=address, release=release, fresh=fresh)
    whole: list[str] = []

    def tell(event: Event) -> None:
        if event.kind == "log":
            whole.append(event.text)
        elif event.kind == "system" and real_time:
            console.say(event.text)

    job = Plan(link=link, sweep=task, real_time=real_time, limits=limits or {})
    try:
        return run_sweep(job, clamp_operator=confirm.Person(), notify=tell, progress=progress)
    except BaseException:
        cut = [path.name for path in task.paths if path.exists() and path.name not in whole]
        if whole or cut:
            console.warn(
                f"ended early; in {out_dir} are kept {', '.join(whole) or 'no whole log'} whole"
                + (f", and {cut[0]} up to the end" if cut else "")
                + "; sweep the others with --joints"
            )
        raise


def tell(recorded: Recorded, out_dir: Path) -> None:
    """What was written, and how punctual the servo was."""
    late: dict[str, Any] = recorded.servo
    console.say(f"wrote {len(recorded.logs)} logs of {recorded.words} to {out_dir}")
    console.say(
        f"servo: {late['n']} ticks, late by {late['p50_ms']:.2f} ms (median), "
        f"{late['p99_ms']:.2f} ms (99 %), {late['max_ms']:.1f} ms at most; {late['missed']} missed"
    )
