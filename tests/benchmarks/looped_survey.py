"""A survey of more than a kilometre for the trajectory benchmark: two drives of one epoch, two laps each.

The block of preset ``default`` is driven round twice, then an hour later twice the other way round: loops
within a sequence, reverse driving between sequences. Both pull away from rest and stop at lights once.
512x10, OS1-128 by default.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from subiaco_geo.atomic import whole_directory
from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import FaultConfig, GnssConfig, LidarMode, SimulationConfig
from subiaco_sim.drives import START_NS, Survey, lidar_of, plan_survey, scans_of
from subiaco_sim.gnss import FIXED, FLOAT, NONE, GnssSeries, simulate_gnss
from subiaco_sim.motion import drive, travelled
from subiaco_sim.presets import find_preset
from subiaco_sim.survey import _record

HOUR_NS = 3600 * 10**9
NAMES = ("there", "back")
#: A stop at lights: braking, standing, away again [s since the start].
LIGHTS_S = (60.0, 64.0, 72.0, 77.0)


def stopping(seconds: Floats, speed: float, phase: float) -> Floats:
    """Return the distance driven with a stop at lights; see :func:`subiaco_sim.motion.travelled`."""
    way = travelled(seconds, speed, phase)
    share = np.interp(seconds, LIGHTS_S, [0.0, 1.0, 1.0, 0.0])
    share = 1.0 - share * share * (3.0 - 2.0 * share)  # no jerk where braking begins and ends
    return np.asarray(np.append(0.0, np.cumsum(0.5 * (share[1:] + share[:-1]) * np.diff(way))))


def looped_surveys(
    seed: int, duration: float = 100.0, mode: LidarMode = LidarMode.COLUMNS_512, beams: int = 128
) -> dict[str, Survey]:
    """Return both drives, each as the epoch *before* of a survey of its own."""
    config = SimulationConfig(
        preset="default", seed=seed, mode=mode, beams_before=beams, beams_after=beams, ground_cell=0.6
    )
    survey = plan_survey(config)
    scene, first = survey.scene, survey.drives["before"]
    laps = np.tile(scene.route, (3, 1))
    found = {}
    for number, name in enumerate(NAMES):
        with patch("subiaco_sim.motion.travelled", stopping):
            motion = drive(
                laps,
                scene.terrain_at("before"),
                START_NS["before"] + number * HOUR_NS,
                duration,
                find_preset("default").speed,
                reverse=number == 1,
                seed=2 * seed + number,
                place=0.1 + 0.3 * number,
            )
        own = replace(first, number=number, motion=motion, scans=int(duration * 10))
        found[name] = replace(survey, drives={"before": own})
    return found


def record_surveys(folder: Path, surveys: dict[str, Survey]) -> dict[str, Path]:
    """Record the bags that are not there yet."""
    bags = {}
    for name, survey in surveys.items():
        own = survey.drives["before"]
        bags[name] = folder / name
        if not bags[name].exists():
            with whole_directory(bags[name], overwrite=False, marker="bag") as inside:
                _record(inside / "bag", survey, own, scans_of(survey, own, lidar_of(survey, own)))
    return bags


def fixes_of(survey: Survey, kind: str) -> GnssSeries:
    """Return the fixes of a drive: ``rtk``, ``outage``, ``float``, ``multipath`` or ``none``.

    30 s without a fix, 60 s of float, a tenth of the drive off by 1.5 m in stretches of 4 s that claim
    RTK fixed, or never a fix; RTK fixed elsewhere.
    """
    own, config = survey.drives["before"], survey.config
    length = own.motion.duration
    state, begin, span = {
        "outage": (NONE, 0.4 * length, 30.0),
        "float": (FLOAT, 0.2 * length, 60.0),
        "none": (NONE, 0.0, length),
    }.get(kind, (FIXED, 0.0, 0.0))

    def states(count: int, gnss: GnssConfig) -> Ints:
        seconds = np.arange(count) / gnss.rate
        return np.where((seconds >= begin) & (seconds < begin + span), state, FIXED).astype(np.int64)

    faults = FaultConfig(multipath=round(0.1 * length / 4.0) if kind == "multipath" else 0)
    with patch("subiaco_sim.gnss.states", states):
        return simulate_gnss(own.motion, config.gnss, own.rng(config.seed, 3), faults)
