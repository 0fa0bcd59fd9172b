"""The mjlab task: from random weights to a policy that walks, runs and jumps on command."""
