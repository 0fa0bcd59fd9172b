"""A training run: settings, loop, files, resume."""
