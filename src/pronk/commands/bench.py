"""`pronk bench`: pronk beside its peers."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import typer

from pronk.commands import console
