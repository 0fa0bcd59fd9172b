"""What a deployment's log comes to, in sentences: the verdict above its page."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pronk.report.deploy.data import FLYING, missed, seconds, stretches
from pronk.report.deploy.delay import Delay
from pronk.report.deploy.traces import MODE_WORDS, jumps
from pronk.runtime.ipc import REAL, VIRTUAL
from pronk.runtime.log import DeployLog
from pronk.runtime.safety import FilterAction


def machine(log: DeployLog) -> str:
    """What robot it was, as far as the log says."""
    said = {event.text for event in log.events if event.kind == "robot"}
    name = log.header["robot"]
    if VIRTUAL in said:
        return f"virtual {name}"
    return f"real {name}" if REAL in said else f"{name} (the log does not say whether virtual)"


def doubtful(log: DeployLog, delay: Delay) -> bool:
    """Whether something is not as it should be: faults, refusals, a cut log, too long a delay."""
    bad = any(event.kind in ("fault", "refused") for event in log.events)
    return bad or not log.complete or delay.within is False


def says(log: DeployLog) -> str:
    """The verdict, one sentence."""
    flown = sum(one.seconds for one in stretches(log) if one.mode in FLYING)
    faults = [event for event in log.events if event.kind == "fault"]
    refused = [event for event in log.events if event.kind == "refused"]
    who = machine(log)
    head = f"{who[0].upper()}{who[1:]}"
    if faults:
        at = float(seconds(log, faults[0].time))
        after = f"after {flown:.1f} s of the policy" if flown else "before the policy decided"
        return f"{head}: a fault at {at:.2f} s, {after}: {faults[0].text}."
    if refused:
        return f"{head} was not moved: {refused[0].text}"
    if not flown:
        return f"{head}: no fault; the policy was never in charge."
    count = len(jumps(log))
    asked = f", {count} jump{'s' if count != 1 else ''} asked for" if count else ""
    return f"{head}: the policy decided for {flown:.1f} s{asked}, no fault."


def lines(log: DeployLog, delay: Delay) -> Iterator[str]:
    """What stands below the verdict."""
    events = [event for event in log.events if event.kind in ("fault", "refused")]
    for event in events[1:]:
        where = f"at {float(seconds(log, event.time)):.2f} s: " if event.kind == "fault" else ""
        yield f"Then {where}{event.text}{'' if event.text.endswith('.') else '.'}"
    if any(event.kind == "fault" for event in events):
        yield damping(log)
    yield (
        "Modes: "
        + ", ".join(f"{MODE_WORDS[one.mode]} {one.seconds:.1f} s" for one in stretches(log))
        + "."
    )
    yield filtering(log)
    yield delaying(delay)
    left_out = missed(log)
    if left_out:
        whole = len(log.tick) + left_out
        yield f"{left_out} of {whole} ticks were left out because their time had passed."
    dropped = sum(log.figures.get("servo", {}).get("dropped", {}).values())
    if dropped:
        yield f"{dropped} records found no room on their way to the log; figures here lack them."
    if not log.complete:
        why = f" ({log.damage})" if log.damage else ""
        yield f"The log was cut{why}: what came later is not in it."
    if log.virtual:
        yield "Every number here is of pronk's virtual robot, a simulated machine."


def damping(log: DeployLog) -> str:
    """What the servo did after the first fault."""
    bad = log.level >= FilterAction.DAMP
    if not bad.any():
        return "The log ends before a tick that was damped."
    first = int(bad.argmax())
    after = slice(first, None)
    share = float(np.mean(log.damped[after]))
    age = 1e3 * float(log.state_age[first])
    return (
        f"From that tick on, {log.damped[after].sum()} of {len(log.damped[after])} commands on the "
        f"wire were damping{'' if share == 1.0 else ': somebody mended the fault'}; the newest "
        f"state was {age:.1f} ms old then."
    )


def filtering(log: DeployLog) -> str:
    """How much the filter had to do."""
    wanted = np.isfinite(log.desired).any(axis=1)
    moved = int((wanted & np.isin(log.level, (FilterAction.LIMIT, FilterAction.HOLD))).sum())
    if not wanted.any():
        return "No target was asked of the safety filter."
    if not moved:
        return f"The safety filter let all {wanted.sum()} commands through as they were."
    return (
        f"The safety filter moved targets in {moved} of {wanted.sum()} commands "
        f"({100 * moved / wanted.sum():.1f} %)."
    )


def delaying(delay: Delay) -> str:
    """The measured delay beside what the policy was trained for."""
    if not delay.answer.n:
        return "No delay was measured: the policy was never in charge."
    low, high = (1e3 * bound for bound in delay.whole)
    if np.isfinite(delay.whole).all():
        found = f"From a state to the torque that answers it {low:.1f} to {high:.1f} ms"
    else:
        # Fewer than twenty answers have no 95 %.
        least = 1e3 * delay.answer.p50
        most = 1e3 * delay.longest
        upper = f", {most:.1f} ms (95 %)" if np.isfinite(most) else ""
        found = f"From a state to its command {least:.1f} ms (median){upper}, without the drives"
    if delay.trained is None:
        return f"{found}; the log does not say what delays the policy was trained for."
    trained = f"{1e3 * delay.trained[0]:g} to {1e3 * delay.trained[1]:g} ms"
    if delay.within is None:
        return f"{found}; the policy was trained for {trained}."
    where = "within" if delay.within else "BEYOND"
    return f"{found}: {where} the {trained} that the policy was trained for."
