"""How good a lift-off is along its command: candidate quantities of rewards, as pure functions.

A jump at speed is a throw of the trunk: with `vertical` and `along` m/s at lift-off it flies for
2 vertical / g and covers 2 vertical along / g. All tensors are (N,), one number for each robot.
"""

from __future__ import annotations

import torch
from torch import Tensor


def angle_kernel(
    along: Tensor, target: Tensor, vertical: Tensor, wanted: float, std: float
) -> Tensor:
    """Compare the direction of a lift-off with the one that its command asks for, 0 to 1.

    The angle above the horizontal is atan2(vertical, along), the one asked for atan2(wanted,
    target): upright for a jump on the spot, flatter the faster the command. A lift-off that is
    slower than asked for earns its share of the speed, so that a weak one in the right direction
    is no solution.

    Args:
        along: Horizontal velocity along the command at lift-off [m/s].
        target: The speed that is rewarded in jump mode [m/s].
        vertical: Vertical velocity at lift-off [m/s].
        wanted: Vertical velocity of the asked-for direction [m/s].
        std: Standard deviation of the kernel on the angle [rad].

    Returns:
        exp(-(angle - asked for)^2 / (2 std^2)) min(1, |v| / |asked for|).
    """
    wanted_vertical = torch.full_like(target, wanted)
    error = torch.atan2(vertical, along) - torch.atan2(wanted_vertical, target)
    share = torch.hypot(vertical, along) / torch.hypot(wanted_vertical, target)
    return torch.exp(error.square() * (-0.5 / std**2)) * share.clamp_max(1.0)


def forward_share(forward: Tensor, full_speed: float) -> Tensor:
    """Compute how much a command is one forwards, 0 (at rest, sideways, backwards) to 1.

    Args:
        forward: Commanded forward velocity, negative backwards [m/s].
        full_speed: Speed from which on the share is 1 [m/s].
    """
    return (forward / full_speed).clamp(0.0, 1.0)


def speed_share(forward: Tensor, full_speed: float, least: float) -> Tensor:
    """Compute the share of a reward that is left at a forward command, 1 to `least`.

    It falls linearly from 1 at rest to `least` at `full_speed`. Only speed forwards counts: the
    paper's matched robot jumps .32 and .24 m high at 1 and 2 m/s forwards, but .37 sideways and
    .38 m backwards (Table III).

    Args:
        forward: Commanded forward velocity, negative backwards [m/s]; its negative for a share
            that falls with the speed backwards.
        full_speed: Speed from which on the share is `least` [m/s].
        least: The smallest share, 0 to 1.
    """
    return 1.0 - (1.0 - least) * forward_share(forward, full_speed)
