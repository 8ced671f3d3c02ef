"""Plots of the quality page."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from subiaco_geo.frames import Floats
from subiaco_mapping.map_quality.figures import Assessment
from subiaco_mapping.map_quality.gnss_holdout import FixErrors
from subiaco_mapping.map_quality.time_series import STATES, Series
from subiaco_mapping.survey_graph.solution import GraphSolution

#: Colours that can be distinguished without red and green.
STATE_COLOURS = {2: "#0072b2", 1: "#e69f00", 0: "#d55e00", -1: "#8a8a8a"}
AXIS_COLOURS = ("#0072b2", "#e69f00", "#009e73")
_AXES = ("east", "north", "up")
_MOST = 4000  # points of one curve


def pictures(found: Assessment, solution: GraphSolution) -> dict[str, bytes]:
    """Return PNG bytes by name; what was not measured has no picture."""
    drawn = {
        "plan": _plan(found),
        "time": _over_time(found.series),
        "coverage": _coverage(found),
    }
    if len(found.used):
        drawn["fixes"] = _fixes(found)
    if isinstance(found.withheld, FixErrors):
        drawn["withheld"] = _withheld(found.withheld, found.series)
    if len(solution.loops.seams):
        drawn["loops"] = _loops(found.series, solution)
    if len(found.walls.thickness):
        drawn["walls"] = _walls(found)
    return {name: _png(figure) for name, figure in drawn.items()}


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), dpi=100, facecolor="white", layout="constrained")


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _thin(count: int) -> slice:
    return slice(None, None, max(count // _MOST, 1))


def _dress_plan(axis: Axes, title: str, origin: Floats) -> None:
    axis.set_aspect("equal")
    axis.set_title(title, fontsize=11)
    axis.set_xlabel(f"east [m] from {origin[0]:.0f}")
    axis.set_ylabel(f"north [m] from {origin[1]:.0f}")
    axis.margins(0.03)


def _origin(series: list[Series]) -> Floats:
    low = np.min([one.position[:, :2].min(axis=0) for one in series], axis=0)
    return np.asarray(np.floor(low / 100.0) * 100.0)


def _backdrop(axis: Axes, found: Assessment, origin: Floats) -> None:
    cells = found.coverage.cell[found.coverage.points >= 4] - origin
    axis.scatter(cells[:, 0] + 0.5, cells[:, 1] + 0.5, s=0.6, c="#dfe4e8", marker="s", linewidths=0)


def _plan(found: Assessment) -> Figure:
    """Draw the way twice, coloured by stated sigma and by RTK state."""
    figure, origin = _figure(13.0, 6.2), _origin(found.series)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis in (left, right):
        _backdrop(axis, found, origin)
    position = np.concatenate([one.position[:, :2] for one in found.series]) - origin
    sigma = np.concatenate([np.linalg.norm(one.sigma, axis=1) for one in found.series]) * 1000
    state = np.concatenate([one.state for one in found.series])
    rows = _thin(len(position))
    marks = left.scatter(*position[rows].T, c=sigma[rows], s=7, cmap="viridis", linewidths=0)
    figure.colorbar(marks, ax=left, label="stated sigma in space [mm]", shrink=0.8)
    for number, name in sorted(STATES.items(), reverse=True):
        chosen = state[rows] == number
        if chosen.any():
            share = 100 * float((state == number).mean())
            right.scatter(
                *position[rows][chosen].T,
                c=STATE_COLOURS[number],
                s=7,
                linewidths=0,
                label=f"{name} ({share:.0f} %)",
            )
    right.legend(markerscale=2.5, loc="upper right", framealpha=0.9)
    _dress_plan(left, "How well each position is known", origin)
    _dress_plan(right, "What the GNSS receiver said", origin)
    return figure


def _over_time(series: list[Series]) -> Figure:
    """Draw height, speed, sigma, and the correction of odometry, a column for every sequence."""
    figure = _figure(13.0, 9.5)
    axes = figure.subplots(5, len(series), sharex="col", sharey="row", squeeze=False)
    names = ("height [m]", "speed [m/s]", "stated sigma [mm]", "map ← odom [m]", "map ← odom, yaw [deg]")
    for column, one in zip(axes.T, series, strict=True):
        rows = _thin(len(one.seconds))
        t = one.seconds[rows]
        column[0].plot(t, one.position[rows, 2], color="#333333")
        column[1].plot(t, one.speed[rows], color="#333333")
        for k, name in enumerate(_AXES):
            column[2].plot(t, 1000 * one.sigma[rows, k], color=AXIS_COLOURS[k], label=name)
            column[3].plot(t, one.correction[rows, k], color=AXIS_COLOURS[k], label=name)
        column[4].plot(t, one.correction[rows, 3], color="#333333")
        column[0].set_title(one.name, fontsize=11)
        column[-1].set_xlabel("seconds since the first scan")
        column[2].set_ylim(bottom=0)
        for axis in column:
            axis.grid(alpha=0.3)
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.yaxis.set_major_locator(MaxNLocator(5))
    for axis, name in zip(axes[:, 0], names, strict=True):
        axis.set_ylabel(name)
    for row in (2, 3):
        axes[row, 0].legend(ncols=3, fontsize=9, loc="upper left")
    return figure


def _bell(axis: Axes, values: Floats, title: str, colour: str) -> None:
    """Draw a histogram of errors over sigma with the curve that right sigmas would give."""
    bins = np.linspace(-5, 5, 61)
    axis.hist(np.clip(values, -5, 5), bins=bins, density=True, color=colour, alpha=0.75)
    x = np.linspace(-5, 5, 200)
    axis.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="#333333", label="what right sigmas give")
    scale = np.median(np.abs(values)) / 0.6745  # outliers, drawn at the edges, do not count
    axis.set_title(f"{title}: {scale:.2f} times sigma", fontsize=10)
    axis.set_xlabel("error / stated sigma")
    axis.set_yticks([])


def _bells(figure: Figure, errors: FixErrors, rows: int = 1) -> Iterator[Axes]:
    grid = figure.add_gridspec(rows, 3)
    whitened = errors.offset / errors.sigma
    for k, name in enumerate(_AXES):
        axis = figure.add_subplot(grid[rows - 1, k])
        _bell(axis, whitened[:, k], name, AXIS_COLOURS[k])
        yield axis
    figure.axes[0].legend(fontsize=8, loc="upper left")


def _fixes(found: Assessment) -> Figure:
    """Draw the residuals of fixes in use over their sigmas, and chi-square over time."""
    figure = _figure(13.0, 5.6)
    list(_bells(figure, found.used, rows=2))
    axis = figure.add_subplot(figure.axes[0].get_gridspec()[0, :])
    square, start = found.used.chi_square, 0.0
    for number, one in enumerate(found.series):
        own = np.flatnonzero(found.used.sequence == number)
        if len(own) == 0:
            continue
        t = start + (found.used.times_ns[own] - found.used.times_ns[own][0]) * 1e-9
        rows = _thin(len(own))
        axis.scatter(
            t[rows],
            np.maximum(square[own][rows], 1e-3),
            s=5,
            linewidths=0,
            c=[STATE_COLOURS[min(int(s), 2)] for s in found.used.status[own][rows]],
        )
        axis.axvline(start, color="#333333", lw=0.7)
        axis.annotate(one.name, (start, 0.97), xycoords=("data", "axes fraction"), va="top", fontsize=9)
        start = float(t[-1]) + 5.0
    axis.axhline(11.34, color="#333333", ls="--", lw=1, label="99 % of fixes lie below, were sigmas right")
    axis.set_yscale("log")
    axis.set_ylabel("chi-square, 3 degrees")
    axis.set_xlabel("seconds, drive after drive")
    axis.legend(fontsize=9, loc="lower right")
    return figure


def _withheld(errors: FixErrors, series: list[Series]) -> Figure:
    """Draw the errors of withheld fixes in order, with twice their sigma, and their histograms."""
    figure = _figure(13.0, 5.6)
    list(_bells(figure, errors, rows=2))
    axis = figure.add_subplot(figure.axes[0].get_gridspec()[0, :])
    order = np.arange(len(errors))
    most = 6000 * float(np.median(errors.sigma))  # farther ones are drawn at the edge
    for k, name in enumerate(_AXES):
        shown = np.clip(1000 * errors.offset[:, k], -most, most)
        axis.plot(order, shown, ".", ms=4, color=AXIS_COLOURS[k], label=name)
    band = 2000 * errors.sigma[:, 0]
    axis.fill_between(order, -band, band, color="#888888", alpha=0.18, label="± 2 sigma east", linewidth=0)
    gaps = np.flatnonzero(np.diff(errors.times_ns) > 2_000_000_000) + 0.5
    axis.vlines(gaps, *axis.get_ylim(), color="#bbbbbb", lw=0.7)
    for number, one in enumerate(series):
        own = np.flatnonzero(errors.sequence == number)
        if len(own):
            axis.annotate(one.name, (own[0], 0.97), xycoords=("data", "axes fraction"), va="top", fontsize=9)
    axis.axhline(0, color="#333333", lw=0.7)
    axis.set_ylabel("path less fix [mm]")
    axis.set_xlabel("withheld fixes in order; grey lines part the blocks")
    axis.legend(ncols=4, fontsize=9, loc="lower right")
    return figure


def _loops(series: list[Series], solution: GraphSolution) -> Figure:
    """Draw places seen twice in plan, coloured by seam, and the seams' histogram."""
    assert solution.graph is not None
    figure, origin = _figure(13.0, 5.6), _origin(series)
    plan, seams = figure.subplots(1, 2, width_ratios=[1.4, 1])
    for one in series:
        plan.plot(*(one.position[:, :2] - origin).T, color="#c9d0d6", lw=2, zorder=0)
    ends = [
        [series[chain].position[scan, :2] - origin for chain, scan in (loop.first, loop.second)]
        for loop in solution.graph.loops
    ]
    size = 1000 * solution.loops.seams
    lines = LineCollection(ends, array=size, cmap="plasma", lw=1.5)
    plan.add_collection(lines)
    middles = np.mean(ends, axis=1)
    plan.scatter(*middles.T, c=size, cmap="plasma", s=14, linewidths=0)
    figure.colorbar(lines, ax=plan, label="seam [mm]", shrink=0.8)
    _dress_plan(plan, "Places seen twice that act on the map", origin)
    bins = np.linspace(0, max(float(size.max()), 1.0), 31)
    between = solution.loops.between
    for chosen, name, colour in (
        (between, "between drives", "#0072b2"),
        (~between, "within a drive", "#e69f00"),
    ):
        seams.hist(size[chosen], bins=bins, alpha=0.7, color=colour, label=f"{name}: {int(chosen.sum())}")
    seams.set_xlabel("seam: solved map against the registration of both visits [mm]")
    seams.set_ylabel("places")
    seams.legend()
    return figure


def _walls(found: Assessment) -> Figure:
    """Draw wall thickness in plan and as a histogram."""
    figure, origin = _figure(13.0, 5.6), _origin(found.series)
    plan, counts = figure.subplots(1, 2, width_ratios=[1.4, 1])
    walls, top = found.walls, float(np.quantile(found.walls.thickness, 0.98)) * 1000
    _backdrop(plan, found, origin)
    marks = plan.scatter(
        *(walls.centre[:, :2] - origin).T,
        c=1000 * walls.thickness,
        s=4,
        cmap="viridis",
        vmin=0,
        vmax=top,
        linewidths=0,
    )
    figure.colorbar(marks, ax=plan, label="thickness [mm]", shrink=0.8, extend="max")
    _dress_plan(plan, "Facade patches of one metre", origin)
    counts.hist(np.minimum(1000 * walls.thickness, top), bins=40, color="#0072b2", alpha=0.8)
    for share, style in ((0.5, "-"), (0.95, "--")):
        value = 1000 * float(np.quantile(walls.thickness, share))
        counts.axvline(
            value, color="#333333", ls=style, lw=1, label=f"{100 * share:.0f} % under {value:.0f} mm"
        )
    counts.set_xlabel("standard deviation of the points about the patch's plane [mm]")
    counts.set_ylabel("patches")
    counts.legend()
    return figure


def _coverage(found: Assessment) -> Figure:
    """Draw returns a square metre."""
    figure, origin = _figure(9.5, 6.2), _origin(found.series)
    axis = figure.subplots()
    cells, cover = found.coverage.cell - origin, found.coverage
    low, shape = cells.min(axis=0), np.ptp(cells, axis=0).astype(int) + 1
    image = np.full((shape[1], shape[0]), np.nan)
    at = (cells - low).astype(int)
    image[at[:, 1], at[:, 0]] = np.log10(np.maximum(cover.returns, 1))
    extent = (low[0], low[0] + shape[0], low[1], low[1] + shape[1])
    shown = axis.imshow(image, origin="lower", extent=extent, cmap="cividis", interpolation="nearest")
    bar = figure.colorbar(shown, ax=axis, label="returns a square metre", shrink=0.8)
    bar.ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{10**value:,.0f}"))
    for one in found.series:
        axis.plot(*(one.position[:, :2] - origin).T, color="#d55e00", lw=1)
    _dress_plan(axis, "Where the scanner looked", origin)
    return figure
