"""Simulators that match a joint: the protocol, MuJoCo on the CPU, MuJoCo Warp on the GPU."""
