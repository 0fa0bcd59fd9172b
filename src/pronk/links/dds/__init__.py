"""Unitree's low-level messages over DDS."""

from importlib.util import find_spec

from pronk.errors import HardwareError

if find_spec("cyclonedds") is None:
    raise HardwareError(
        "the DDS link needs the package cyclonedds, which is not installed; "
        "install it with: pip install 'pronk[hardware]'."
    )
