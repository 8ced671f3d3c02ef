"""Places of submaps, and pairs of them that may be the same."""

from __future__ import annotations

from dataclasses import dataclass

from subiaco_geo.frames import Floats
from subiaco_mapping.loop_closure.submaps import Submap


@dataclass(frozen=True)
class SubmapPlace:
    """A submap where the graph has it.

    Parameters
    ----------
    key : tuple of int
        Chain, and number of the submap in it.
    submap : Submap
    R_level_lidar : (3, 3) float64
        To axes x ahead, z up.
    pose : (4, 4) float64 or None
        ``T_world_lidar`` of its anchor; None while its chain is not placed.
    covariance : (6, 6) float64
        Of that pose, world axes.
    """

    key: tuple[int, int]
    submap: Submap
    R_level_lidar: Floats
    pose: Floats | None
    covariance: Floats

    @property
    def scan(self) -> tuple[int, int]:
        """Chain and scan of the anchor."""
        return self.key[0], self.submap.anchor


@dataclass(frozen=True)
class LoopCandidate:
    """Two places that may be one; the guess is None where only descriptors say so."""

    first: SubmapPlace
    second: SubmapPlace
    guess: Floats | None
    yaw: float = 0.0
