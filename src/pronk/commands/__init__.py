"""The commands, one file each. `pronk.cli` registers them.

Rooms are imported inside the functions, so that `pronk --help` stays fast.
"""
