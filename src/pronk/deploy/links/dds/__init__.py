"""Unitree's low-level messages over DDS."""
