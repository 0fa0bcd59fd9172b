"""A recorded arm whose joints all moved at once, matched as a whole and in time.

Responses of single joints would be mixed up with each other there, so the whole arm is simulated
with the recorded commands. In order: `simulation` (the arm, many parameter sets at once), `trust`
(which samples the drives could follow), `problem`
(residuals and what they tell apart), `fit` (the drives of the arm), `match` (the same as gains).
"""
