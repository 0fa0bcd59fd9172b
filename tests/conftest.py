"""Settings of all tests; the folders `slow` and `live` give their tests the marker.

With `-n` and `--dist loadscope` one process has all tests of a module, which share its fixtures.
Modules with slow tests come first, those of units last: none of them leaves the others idle at the
end. (`--dist loadgroup` of pytest-xdist 3.8 does not see its marks with pytest 9.2.)
"""

import signal
from pathlib import Path

import pytest
from hypothesis import settings

from pronk.garbage import collect_less_often, end_without_collection
from pronk.opengl import keep_opengl_out

collect_less_often()
keep_opengl_out()

# A slow example on a busy machine is not a defect.
settings.register_profile("pronk", deadline=None)
settings.load_profile("pronk")

# A process started in the background ignores these signals, and so would its children.
DEFAULT_HANDLERS = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGQUIT: signal.SIG_DFL,
    signal.SIGHUP: signal.SIG_DFL,
}
for number, handler in DEFAULT_HANDLERS.items():
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        folder = Path(item.path).parent.name
        if folder in ("slow", "live"):
            item.add_marker(folder)
    items.sort(key=_place)


def pytest_unconfigure() -> None:
    end_without_collection()


def _place(item: pytest.Item) -> int:
    """Return 0 for what takes longest, which at the end would leave the other processes idle."""
    if item.get_closest_marker("slow") is not None:
        return 0
    return 2 if Path(item.path).parent.name == "unit" else 1
