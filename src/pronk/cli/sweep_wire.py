"""`pronk sweep` on a machine over a wire: a real robot, or the virtual one behind its bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pronk.cli import confirm, console

if TYPE_CHECKING:
    from pronk.excitation.plan import SweepPlan
    from pronk.links.address import Address
    from pronk.links.state_checks import Freshness
    from pronk.robots.robot import Robot
    from pronk.runtime.sweep.record_subprocess import Recorded
    from pronk.runtime.sweep.servo import Timing


def record_wire(
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    address: Address,
    *,
    release: bool = False,
    overwrite: bool = False,
    real_time: bool = False,
    timing: Timing | None = None,
    fresh: Freshness | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Recorded:
    """Ask a robot over a wire, all joints over one connection that a process of its own has.

    Args:
        robot: The robot.
        plan: What to ask; checked by the caller.
        out_dir: Folder for the logs.
        address: Where it is.
        release: Make its own controller let go of the joints first.
        overwrite: Replace logs that are already there.
        real_time: Ask the system for real-time scheduling, and say what it answered.
        timing: Of the servo; the usual if None.
        fresh: How fresh states must be at first; the usual if None.
        progress: Told the share done, 0 to 1.

    Raises:
        PronkError: The robot may not be moved or breached a limit, or the servo's process was
            killed; what was recorded until then stays.
    """
    from pronk.runtime.sweep.record_subprocess import record_apart
    from pronk.runtime.sweep.servo import Timing
    from pronk.runtime.sweep.servo_process import Job

    job = Job(
        robot=robot,
        plan=plan,
        out_dir=out_dir,
        address=address,
        release=release,
        overwrite=overwrite,
        real_time=real_time,
        timing=timing or Timing(),
        fresh=fresh,
    )
    logs: list[Path] = []
    try:
        return record_apart(
            job,
            clamp_operator=confirm.Person(),
            progress=progress,
            say=console.say,
            begun=logs.append,
        )
    except BaseException:
        _say_what_is_kept(out_dir, logs)
        raise


def tell(recorded: Recorded, out_dir: Path) -> None:
    """What was written, and how punctual the servo was."""
    late: dict[str, Any] = recorded.servo
    console.say(f"wrote {len(recorded.logs)} logs of {recorded.words} to {out_dir}")
    console.say(
        f"servo: {late['n']} ticks, late by {late['p50_ms']:.2f} ms (median), "
        f"{late['p99_ms']:.2f} ms (99 %), {late['max_ms']:.1f} ms at most; {late['missed']} missed"
    )


def _say_what_is_kept(out_dir: Path, logs: list[Path]) -> None:
    """One line on the logs that were begun; the last one is that which was cut short."""
    if logs:
        whole = f"{', '.join(path.stem for path in logs[:-1])} whole, and " if logs[1:] else ""
        console.warn(
            f"ended early; in {out_dir} are kept {whole}what was recorded until then of "
            f"{logs[-1].stem}; ask the others with --joints"
        )
