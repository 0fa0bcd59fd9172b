"""Places that the usual names of the legs of a quadruped say.

Training and checks read places from the model (`pronk.robots.legged`); where only the names of
joints are known, as on a page of matched gains, the names alone say them.
"""

from __future__ import annotations

FRONT_RIGHT = ("front", "right")
FRONT_LEFT = ("front", "left")
REAR_RIGHT = ("rear", "right")
REAR_LEFT = ("rear", "left")
PLACES = {
    "FR": FRONT_RIGHT,
    "RF": FRONT_RIGHT,
    "FL": FRONT_LEFT,
    "LF": FRONT_LEFT,
    "HR": REAR_RIGHT,
    "RH": REAR_RIGHT,
    "RR": REAR_RIGHT,
    "BR": REAR_RIGHT,
    "HL": REAR_LEFT,
    "LH": REAR_LEFT,
    "RL": REAR_LEFT,
    "BL": REAR_LEFT,
}
"""Places by the usual names of legs; other names say none, and need not."""
LEG_NAMES = (*PLACES, "fr", "fl", "hr", "hl", "rr", "rl")
"""Names of legs that joints begin with, as FR_knee. Small letters only where they are not also
used for hands: the joints of a right hand begin with rh."""
