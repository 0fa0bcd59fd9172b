"""`pronk predict`: replay a log that the fit never saw."""
