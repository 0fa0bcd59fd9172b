"""Copy the pictures of the README from a demo: knee.svg and jump.png in docs.

pronk demo --out out/demo
python scripts/docs_media.py out/demo
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"
PICTURES = {
    "hero.svg": "knee.svg",
    "trial/videos/matched_forward_2.png": "jump.png",
}
"""File of a demo, and its name in docs."""


def main() -> None:
    """Copy the pictures."""
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    for source, name in PICTURES.items():
        shutil.copyfile(Path(sys.argv[1]) / source, DOCS / name)
        print(DOCS / name)


if __name__ == "__main__":
    main()
