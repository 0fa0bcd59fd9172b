"""The evaluation of a policy in the training simulator: many robots for each command."""
