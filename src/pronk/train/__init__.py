"""The mjlab task: from random weights to a policy that walks, runs and jumps on command."""

import os
from importlib.util import find_spec

if find_spec("mjlab") is not None:
    # mjlab loads the tasks of this package while it is itself imported. Were it imported first by
    # a module of this package, the tasks would meet that module half done.
    os.environ.setdefault("MJLAB_WARP_QUIET", "1")
    import mjlab  # noqa: F401
