"""GNSS holdout: fixes left out of the pose graph and compared with its solution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.map_quality.config import MapQualityConfig
from subiaco_mapping.pose_graph.gnss import enough_to_place
from subiaco_mapping.pose_graph.records import Chain, ChainSolution, GnssPriors
from subiaco_mapping.pose_graph.solver import solve
from subiaco_mapping.survey_graph.solution import GraphSolution

# chi-square, 3 degrees of freedom
_MEDIAN, _LIMIT_95, _CONTRADICTS = 2.366, 7.815, 16.27


@dataclass(frozen=True)
class FixErrors:
    """Antenna on a trajectory less the fix there.

    Parameters
    ----------
    sequence, status : (N,) int64
    times_ns : (N,) int64
    offset : (N, 3) float64
        East, north, up [m].
    covariance : (N, 3, 3) float64
        Stated for ``offset`` [m2].
    """

    sequence: Ints
    times_ns: Ints
    status: Ints
    offset: Floats
    covariance: Floats

    def __len__(self) -> int:
        return len(self.times_ns)

    def of_state(self, status: int) -> FixErrors:
        """Return those of one RTK state; higher numbers than 2 are fixed too."""
        rows = np.clip(self.status, 0, 2) == status
        return FixErrors(
            self.sequence[rows],
            self.times_ns[rows],
            self.status[rows],
            self.offset[rows],
            self.covariance[rows],
        )

    @property
    def sigma(self) -> Floats:
        """Stated standard deviations (N, 3) [m]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))

    @property
    def chi_square(self) -> Floats:
        """Squared errors (N,) over the stated covariance; 3 on average where that is right."""
        return np.asarray(np.einsum("ni,nij,nj->n", self.offset, np.linalg.inv(self.covariance), self.offset))

    def described(self) -> dict[str, float]:
        """Return errors [m], and how they compare with what was stated.

        RMSE are of the fixes that agree (chi-square within 99.9 %): one fix of multipath a metre off would
        hide the others. How many contradict is told beside, and ``error_over_sigma`` is that of all of
        them, by the median.
        """
        agree = self.chi_square <= _CONTRADICTS
        kept = self.offset[agree] if agree.any() else self.offset
        horizontal, up = np.linalg.norm(kept[:, :2], axis=1), kept[:, 2]
        whitened = kept / (self.sigma[agree] if agree.any() else self.sigma)
        return {
            "fixes": len(self),
            "contradicting": int((~agree).sum()),
            "share_contradicting": float((~agree).mean()),
            "horizontal_rmse_m": _rms(horizontal),
            "horizontal_median_m": float(np.median(horizontal)),
            "horizontal_p95_m": float(np.quantile(horizontal, 0.95)),
            "vertical_rmse_m": _rms(up),
            "vertical_p95_m": float(np.quantile(np.abs(up), 0.95)),
            "error_over_sigma": float(np.sqrt(np.median(self.chi_square) / _MEDIAN)),
            "error_over_sigma_horizontal": _rms(whitened[:, :2]),
            "error_over_sigma_vertical": _rms(whitened[:, 2]),
            "share_within_95": float((self.chi_square <= _LIMIT_95).mean()),
        }


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def fix_errors(
    fixes: Mapping[int, GnssPriors],
    chains: Mapping[int, ChainSolution],
    chosen: Mapping[int, Ints],
    *,
    independent: bool,
) -> FixErrors:
    """Compare fixes with solved chains.

    Parameters
    ----------
    fixes : mapping of int to GnssPriors
        By chain.
    chains : mapping of int to ChainSolution
    chosen : mapping of int to (M,) int64
        Fixes to compare.
    independent : bool
        The chains did not use them: what is stated is the covariance of fix and antenna together. Of a fix
        in use its own alone, of which the solution takes something away.
    """
    parts = [
        _errors_of(number, fixes[number], chains[number], rows, independent)
        for number, rows in chosen.items()
    ]
    if not parts:
        nothing = np.zeros(0, dtype=np.int64)
        return FixErrors(nothing, nothing, nothing, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return FixErrors(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("sequence", "times_ns", "status", "offset", "covariance")
        )
    )


def _errors_of(
    number: int, fixes: GnssPriors, solved: ChainSolution, rows: Ints, independent: bool
) -> FixErrors:
    scan = fixes.index[rows]
    poses, covariance = solved.T_world_lidar[scan], solved.covariance[scan]
    lever = np.einsum("nij,nj->ni", poses[:, :3, :3], fixes.levers[rows])
    act = np.zeros((len(rows), 3, 6))  # of a pose's error, world axes, on the antenna
    act[:, :, 3:] = np.eye(3)
    act[:, 0, 1], act[:, 0, 2] = lever[:, 2], -lever[:, 1]
    act[:, 1, 0], act[:, 1, 2] = -lever[:, 2], lever[:, 0]
    act[:, 2, 0], act[:, 2, 1] = lever[:, 1], -lever[:, 0]
    own = act @ covariance @ np.swapaxes(act, 1, 2) if independent else 0.0
    return FixErrors(
        sequence=np.full(len(rows), number, dtype=np.int64),
        times_ns=fixes.times_ns[rows],
        status=fixes.status[rows],
        offset=lever + poses[:, :3, 3] - fixes.enu[rows],
        covariance=own + fixes.covariance[rows],
    )


def holdout_rows(times_ns: Ints, config: MapQualityConfig) -> NDArray[np.bool_]:
    """Mark the fixes (N,) in time order that are held out; nothing of a drive shorter than three blocks."""
    if len(times_ns) == 0:
        return np.zeros(0, dtype=np.bool_)
    block = (times_ns - times_ns[0]) // config.holdout_block_ns
    count = int(block[-1]) + 1
    if count < 3:
        return np.zeros(len(times_ns), dtype=np.bool_)
    return np.asarray(block % config.holdout_every == min(config.holdout_every // 2, count // 2))


def _keep(fixes: GnssPriors, rows: NDArray[np.bool_]) -> GnssPriors:
    return GnssPriors(
        fixes.index[rows],
        fixes.times_ns[rows],
        fixes.enu[rows],
        fixes.levers[rows],
        fixes.covariance[rows],
        fixes.status[rows],
    )


def holdout_check(solution: GraphSolution, config: MappingConfig) -> FixErrors | str:
    """Solve once more without a share of the fixes, and compare those of RTK fixed with the solution.

    Everything else stays: odometry, gravity, loops, headings, the placement that the solver starts from.

    Returns
    -------
    FixErrors or str
        The reason, where nothing can be withheld.
    """
    graph = solution.graph
    if not config.quality.holdout:
        return "switched off (quality.holdout)"
    if graph is None or solution.frame is None:
        return "no GNSS places this map"
    chains: dict[int, Chain] = dict(graph.chains)
    chosen: dict[int, Ints] = {}
    fixes = {number: chain.gnss for number, chain in chains.items() if chain.gnss is not None}
    for number, own in fixes.items():
        out = holdout_rows(own.times_ns, config.quality)
        compared = np.flatnonzero(out & (own.status >= 2))
        left = _keep(own, ~out)
        if len(compared) and enough_to_place(left.enu, config.gnss) is None:
            chosen[number] = compared
            chains[number] = replace(chains[number], gnss=left)
    if not chosen:
        return "the drives are too short, or have too few RTK fixes, to withhold any"
    try:
        solved = solve(chains, config.graph, config.gnss, graph.loops)
    except SubiacoError as error:
        return f"without them the graph has no solution ({error})"
    return fix_errors(fixes, solved.chains, chosen, independent=True)
