"""The trial: a policy on a robot by the paper's script, measured from outside.

Modules: `protocol`, what is asked and when; `pilot`, which runs a policy on any machine; `metrics`,
the figures of one jump from what the cameras saw; `run`, many jumps in several processes; `result`,
trials.csv and summary.json; `walk` and `variation`, more that can be asked. Rooms: `terrain`, real
gaps and platforms; `unseen`, other bodies; `outcome`, the paper's table beside ours; `pictures`,
films; `live`, the robot in a web page.
"""
