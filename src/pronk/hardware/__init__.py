"""The boundary to a machine: one interface, and the virtual robot behind it.

Only the interface is imported here. Who wants the virtual robot says so: `pronk.hardware.virtual`
and `pronk.hardware.truth` are imported by name, so that nobody loads the truth by accident.
"""

from pronk.hardware.machine import Command, Machine, State

__all__ = ["Command", "Machine", "State"]
