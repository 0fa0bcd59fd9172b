"""Version of pronk, which artefacts and pages name."""

from __future__ import annotations

VERSION = "0.1.0"
