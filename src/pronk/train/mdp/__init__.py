"""Simulation, commands, observations, randomization and rewards of the training environment."""
