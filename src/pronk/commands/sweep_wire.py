"""`pronk sweep` on a machine over a wire: a real robot, or the virtual one behind its bytes."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pronk.commands import confirm, console
from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.hardware.links import Address
    from pronk.hardware.preflight import Freshness
    from pronk.robots.robot import Robot
    from pronk.sweep.plan import SweepPlan
    from pronk.sweep.servo import Timing

_PRIORITY = 50
"""Of SCHED_FIFO: above the virtual robot's, below the kernel's own threads."""
_SWITCH_S = 0.5e-3
"""How long one Python thread may keep another from running."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What a recording over a wire left."""

    logs: list[Path]
    virtual: bool
    servo: dict[str, float | int]
    """Lateness of the servo's ticks."""

    @property
    def words(self) -> str:
        """Whose logs they are."""
        return "the virtual robot" if self.virtual else "a robot that is not the virtual one"


def enter_real_time() -> None:
    """Ask the system for real-time scheduling and say what it answered."""
    from pronk.hardware.realtime import Wanted, enter

    sys.setswitchinterval(_SWITCH_S)
    for answer in enter(Wanted(priority=_PRIORITY)):
        console.say(answer)


def record_wire(
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    address: Address,
    *,
    release: bool = False,
    overwrite: bool = False,
    timing: Timing | None = None,
    fresh: Freshness | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recorded:
    """Ask a robot over a wire, all joints over one connection.

    Args:
        robot: The robot.
        plan: What to ask; checked by the caller.
        out_dir: Folder for the logs.
        address: Where it is.
        release: Make its own controller let go of the joints first.
        overwrite: Replace logs that are already there.
        timing: Of the servo; the usual if None.
        fresh: How fresh states must be at first; the usual if None.
        progress: Told the share done, 0 to 1.

    Raises:
        HardwareError: The robot may not be moved or breached a limit; the joints are damped, and
            what was recorded until then stays.
    """
    from pronk.sweep.record import record
    from pronk.sweep.servo import Servo

    machine = address.machine(robot, hand=confirm.Person(), release=release, fresh=fresh)
    servo = Servo(timing)
    begun = time.time()
    try:
        with _ending_is_an_interrupt():
            logs = record(
                machine,
                robot,
                plan,
                out_dir,
                progress=None if progress is None else lambda share, _: progress(share),
                overwrite=overwrite,
                servo=servo,
                metadata={"link": str(address), "servo_rate_hz": f"{servo.timing.rate_hz:g}"},
            )
    except BaseException:
        _say_what_is_kept(out_dir, begun)
        raise
    return Recorded(logs=logs, virtual=machine.virtual, servo=servo.figures())


def tell(recorded: Recorded, out_dir: Path) -> None:
    """What was written, and how punctual the servo was."""
    late: dict[str, Any] = recorded.servo
    console.say(f"wrote {len(recorded.logs)} logs of {recorded.words} to {out_dir}")
    console.say(
        f"servo: {late['n']} ticks, late by {late['p50_ms']:.2f} ms (median), "
        f"{late['p99_ms']:.2f} ms (99 %), {late['max_ms']:.1f} ms at most; {late['missed']} missed"
    )


def _say_what_is_kept(out_dir: Path, since: float) -> None:
    """One line on the logs written since then; the last one is that which was cut short."""
    kept = sorted((path.stat().st_mtime, path) for path in out_dir.glob("*.mcap"))
    paths = [path for written, path in kept if written >= since]
    if paths:
        whole = f"{', '.join(path.stem for path in paths[:-1])} whole, and " if paths[1:] else ""
        console.warn(
            f"ended early; in {out_dir} are kept {whole}what was recorded until then of "
            f"{paths[-1].stem}; ask the others with --joints"
        )


@contextmanager
def _ending_is_an_interrupt() -> Iterator[None]:
    """Whoever ends the program ends the sweep as the interrupt key does: damped."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:
        # Not the main thread: whoever runs this has signals of their own.
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def refuse_without_wire(**options: object) -> None:
    """See that nothing of a wire was given without one.

    Raises:
        HardwareError: Names what was.
    """
    given = [f"--{name}" for name, value in options.items() if value]
    if given:
        raise HardwareError(f"{', '.join(given)}: of --link lcm or dds; the twin has no wire.")
