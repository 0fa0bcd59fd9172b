"""From a log and a simulator to gains: which, how certain, in which file."""
