"""pronk: from a chirp to matched gains to a jump.

The way of the data is one direction: sweep, response, match, train, trial, deploy. Each arrow is
a file; each room of the package makes one of them.
"""

__version__ = "0.1.0"
