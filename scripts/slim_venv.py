"""Take out of the virtual environment what no program of this repository loads.

Wheels carry their tests, sample data, copies where a link would do, and extras for other programs.
``make demo`` leaves them out; ``make setup`` keeps all but the import named first, and puts back what an
earlier ``make demo`` took out.

    python scripts/slim_venv.py           the import of Open3D's web viewer, whose packages are not installed
    python scripts/slim_venv.py --all     all of it
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import sys
import sysconfig
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

#: Below site-packages: what is taken out, and why nothing misses it.
UNUSED = {
    "*/tests": "tests of packages; numpy.testing and the like are elsewhere",
    "*/*/tests": "the same",
    "*/*/*/tests": "the same",
    "gtsam/Data": "sample data sets",
    "gtsam/examples": "examples",
    "gtsam_unstable": "factors that no graph here has",
    "open3d/resources": "fonts and materials of the desktop viewer",
    "open3d/examples": "examples",
    "open3d/labextension": "the notebook viewer",
    "open3d/nbextension": "the same",
    "open3d/open3d_tf_ops.so": "operators for TensorFlow",
    "open3d/open3d_torch_ops.so": "operators for PyTorch",
    "pyarrow/libarrow_flight.so*": "a network protocol",
    "pyarrow/_flight*.so": "the same",
    "pyarrow/libarrow_s3.so*": "a client for object storage: fsspec is used for that",
    "pyarrow/_s3fs*.so": "the same",
    "pyarrow/include": "headers",
    "numpy/*/lib/*.a": "libraries for compiling against numpy",
    "numpy/random/lib/*.a": "the same",
    "numba/cuda": "kernels for graphics processors; imported by name alone",
    "zstandard/_cffi*.so": "the back end for PyPy",
}
#: Below the root of the environment: what compiles C++ or C against ROS 2, and notebooks.
UNUSED_OF_ROS = {
    "share/jupyter": "the notebook viewer of Open3D",
    "share/*/cmake": "for CMake",
    "lib/cmake": "the same",
    "include/*": "headers; what is compiled later has them put back first",
}
VIEWER = re.compile(r"^from \.draw_plotly import .*\n", re.MULTILINE)
#: Smaller files gain too little to be worth a look [bytes].
WORTH = 1 << 18


def without_viewer(site: Path) -> None:
    """Let Open3D import without the packages of its web viewer, which it imports whether used or not."""
    file = site / "open3d/visualization/__init__.py"
    if file.is_file() and not (site / "dash").is_dir():
        file.write_text(VIEWER.sub("", file.read_text(encoding="utf-8")), encoding="utf-8")


def remove(root: Path, patterns: dict[str, str]) -> None:
    """Remove what matches."""
    for pattern in patterns:
        for path in sorted(root.glob(pattern)):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()


def libraries(root: Path) -> Iterator[Path]:
    """Yield the large shared libraries below a folder."""
    for path in sorted(root.rglob("*.so*")):
        if path.is_file() and not path.is_symlink() and path.stat().st_size >= WORTH:
            yield path


def link_copies(root: Path) -> None:
    """Make copies of a library hard links to one file: wheels cannot hold the symbolic links of a build."""
    sizes: dict[int, list[Path]] = defaultdict(list)
    for path in libraries(root):
        sizes[path.stat().st_size].append(path)
    for group in sizes.values():
        first: dict[bytes, Path] = {}
        for path in group if len(group) > 1 else ():
            with path.open("rb") as file:
                known = first.setdefault(hashlib.file_digest(file, "sha256").digest(), path)
            if known is not path:
                path.unlink()
                os.link(known, path)


def slim(root: Path, site: Path) -> None:
    """Take all of it out."""
    remove(site, UNUSED)
    remove(root, UNUSED_OF_ROS)
    link_copies(root / "lib")


def environment() -> tuple[Path, Path]:
    """Return the root of the virtual environment that runs this, and its site-packages."""
    root, site = Path(sys.prefix).resolve(), Path(sysconfig.get_paths()["purelib"]).resolve()
    # An interpreter started otherwise (python -S) takes the installation that it comes from for its own.
    if sys.prefix == sys.base_prefix or not (root / "pyvenv.cfg").is_file() or not site.is_relative_to(root):
        sys.exit(f"{root} is no virtual environment: nothing is touched")
    return root, site


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--all", action="store_true")
    everything = parser.parse_args().all
    root, site = environment()
    without_viewer(site)
    if everything:
        slim(root, site)


if __name__ == "__main__":
    main()
