"""Matched gains as configuration of a simulator, as text to read and to paste.

`targets` has the table of targets and `export`, the public function; `actuators` is what is
exported. Each family of targets has a module: `python_config`, `newton_usd`, `mjcf`.
"""
