"""Films and stills of jumps."""
