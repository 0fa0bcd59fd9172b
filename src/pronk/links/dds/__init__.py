"""Unitree's low-level messages over DDS, and the virtual robot behind them."""
