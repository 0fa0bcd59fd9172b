"""Find the parameters with which a simulated joint responds as the measured one does.

Start at `pipeline.match_frameworks`. In order: `measured_joint` (responses ready to be compared),
`simulated` (the same of the simulator), `grid` (the paper's search, whole or linearized),
`response_fit` (off the grid, and mode drive) or `arm` (joints that moved together), `result`,
`ranges` (what training randomizes), `gains`. The one list of parameters is `parameters`;
problems and solvers are in `fit`, confidence intervals in `uncertainty`.
"""

from pronk.identify.match.pipeline import match_logs
from pronk.identify.match.predict import predict
from pronk.identify.match.result import MatchResult
from pronk.identify.match.settings import MatchSettings

__all__ = ["MatchResult", "MatchSettings", "match_logs", "predict"]
