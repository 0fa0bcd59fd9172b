"""Links to machines: states and commands over LCM and DDS."""
