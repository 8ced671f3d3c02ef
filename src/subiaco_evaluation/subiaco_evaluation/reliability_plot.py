"""Reliability plot: share of right labels by stated confidence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_NAMES = {"changed_rows": "claimed changes", "all_rows": "all rows"}


def draw_reliability(path: Path, found: Mapping[str, Any]) -> None:
    """Draw the share of right rows over their confidence; ``found``: ``reliability`` of the evaluation."""
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(4.2, 4.0), layout="constrained")
        FigureCanvasAgg(figure)
        axis = figure.subplots()
        axis.plot([0, 1], [0, 1], color="0.7", linestyle=":")
        for (name, label), colour in zip(_NAMES.items(), ("#d62728", "#1f77b4"), strict=True):
            table = found[name]
            bins = [b for b in table["bins"] if b["rows"]]
            x, y = ([b[key] for b in bins] for key in ("mean_confidence", "right_fraction"))
            said = f"{label}: {table['rows']} rows"
            if bins:
                said += f", ECE {table['ece_fraction']:.3f}"
            axis.plot(x, y, color=colour, linewidth=1, label=said)
            axis.scatter(x, y, s=[6.0 + 2.0 * b["rows"] ** 0.5 for b in bins], color=colour)
        axis.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="confidence", ylabel="share of right labels")
        axis.legend(loc="upper left", frameon=False)
        figure.savefig(path, dpi=110)
