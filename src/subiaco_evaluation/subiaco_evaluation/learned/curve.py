"""Learning curves as CSV and PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from subiaco_geo.atomic import whole_file

COLUMNS = ("epoch", "seconds", "learning_rate", "training_loss", "validation_loss", "validation_miou_percent")


def write_curve(stem: Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Write ``<stem>.curve.csv`` and ``<stem>.curve.png``."""
    table = pd.DataFrame(list(rows), columns=list(COLUMNS))
    with whole_file(stem.with_name(f"{stem.name}.curve.csv")) as path:
        table.to_csv(path, index=False, float_format="%.6g")
    with whole_file(stem.with_name(f"{stem.name}.curve.png")) as path:
        _draw(path, table, stem.name)


def _draw(path: Path, table: pd.DataFrame, name: str) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    left.plot(table["epoch"], table["training_loss"], label="training")
    left.plot(table["epoch"], table["validation_loss"], label="validation")
    left.set(xlabel="epoch", ylabel="loss", title=name)
    left.legend()
    right.plot(table["epoch"], table["validation_miou_percent"], color="C1")
    right.set(xlabel="epoch", ylabel="mIoU of the validation survey [%]", ylim=(0, 100))
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=90)
    plt.close(figure)
