"""pronk: excite a joint, estimate its frequency response, match a simulator to it.

    import pronk

    robot = pronk.load_robot("mini_cheetah")
    log = pronk.read_log("logs/FR_knee.mcap", robot=robot)
    response = pronk.response(log, "FR_knee")
    result = pronk.match([log], robot)
    replay = pronk.predict(pronk.read_log("fresh.mcap", robot=robot), robot, result.gains)

Names are imported when they are first used. `pronk.response` and `pronk.match` are packages that
can be called.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pronk.logs.readers import read_log, read_logs
    from pronk.match.predict import predict
    from pronk.policy.runtime import load_policy
    from pronk.robots import load_robot

__version__ = "0.1.0"
__all__ = ["load_policy", "load_robot", "match", "predict", "read_log", "read_logs", "response"]

_HOMES = {
    "load_policy": "pronk.policy.runtime",
    "load_robot": "pronk.robots",
    "match": "",
    "predict": "pronk.match.predict",
    "read_log": "pronk.logs.readers",
    "read_logs": "pronk.logs.readers",
    "response": "",
}


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` from the module that defines it."""
    if name not in _HOMES:
        raise AttributeError(f"module 'pronk' has no attribute {name!r}")
    home = _HOMES[name]
    return getattr(import_module(home), name) if home else import_module(f"pronk.{name}")
