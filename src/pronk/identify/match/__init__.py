"""Find the gains with which a simulated joint responds as the measured one.

Start at `match.match`. A match measures responses (`measured`), fits the drive of each joint in
time (`drive_fit`) or by magnitude (`magnitude`), compares measured and simulated responses
(`compared`), and puts gains, intervals and flags into a `result`. `gains` is the file that
training reads.
"""
