"""Mistakes in the two surveys of a run: swapped, equal, mixed, mislabelled; each becomes a finding."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from subiaco_change.records import Registration
from subiaco_geo.config import StrictModel
from subiaco_geo.crs_area import outside
from subiaco_geo.datum_shifts import likely_shift
from subiaco_geo.errors import InputError
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.maps import cloud_of
from subiaco_geo.sources import Epoch
from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
from subiaco_geo.trajectories import Trajectory

_DAY_NS = 86_400_000_000_000
_DATED_NS = int(np.datetime64("2000-01-01", "ns").astype(np.int64))
_YEAR_NS = 365.25 * _DAY_NS
_EPOCH_YEAR = 1970.0


class InputCheckConfig(StrictModel):
    """Limits beyond which a property of the two surveys is a finding; no label depends on them."""

    pause_days: float = Field(
        2.0,
        gt=0,
        description="Longest pause between two drives of one survey before a finding is reported [days]. "
        "Raise it for a survey that took several weeks",
    )
    other_epoch_days: float = Field(
        30.0,
        gt=0,
        description="Pause between two drives of one survey from which the finding is serious [days]. "
        "Raise it for a survey that took several months",
    )
    shift_sigmas: float = Field(
        3.0,
        gt=0,
        description="Registration shift that is reported, as a multiple of the standard deviation that "
        "the surveys state. Raise it where stated uncertainties are too small",
    )
    least_shift: float = Field(
        0.1,
        ge=0,
        description="Smallest registration shift that is reported where both surveys state the "
        "uncertainty of their poses [m]",
    )
    least_shift_unstated: float = Field(
        0.5,
        ge=0,
        description="Smallest registration shift that is reported where a survey states no pose "
        "uncertainty [m]. Raise it for surveys without RTK",
    )
    datum_tolerance: float = Field(
        0.15,
        gt=0,
        description="Largest difference between the registration shift and a known shift between geodetic "
        "frames at which the frames are named [m]",
    )


@dataclass(frozen=True)
class SurveyFacts:
    """What the checks need of a survey: ``crs``, a ``place`` (3,) in it [m], scans, stated covariances."""

    crs: str | None
    place: Floats
    trajectory: Trajectory | None
    uncertainty: PoseUncertainty | None

    @property
    def times_ns(self) -> Ints:
        """UTC times of the scans in order; empty where the survey has none."""
        if self.trajectory is None or len(self.trajectory) == 0:
            return np.zeros(0, dtype=np.int64)
        times = np.sort(self.trajectory.times_ns)
        return times if times[0] >= _DATED_NS else times[:0]  # else seconds since the start of a recording

    @property
    def year(self) -> float | None:
        """Decimal year of the middle scan."""
        times = self.times_ns
        return None if len(times) == 0 else _EPOCH_YEAR + float(times[len(times) // 2]) / _YEAR_NS


def facts_of(epoch: SurveyMap | Epoch) -> SurveyFacts:
    """Return the facts of an epoch in files or in memory."""
    origin = epoch.cloud.origin if isinstance(epoch, SurveyMap) else epoch.origin
    return SurveyFacts(epoch.crs, np.asarray(origin, dtype=np.float64), epoch.trajectory, epoch.uncertainty)


def check_surveys(
    paths: tuple[Path, Path], surveys: tuple[SurveyFacts, SurveyFacts], config: InputCheckConfig
) -> tuple[Finding, ...]:
    """Return what speaks against two surveys before anything is computed.

    Parameters
    ----------
    paths : (Path, Path)
        Map directories or clouds of *before* and *after*.
    surveys : (SurveyFacts, SurveyFacts)
    config : InputCheckConfig
    """
    found: list[Finding | None] = [_equal(*paths), _order(*surveys)]
    for name, survey in zip(("before", "after"), surveys, strict=True):
        found += [_mixed(name, survey, config), _misplaced(name, survey)]
    return tuple(finding for finding in found if finding is not None)


def _equal(before: Path, after: Path) -> Finding | None:
    """Compare the files of both clouds."""
    files = cloud_of(before), cloud_of(after)
    if files[0].stat().st_size != files[1].stat().st_size:
        return None
    if files[0].resolve() != files[1].resolve() and hash_path(files[0]) != hash_path(files[1]):
        return None
    return Finding(
        "same_survey",
        "serious",
        f"BEFORE ({before}) and AFTER ({after}) hold the same point cloud, so that no change can be found.",
        "Give the map of the other survey.",
    )


def _day(time_ns: int) -> str:
    return str(np.datetime64(int(time_ns), "ns"))[:10]


def _order(before: SurveyFacts, after: SurveyFacts) -> Finding | None:
    """Compare the times of two surveys."""
    old, new = before.times_ns, after.times_ns
    if len(old) == 0 or len(new) == 0:
        return None
    if old[0] > new[-1]:
        return Finding(
            "epochs_swapped",
            "serious",
            f"BEFORE was surveyed from {_day(old[0])} on, later than AFTER ({_day(new[-1])}): every Added is"
            " a Removed, and every Increased a Decreased.",
            "Exchange BEFORE and AFTER.",
        )
    if old[-1] >= new[0]:
        return Finding(
            "epochs_overlap_in_time",
            "warning",
            f"The two surveys overlap in time: BEFORE lasts until {_day(old[-1])}, AFTER begins on"
            f" {_day(new[0])}.",
            "Check that each map was made from the drives of one survey.",
        )
    return None


def _mixed(name: str, survey: SurveyFacts, config: InputCheckConfig) -> Finding | None:
    """Find the longest pause between two scans of a survey."""
    times = survey.times_ns
    if len(times) < 2:
        return None
    longest = int(np.argmax(np.diff(times)))
    days = float(times[longest + 1] - times[longest]) / _DAY_NS
    if days <= config.pause_days:
        return None
    return Finding(
        "epochs_mixed",
        "serious" if days > config.other_epoch_days else "warning",
        f"The map of {name} was fused from drives that lie {days:.0f} days apart ({_day(times[longest])} and"
        f" {_day(times[longest + 1])}; limit {config.pause_days:g} days): what changed between the drives is"
        " in the map twice or half.",
        "Map the drives of each survey by themselves.",
    )


def _misplaced(name: str, survey: SurveyFacts) -> Finding | None:
    """Compare the place of a survey with the area of use of its CRS."""
    if survey.crs is None:
        return None
    why = outside(survey.place, survey.crs)
    if why is None:
        return None
    return Finding(
        "crs_area",
        "serious",
        f"The coordinates of {name} (E {survey.place[0]:.0f}, N {survey.place[1]:.0f} in {survey.crs}),"
        f" {why}.",
        "Check the zone and the CRS of the file.",
    )


def check_shift(
    registration: Registration,
    surveys: tuple[SurveyFacts, SurveyFacts],
    unstated_pose: float,
    config: InputCheckConfig,
) -> tuple[Finding, ...]:
    """Compare the shift by a registration with what the surveys state of their own accuracy.

    Parameters
    ----------
    registration : Registration
        Found, not given.
    surveys : (SurveyFacts, SurveyFacts)
    unstated_pose : float
        Standard deviation of the positions of a survey that states none [m].
    config : InputCheckConfig
    """
    if any(survey.crs is None for survey in surveys):
        return ()
    shift = registration.T_local[:3, 3]
    size = float(np.linalg.norm(shift))
    stated = [_stated_sigma(survey) for survey in surveys]
    known = all(sigma is not None for sigma in stated)
    assumed = math.sqrt(3.0) * unstated_pose
    own = float(np.linalg.norm(registration.pose_std[3:]))
    sigma = math.hypot(own, *(assumed if one is None else one for one in stated))
    least = config.least_shift if known else config.least_shift_unstated
    if size <= max(least, config.shift_sigmas * sigma):
        return ()
    crs = surveys[1].crs or ""
    frames = likely_shift(
        shift, registration.origin, crs, [survey.year for survey in surveys], config.datum_tolerance
    )
    east, north, up = shift.tolist()
    basis = "the surveys state" if known else "is assumed of surveys that state no uncertainty"
    sentence = (
        f"The registration moved BEFORE by {size:.2f} m (east {east:+.2f}, north {north:+.2f}, up {up:+.2f}"
        f" m), which is {size / sigma:.0f} times the standard deviation of {100 * sigma:.1f} cm that {basis}"
        f" (limit {config.shift_sigmas:g} times)."
    )
    if frames is None:
        remedy = "Check CRS, datum and base station of both surveys."
        return (Finding("registration_shift", "serious", sentence, remedy),)
    likely = (
        f" The shift equals that between {frames.before} (BEFORE) and {frames.after} (AFTER),"
        f" {frames.size:.2f} m: one survey is probably labelled with the wrong frame."
    )
    remedy = "Give the cloud its true CRS, or transform it, and run again."
    return (Finding("datum_mismatch", "serious", sentence + likely, remedy),)


def _stated_sigma(survey: SurveyFacts) -> float | None:
    """Median standard deviation of the positions of a survey, of the three axes together [m]."""
    found = survey.uncertainty
    if found is None or len(found.covariances) == 0:
        return None
    return float(np.sqrt(np.median(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))))


def unstated_findings(
    surveys: Sequence[SurveyFacts], unstated_pose: float, *, used: bool
) -> tuple[Finding, ...]:
    """Say which surveys state no uncertainty of their poses, and what was assumed instead."""
    names = [
        name
        for name, survey in zip(("before", "after"), surveys, strict=True)
        if survey.uncertainty is None or len(survey.uncertainty.covariances) == 0
    ]
    if not names or not used:
        return ()
    who = "Neither survey states" if len(names) == 2 else f"The survey {names[0]} does not state"
    return (
        Finding(
            "poses_unstated",
            "note",
            f"{who} the uncertainty of its poses. LoD95 assumes a standard deviation of at least"
            f" {100 * unstated_pose:g} cm for each survey that states none.",
            "Set placing.uncertainty.unstated_pose [m] to what is known of the survey.",
        ),
    )


def hash_path(path: Path) -> str:
    """Return the SHA-256 of a file, or of every file of a directory in name order.

    Raises
    ------
    InputError
        Nothing is there.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or directory; check the name")
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        if file != path:
            digest.update(file.relative_to(path).as_posix().encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
