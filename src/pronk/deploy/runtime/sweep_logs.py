"""Logs of a sweep: one MCAP file for each excited joint, written from the servo's records."""

from __future__ import annotations

from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.records import Record, SampleKind
from pronk.deploy.runtime.sweep import SweepTask
from pronk.identify.logs.segment import Segment
from pronk.identify.logs.sweep_writer import LogHeader, McapLogWriter


class SweepLogs:
    """Writes the logs of a task from its records (`sample_dtype`)."""

    def __init__(self, task: SweepTask) -> None:
        """Begin without an open log."""
        self.task = task
        self._writer: McapLogWriter | None = None
        self._joint = ""
        """Joint that is excited in the open log."""
        self._columns: list[int] = []
        """Joints of the open log, by their number in the robot."""
        self._has_torque = True

    def drain(self, shared: Shared) -> None:
        """Write everything that waits; events are not logged."""
        for record in shared.samples.take():
            self.write(record)
        shared.events.take()

    def write(self, record: Record) -> None:
        """Write one record."""
        sample_kind = int(record["kind"])
        number = int(record["number"])
        time = float(record["time"])
        text = bytes(record["text"]).decode("ascii")
        writer = self._writer
        if sample_kind == SampleKind.OPEN:
            self._open(number, virtual=bool(record["virtual"]), torque_kind=text)
        elif writer is None:
            return
        elif sample_kind == SampleKind.SEGMENT:
            writer.segment(self._segment(number, time))
        elif sample_kind == SampleKind.END:
            self.end(text)
        else:
            columns = self._columns
            torque = record["torque"][columns] if self._has_torque else None
            writer.sample(
                time,
                record["command"][columns],
                record["position"][columns],
                record["velocity"][columns],
                torque,
                float(record["frequency"]),
                number,
            )

    def _open(self, index: int, *, virtual: bool, torque_kind: str) -> None:
        """Begin the log of the excited joint of this number in the task."""
        plan = self.task.plan
        self._joint = self.task.excited[index]
        self._has_torque = torque_kind != "absent"
        # Joints that can move with the excited one or are clamped: its leg.
        joint = plan.robot.joint(self._joint)
        logged = {joint.name, *joint.chain, *joint.clamped}
        names = []
        columns = []
        for column, name in enumerate(plan.robot.joint_names):
            if name in logged:
                names.append(name)
                columns.append(column)
        self._columns = columns
        metadata = {
            "command_rate_hz": f"{plan.rate_hz:g}",
            "excited": self._joint,
            "torque": torque_kind,
        }
        metadata.update(self.task.metadata)
        header = LogHeader(
            robot=plan.robot.name,
            joints=tuple(names),
            stiffness=plan.stiffness[columns].tolist(),
            damping=plan.damping[columns].tolist(),
            pose=plan.pose[columns].tolist(),
            units=("rad",) * len(names),
            virtual=virtual,
            metadata=metadata,
        )
        self._writer = McapLogWriter(self.task.paths[index], header)

    def _segment(self, number: int, start: float) -> Segment:
        """Return an excitation of the open log; `start` on the machine's clock [s]."""
        plan = self.task.plan
        excitation = self.task.excitations(self._joint)[number]
        signal = excitation.signal
        return Segment(
            kind=signal.kind,
            joints=(excitation.joint,),
            start=start,
            stop=start + plan.seconds(excitation) - 1.0 / plan.rate_hz / 2.0,
            amplitude=signal.amplitude,
            repeat=excitation.repeat,
            band_hz=signal.band_hz,
            period_s=signal.period_s,
            clamped=excitation.clamped,
        )

    def end(self, reason: str) -> None:
        """End the log, complete if there is no reason; ending twice has no effect."""
        if self._writer is not None:
            self._writer.end(complete=not reason, reason=reason)
            self._writer = None

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        if self._writer is not None:
            self._writer.flush()
