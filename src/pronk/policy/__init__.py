"""The network and its contract: one code for training's export, trial and deployment."""
