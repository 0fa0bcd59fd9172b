"""Hooks of the documentation site: equations become MathML, which browsers show by themselves."""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert

CODE = re.compile(r"(```.*?```|`[^`\n]*`)", flags=re.DOTALL)
"""Code blocks and code spans, in which a dollar sign is a dollar sign."""
BLOCK = re.compile(r"\$\$(.+?)\$\$", flags=re.DOTALL)
INLINE = re.compile(r"\$([^$\n]+)\$")


def block_equation(found: re.Match[str]) -> str:
    """Return the MathML of an equation on its own line."""
    return f'<div class="equation">{convert(found.group(1).strip(), display="block")}</div>'


def inline_equation(found: re.Match[str]) -> str:
    """Return the MathML of an equation within a sentence."""
    # Within a span, since Markdown takes a line that begins with another tag for a block.
    return f"<span>{convert(found.group(1))}</span>"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the equations of a page."""
    parts = CODE.split(markdown)
    for index in range(0, len(parts), 2):
        parts[index] = BLOCK.sub(block_equation, parts[index])
        parts[index] = INLINE.sub(inline_equation, parts[index])
    return "".join(parts)
