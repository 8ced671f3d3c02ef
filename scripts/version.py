"""The version of the project. Without argument: print it. ``python scripts/version.py 1.2.3``: set it.

The one place is ``__version__`` of ``subiaco_geo``. ROS tools read it from ``package.xml``, where nothing can
be computed, so that this script writes it there too. ``setup.py`` reads it from ``package.xml``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLACE = ROOT / "src/subiaco_geo/subiaco_geo/__init__.py"
_HERE = re.compile(r'(?<=^__version__ = ")[^"]+', re.MULTILINE)
_THERE = re.compile(r"(?<=<version>)[^<]+")


def version() -> str:
    """Return the version that ``subiaco_geo`` states."""
    return _HERE.findall(PLACE.read_text(encoding="utf-8"))[0]


def set_version(number: str) -> None:
    """Write a version into the one place and into every package manifest."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", number):
        sys.exit(f"{number}: not a version such as 1.2.3")
    PLACE.write_text(_HERE.sub(number, PLACE.read_text(encoding="utf-8")), encoding="utf-8")
    for manifest in sorted(ROOT.glob("src/subiaco*/package.xml")):
        text = manifest.read_text(encoding="utf-8")
        manifest.write_text(_THERE.sub(number, text, count=1), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        set_version(sys.argv[1])
    print(version())
