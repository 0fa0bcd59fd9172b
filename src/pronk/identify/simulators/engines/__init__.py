"""Joints of a robot in other engines: SAPIEN (PhysX), Drake, PyBullet, MJX, Newton.

Modules import their engine when a simulator is made. They need NumPy and the engine only, so that
they also run in another Python.
"""
