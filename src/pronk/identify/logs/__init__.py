"""JointLog: commanded and measured joint motion, its MCAP format, and readers of other formats."""
