"""The virtual robot: a machine that differs from the training model, with hidden parameters."""
