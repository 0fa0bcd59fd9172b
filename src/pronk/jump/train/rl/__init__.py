"""Networks, PPO with the estimator, symmetry, the runner, and export."""

import mjlab  # noqa: F401
