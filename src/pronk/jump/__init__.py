"""The jump task of a quadruped: training, the virtual robot, trials."""
