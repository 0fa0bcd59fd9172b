"""Joints of a robot in other engines: SAPIEN (PhysX), Drake, PyBullet; each has an extra of pronk.

Modules import their engine when a simulator is made. They need NumPy and the engine only, so that
they also run in another Python.
"""
