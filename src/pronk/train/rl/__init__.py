"""Networks, PPO with the estimator, symmetry, the runner, and export."""
