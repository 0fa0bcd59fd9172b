"""Physics of the DC motor and gearbox that drive a joint."""
