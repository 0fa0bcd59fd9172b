"""The network and its contract, for training's export, trials and deployment."""
