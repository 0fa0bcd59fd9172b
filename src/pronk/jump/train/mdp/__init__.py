"""Terms of the training environment: commands, observations, events, rewards, terminations."""

import mjlab  # noqa: F401
