"""A policy on a machine: control loop, safety filter, start and stop."""
