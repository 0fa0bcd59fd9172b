"""Name how a simulator drives a joint, from the response of the joint alone."""
