"""Comparison of two trajectories: absolute and relative errors, plots, a table."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from subiaco_geo.atomic import whole_directory
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.trajectory_errors import PoseErrors, StretchErrors, aligned, pose_errors, stretch_errors

LENGTHS = (1.0, 10.0, 100.0)  # of stretches [m]
_MARKER = "comparison.json"
_COLOURS = ("#0072b2", "#e69f00", "#009e73")


@dataclass(frozen=True)
class TrajectoryComparison:
    """An estimate against a reference.

    Parameters
    ----------
    estimate, reference : Trajectory
        The estimate as compared, moved where it was aligned.
    poses : PoseErrors
    stretches : tuple of StretchErrors
        Those lengths that the reference has.
    moved : (4, 4) float64 or None
        What aligned the estimate; None where errors are absolute.
    """

    estimate: Trajectory
    reference: Trajectory
    poses: PoseErrors
    stretches: tuple[StretchErrors, ...]
    moved: Floats | None

    def described(self) -> dict[str, Any]:
        """Return plain values: statistics of APE [m, deg] and of RPE by length [m, percent, deg]."""
        offset = self.poses.offset
        horizontal = np.linalg.norm(offset[:, :2], axis=1)
        return {
            "aligned": self.moved is not None,
            "T_reference_estimate": None if self.moved is None else self.moved.tolist(),
            "poses": len(offset),
            "seconds": float(np.ptp(self.poses.times_ns) * 1e-9),
            "ape": {
                "space_m": statistics(self.poses.distance),
                "horizontal_m": statistics(horizontal),
                "vertical_m": statistics(np.abs(offset[:, 2])),
                "rotation_deg": statistics(self.poses.angle_deg),
            },
            "mean_offset_m": offset.mean(axis=0).tolist(),
            "rpe": {
                f"{one.length:g} m": {
                    "translation_m": statistics(one.drift),
                    "translation_percent": statistics(100 * one.drift / one.travelled),
                    "rotation_deg": statistics(one.angle_deg),
                    "pairs": len(one.drift),
                }
                for one in self.stretches
            },
        }


def statistics(values: Floats) -> dict[str, float]:
    """Return RMSE, mean, median, 95 %, standard deviation and largest of values (N,)."""
    return {
        "rmse": float(np.sqrt(np.mean(values**2))),
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p95": float(np.quantile(values, 0.95)),
        "std": float(values.std()),
        "max": float(values.max()),
    }


def compare(
    estimate: Trajectory, reference: Trajectory, *, align: bool = False, lengths: Sequence[float] = LENGTHS
) -> TrajectoryComparison:
    """Compare a trajectory with a reference, both in one frame unless aligned.

    Parameters
    ----------
    estimate, reference : Trajectory
        The reference is interpolated to the times of the estimate.
    align : bool
        Move the estimate rigidly onto the reference first.
    lengths : sequence of float
        Stretches of the relative error [m]; those longer than the way are left out.

    Raises
    ------
    InputError
        They share no time; or, to be aligned, lie on one line.
    """
    moved = None
    if align:
        estimate, moved = aligned(estimate, reference)
    errors = pose_errors(estimate, reference)
    stretches = []
    for length in lengths:
        try:
            stretches.append(stretch_errors(estimate, reference, length))
        except InputError:  # the way is shorter
            continue
    return TrajectoryComparison(estimate, reference, errors, tuple(stretches), moved)


def table(described: dict[str, Any]) -> str:
    """Write the figures of a comparison for people."""
    first = "aligned rigidly" if described["aligned"] else "no alignment"
    east, north, up = described["mean_offset_m"]
    columns = ("rmse", "mean", "median", "p95", "std", "max")
    rows = [("APE " + name.replace("_", " ["), values) for name, values in described["ape"].items()]
    for length, found in described["rpe"].items():
        rows += [
            (f"RPE over {length} " + name.replace("_", " [").replace("percent", "%"), values)
            for name, values in found.items()
            if name != "pairs"
        ]
    lines = [
        f"{described['poses']} poses in {described['seconds']:.1f} s, {first}",
        f"mean offset: east {east:+.4f}, north {north:+.4f}, up {up:+.4f} m",
        "",
        f"{'':34}" + "".join(f"{name:>10}" for name in columns),
    ]
    lines += [f"{name + ']':34}" + "".join(f"{v[c]:>10.4f}" for c in columns) for name, v in rows]
    return "\n".join(lines) + "\n"


def write_comparison(directory: Path, found: TrajectoryComparison, *, overwrite: bool = False) -> None:
    """Write ``comparison.json``, ``comparison.txt``, ``ape.png`` and, where there are stretches, ``rpe.png``.

    Raises
    ------
    InputError
        The directory exists and may not be replaced.
    """
    described = found.described()
    with whole_directory(directory, overwrite=overwrite, marker=_MARKER) as out:
        (out / _MARKER).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
        (out / "comparison.txt").write_text(table(described), encoding="utf-8")
        (out / "ape.png").write_bytes(_png(_ape(found)))
        if found.stretches:
            (out / "rpe.png").write_bytes(_png(_rpe(found)))


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _ape(found: TrajectoryComparison) -> Figure:
    """Draw the way coloured by error, and the errors over time."""
    figure = Figure(figsize=(13.0, 6.0), dpi=100, facecolor="white", layout="constrained")
    grid = figure.add_gridspec(3, 2)
    plan = figure.add_subplot(grid[:, 0])
    inside = np.isin(found.estimate.times_ns, found.poses.times_ns)
    reference, positions = found.reference.positions, found.estimate.positions[inside]
    origin = np.floor(reference[:, :2].min(axis=0) / 100.0) * 100.0
    plan.plot(*(reference[:, :2] - origin).T, color="#8a8a8a", lw=1, ls="--", label="reference")
    marks = plan.scatter(*(positions[:, :2] - origin).T, c=found.poses.distance, s=6, linewidths=0)
    figure.colorbar(marks, ax=plan, label="absolute error [m]", shrink=0.8)
    plan.set_aspect("equal")
    plan.set_xlabel(f"east [m] from {origin[0]:.0f}")
    plan.set_ylabel(f"north [m] from {origin[1]:.0f}")
    plan.legend()
    seconds = (found.poses.times_ns - found.poses.times_ns[0]) * 1e-9
    rows = [
        (found.poses.distance[:, None], ("space",), "absolute error [m]"),
        (found.poses.offset, ("east", "north", "up"), "offset [m]"),
        (found.poses.angle_deg[:, None], ("rotation",), "rotation [deg]"),
    ]
    for k, (values, names, label) in enumerate(rows):
        axis = figure.add_subplot(grid[k, 1])
        for column, name, colour in zip(values.T, names, _COLOURS, strict=False):
            axis.plot(seconds, column, color=colour, lw=1, label=name)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        if len(names) > 1:
            axis.legend(ncols=3, fontsize=9)
    axis.set_xlabel("seconds")
    return figure


def _rpe(found: TrajectoryComparison) -> Figure:
    """Draw the relative error of every stretch against where it starts, a row for every length."""
    count = len(found.stretches)
    figure = Figure(figsize=(13.0, 2.6 * count), dpi=100, facecolor="white", layout="constrained")
    axes = figure.subplots(count, 2, squeeze=False, sharex=True)
    seconds = (found.poses.times_ns - found.poses.times_ns[0]) * 1e-9
    for (drift, turn), one in zip(axes, found.stretches, strict=True):
        drift.plot(seconds[one.start], one.drift, color=_COLOURS[0], lw=1)
        drift.set_ylabel(f"over {one.length:g} m [m]")
        turn.plot(seconds[one.start], one.angle_deg, color=_COLOURS[1], lw=1)
        turn.set_ylabel("[deg]")
        for axis in (drift, turn):
            axis.set_ylim(bottom=0)
            axis.grid(alpha=0.3)
    axes[0, 0].set_title("relative error, translation")
    axes[0, 1].set_title("relative error, rotation")
    for axis in axes[-1]:
        axis.set_xlabel("start of the stretch [s]")
    return figure
