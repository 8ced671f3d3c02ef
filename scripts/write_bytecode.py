"""Import every module of packages once, so that Python keeps the bytecode of all that they load.

Packages are installed without bytecode. Python writes it when a module is first imported, unless it may not:
in a container that runs as another user, or where PYTHONDONTWRITEBYTECODE is set. There every process, each
worker of a change run included, compiles about 3,000 modules again, for several seconds.

    python scripts/write_bytecode.py PACKAGE...
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from contextlib import suppress


def import_all(package: str) -> None:
    """Import a package and its modules; those whose own imports are not installed are left out."""
    for found in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        if not found.name.endswith(".__main__"):
            with suppress(ImportError):
                importlib.import_module(found.name)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("packages", nargs="+", metavar="PACKAGE")
    sys.dont_write_bytecode = False
    for package in parser.parse_args().packages:
        import_all(package)


if __name__ == "__main__":
    main()
