"""The mjlab task: from random weights to a policy that walks, runs and jumps on command.

mjlab loads `tasks` while it is itself imported. Were it imported first by a module that the tasks
use, they would meet that module half done; so `mdp` and `rl` import it before any of theirs. The
modules beside them, with the options of `pronk train`, do not need mjlab.
"""

import os

os.environ.setdefault("MJLAB_WARP_QUIET", "1")
