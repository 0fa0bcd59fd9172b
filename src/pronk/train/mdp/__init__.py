"""What is simulated, told, seen, drawn and paid: the environment that a policy is trained in."""
