"""A training run: what was asked, what it does, what it leaves, how it goes on."""
