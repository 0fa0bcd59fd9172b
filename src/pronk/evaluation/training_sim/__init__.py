"""How good a policy is: a thousand robots a command in the training simulator."""
