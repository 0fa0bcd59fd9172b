"""A program that flies the virtual robot by a script, to be started in front of a terminal.

Run as `python deploy_alone.py POLICY LOG`. The words it says are the names of the servo's modes; it
ends with 130 if it was interrupted.
"""

from __future__ import annotations

import sys
from pathlib import Path

from deploy_runs import PATIENT, QUICK
from pronk.deploy.links.address import Address
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.records import Event
from pronk.deploy.runtime.run import run_plan
from pronk.deploy.runtime.teleop import ScriptedOperator
from pronk.policy.script import Script


def tell(notice: Event) -> None:
    sys.stdout.write((notice.text if notice.kind == "mode" else notice.kind) + "\n")
    sys.stdout.flush()


def main() -> int:
    plan = RunPlan(
        link=Link(robot="mini_cheetah", address=Address.parse("sim://bench")),
        policy=Path(sys.argv[1]),
        log=Path(sys.argv[2]),
        timing=QUICK,
        ages=PATIENT,
        action_valid_s=2.0,
        ignore_latency=True,
    )
    summary = run_plan(plan, ScriptedOperator([Script(command=(0.5, 0.0, 0.0), run_s=60.0)]), tell)
    return 130 if summary.interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
