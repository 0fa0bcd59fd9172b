"""A sweep of a machine whose clock waits: the virtual robot in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.sweep import SweepController, SweepTask
from pronk.deploy.runtime.sweep_logs import SweepLogs
from pronk.errors import HardwareError
from pronk.identify.logs.sweep_writer import reason_of
from pronk.robots.machine import Machine


def record_sweep(
    machine: Machine, task: SweepTask, progress: Callable[[float], None] | None = None
) -> list[Path]:
    """Carry out a sweep; the link is opened here and closed again.

    Args:
        machine: A machine that is not connected yet.
        task: What is excited, and where the logs go.
        progress: Called with the share done about twice a second of machine time.

    Returns:
        The logs, in order.

    Raises:
        PronkError: As of `SweepTask.check`; or no states come, or the filter stopped the sweep. The
            joints are then damped, and the log up to then is readable and has the reason.
    """
    if machine.robot != task.plan.robot.name:
        raise HardwareError(
            f"the machine is {machine.robot!r} and the plan is for {task.plan.robot.name!r}; both "
            "must be the same."
        )
    task.check()
    machine.connect()
    try:
        states = [machine.latest()]
        limits = task.limits(machine.torque_kind)
        safety = SafetyFilter(limits=limits, state_rate_hz=machine.state_rate_hz)
        controller = SweepController(
            task,
            machine,
            limits,
            SweepLogs(task).write,
            state=states[0],
            start=states[0].time,
            real_time=False,
        )
        reported = controller.progress
        try:
            while True:
                t = machine.now()
                command = controller.command(t, states, slack=np.inf)
                if progress is not None and controller.progress != reported:
                    reported = controller.progress
                    progress(reported)
                if command is None:
                    break
                sent, decision = safety.judge(states, command, t, limits=controller.limits)
                if sent is None:
                    raise HardwareError(f"{decision.text}; the joints were damped.")
                machine.send(sent)
                controller.sent(t, sent.position)
                states = machine.wait(controller.now)
                if not states:
                    raise HardwareError(
                        f"{machine.robot} sent no state between {t:.3f} and {controller.now:.3f} "
                        "s; check the link and that the machine's program runs."
                    )
        except BaseException as error:
            # Damp before the file is finished: the joints come first.
            machine.damp()
            controller.end(reason_of(error))
            raise
    finally:
        # In every case, the interrupt key included, the joints are damped.
        machine.damp()
        machine.close()
    return task.paths
