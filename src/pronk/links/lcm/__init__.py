"""Low-level messages over LCM, and the virtual robot that speaks them."""
