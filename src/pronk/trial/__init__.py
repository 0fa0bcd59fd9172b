"""The trial: a policy on a robot by the paper's script, measured from outside.

Modules: `protocol`, what is asked and when; `pilot`, which runs a policy on any machine; `metrics`,
the figures of one jump from what the cameras saw; `run`, many jumps in several processes; `result`,
trials.csv and summary.json; `tables`, the paper's table beside ours.
"""
