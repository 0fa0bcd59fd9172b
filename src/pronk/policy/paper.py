"""Velocity commands of the paper's jumps (arXiv 2404.15096, Table III)."""

JUMPS: dict[str, tuple[float, float, float]] = {
    "forward 1": (1.0, 0.0, 0.0),
    "forward 2": (2.0, 0.0, 0.0),
    "side -1": (0.0, -1.0, 0.0),
    "side +1": (0.0, 1.0, 0.0),
    "back 2": (-2.0, 0.0, 0.0),
}
"""Forward, left [m/s], yaw rate [rad/s], in the trunk's frame, by name, in the table's order.
Positive sideways is to the left: the paper does not say, and its robot is symmetric."""
