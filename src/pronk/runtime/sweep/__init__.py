"""Recording of a sweep on a machine."""
