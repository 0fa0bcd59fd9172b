"""Sweeps and policies on a robot, through the safety filter."""
