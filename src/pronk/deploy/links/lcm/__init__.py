"""Low-level messages over LCM, and the virtual robot behind them."""
