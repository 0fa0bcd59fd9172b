"""Films of a trial: a strip of stills, a GIF and an MP4 of each command.

`record.record_trial` makes them all, and `record.record_film` those of one capture. `film` plans
what each frame shows, without graphics; `render` is the process that draws it.
"""
