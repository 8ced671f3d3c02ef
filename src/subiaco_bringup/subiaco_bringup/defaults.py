"""Where the shipped configuration lies: the installed share, or the source tree."""

from __future__ import annotations

from pathlib import Path

from subiaco_geo.errors import SubiacoError

#: Files of each job, in the order in which they are read; later ones win.
CONFIG_FILES: dict[str, tuple[str, ...]] = {
    "simulation": ("simulation.yaml",),
    "mapping": ("mapping.yaml", "sensors.yaml"),
    "change": ("change.yaml",),
    "record": (),
}


def _candidate_directories() -> list[Path]:
    directories = [Path(__file__).resolve().parents[3] / "config"]
    try:
        from ament_index_python.packages import get_package_share_directory
    except ImportError:
        return directories
    try:
        share = Path(get_package_share_directory("subiaco_bringup"))
    except (LookupError, OSError):  # not installed, or no workspace sourced
        return directories
    return [share / "config", *directories]


def config_directory() -> Path:
    """Return the directory of the shipped configuration.

    Raises
    ------
    SubiacoError
        The installation is broken: neither share nor source tree holds it.
    """
    for directory in _candidate_directories():
        if (directory / "mapping.yaml").is_file():
            return directory
    raise SubiacoError("the shipped config/ was not found; rebuild the workspace with 'make setup'")


def dds_profile() -> Path | None:
    """Return the shipped DDS profile of one host, None where it was not installed."""
    profiles = (directory / "dds" / "loopback.xml" for directory in _candidate_directories())
    return next((profile for profile in profiles if profile.is_file()), None)


def config_files(job: str, extra: tuple[Path, ...] = ()) -> list[Path]:
    """Return the shipped files of a job followed by the user's."""
    return [*(config_directory() / name for name in CONFIG_FILES[job]), *extra]
