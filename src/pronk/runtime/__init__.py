"""The real-time loop: servo, safety filter, state machine, policy process and log."""

TILT = 0.8
"""Largest angle of the trunk's z axis from the vertical while a policy runs [rad]."""
BLEND_S = 0.4
"""Time in which a policy's targets replace the pose of standing [s]."""
