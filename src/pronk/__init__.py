"""pronk: excite a joint, estimate its frequency response, match a simulator to it.

    import pronk

    robot = pronk.load_robot("mini_cheetah")
    log = pronk.read_log("logs/FR_knee.mcap", robot=robot)
    response = pronk.response(log, "FR_knee")
    result = pronk.match([log], robot)
    replay = pronk.predict(pronk.read_log("fresh.mcap", robot=robot), robot, result.gains)

Each name is imported from the module that defines it when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pronk.version import VERSION

if TYPE_CHECKING:
    from pronk.identify.logs.options import ReadOptions
    from pronk.identify.logs.readers import read_log, read_logs
    from pronk.identify.match.export.targets import export
    from pronk.identify.match.match import match
    from pronk.identify.match.predict import predict
    from pronk.identify.response.estimate import estimate_response as response
    from pronk.policy.runtime import load_policy
    from pronk.robots import load_robot

__version__ = VERSION
__all__ = [
    "ReadOptions",
    "export",
    "load_policy",
    "load_robot",
    "match",
    "predict",
    "read_log",
    "read_logs",
    "response",
]

_HOMES = {
    "ReadOptions": ("pronk.identify.logs.options", "ReadOptions"),
    "export": ("pronk.identify.match.export.targets", "export"),
    "load_policy": ("pronk.policy.runtime", "load_policy"),
    "load_robot": ("pronk.robots", "load_robot"),
    "match": ("pronk.identify.match.match", "match"),
    "predict": ("pronk.identify.match.predict", "predict"),
    "read_log": ("pronk.identify.logs.readers", "read_log"),
    "read_logs": ("pronk.identify.logs.readers", "read_logs"),
    "response": ("pronk.identify.response.estimate", "estimate_response"),
}
"""Module and name of each public function and class."""


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` from the module that defines it.

    Errors of functions name their parameters, where those of the command line name options.
    """
    if name not in _HOMES:
        raise AttributeError(f"module 'pronk' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(import_module(module), attribute)
    if isinstance(value, type):
        return value
    from pronk.python_words import with_python_words

    return with_python_words(value)
