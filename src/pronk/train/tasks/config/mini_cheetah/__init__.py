"""MIT Mini Cheetah, the robot of the paper."""
