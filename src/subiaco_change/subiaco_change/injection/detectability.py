"""The smallest change that is found with 95 % probability, by class and level of detection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import expit, logit

from subiaco_change.evaluation.objects import PointPairs
from subiaco_change.records import ChangeResult
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats

PROBABILITY = 0.95
_SHARE = 0.5  # of the points of a change that must carry its label, as subiaco evaluate
_FEWEST = 12  # changes that a curve needs
_SHIFTS = ("raised", "lowered", "grown", "cut")
_CHANGED = [c.label for c in (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)]

#: Columns of a table of injected changes: what, how large [m], level of detection there [m], found or not.
COLUMNS = ("copy", "object_id", "class_name", "kind", "event", "magnitude_m", "lod95_m", "points", "found")


def outcomes(rows: pd.DataFrame, points: PointPairs, result: ChangeResult, copy: int) -> pd.DataFrame:
    """Tell which injected changes were found.

    Parameters
    ----------
    rows : DataFrame
        ``objects.csv`` of the copy.
    points : PointPairs
        Of the result, with the truth of the copy.
    result : ChangeResult
    copy : int
        Number of the copy.

    Returns
    -------
    DataFrame
        :data:`COLUMNS`; changes below the published thresholds, and those that
        nothing in the result lies on, are left out. The magnitude of a thing put
        or taken away is its height, of any other change the shift in height.
    """
    lod = np.concatenate([np.asarray(c.fields["lod95"]) for c in (result.before, result.after)])
    found = []
    for row in rows[rows["label"].isin(_CHANGED)].to_dict("records"):
        mine = (points.true_object == row["object_id"]) & (points.true_change == row["change"])
        if not mine.any():
            continue
        levels = lod[mine][np.isfinite(lod[mine])]
        shift = row["event"] in _SHIFTS
        found.append(
            (
                copy,
                row["object_id"],
                row["class_name"],
                "shift" if shift else "whole",
                row["event"],
                abs(row["delta_h_m"]) if shift else row["height_m"],
                float(np.median(levels)) if len(levels) else np.nan,
                int(mine.sum()),
                bool((points.change[mine] == row["change"]).mean() >= _SHARE),
            )
        )
    return pd.DataFrame(found, columns=list(COLUMNS))


@dataclass(frozen=True)
class Curve:
    """Probability of being found: ``expit(a + b log(magnitude) + c log(lod))``, b >= 0 >= c.

    ``tested`` are the smallest and largest magnitudes that it rests on [m], ``count`` how many,
    ``found`` how many of them were found.
    """

    a: float
    b: float
    c: float
    tested: tuple[float, float]
    count: int
    found: int

    def probability(self, magnitude: Floats, lod: Floats | float) -> Floats:
        """Return the probability for magnitudes at a level of detection [m]."""
        return np.asarray(expit(self.a + self.b * np.log(magnitude) + self.c * np.log(lod)))

    def smallest(self, lod: Floats | float) -> Floats:
        """Return the smallest change [m] found with 95 % probability; NaN beyond what was tested."""
        if self.b < 1e-3:
            return np.full(np.shape(lod), np.nan)
        size = np.exp((logit(PROBABILITY) - self.a - self.c * np.log(lod)) / self.b)
        return np.asarray(np.where(size <= self.tested[1], np.maximum(size, self.tested[0]), np.nan))


def fit_curve(changes: pd.DataFrame) -> Curve | None:
    """Fit the curve of one class and kind; None where too few changes are known."""
    usable = changes[np.isfinite(changes["lod95_m"]) & (changes["magnitude_m"] > 0)]
    if len(usable) < _FEWEST:
        return None
    x = np.log(usable[["magnitude_m", "lod95_m"]].to_numpy(np.float64))
    sign = np.where(usable["found"].to_numpy(bool), 1.0, -1.0)

    def loss(w: Floats) -> float:
        z = sign * (w[0] + x @ w[1:])
        return float(np.logaddexp(0.0, -z).sum() + 0.05 * (w[1:] ** 2).sum())

    bounds = [(None, None), (0.0, 20.0), (-20.0, 0.0)]
    a, b, c = minimize(loss, np.array([0.0, 1.0, -0.1]), method="L-BFGS-B", bounds=bounds).x
    sizes = usable["magnitude_m"]
    tested = (float(sizes.min()), float(sizes.max()))
    return Curve(float(a), float(b), float(c), tested, len(usable), int(usable["found"].sum()))


def fit_curves(changes: pd.DataFrame) -> dict[tuple[str, str], Curve]:
    """Fit a curve for every class and kind of change (``shift`` or ``whole``) with enough changes."""
    fitted = {
        (str(name), str(kind)): fit_curve(part)
        for (name, kind), part in changes.groupby(["class_name", "kind"])
    }
    return {key: curve for key, curve in fitted.items() if curve is not None}


def smallest_table(changes: pd.DataFrame, curves: dict[tuple[str, str], Curve]) -> pd.DataFrame:
    """Return the smallest detectable change a class, kind and level of detection (quartiles of the map)."""
    rows = []
    for (name, kind), part in changes.groupby(["class_name", "kind"]):
        curve = curves.get((str(name), str(kind)))
        levels = part["lod95_m"].dropna()
        for quantile in (0.25, 0.5, 0.75):
            lod = float(levels.quantile(quantile)) if len(levels) else np.nan
            rows.append(
                {
                    "class": name,
                    "kind": kind,
                    "lod95_m": round(lod, 3),
                    "smallest_95_m": np.nan if curve is None else round(float(curve.smallest(lod)), 3),
                    "tested_from_m": round(float(part["magnitude_m"].min()), 3),
                    "tested_to_m": round(float(part["magnitude_m"].max()), 3),
                    "changes": len(part),
                    "found": int(part["found"].sum()),
                }
            )
    return pd.DataFrame(rows)


def holding(changes: pd.DataFrame, curves: dict[tuple[str, str], Curve]) -> tuple[int, int]:
    """Count fresh changes at or above the stated size, and those of them that were found."""
    stated = found = 0
    for (name, kind), part in changes.groupby(["class_name", "kind"]):
        curve = curves.get((str(name), str(kind)))
        if curve is None:
            continue
        large = (part["magnitude_m"] >= curve.smallest(part["lod95_m"].to_numpy())).to_numpy(bool)
        stated += int(large.sum())
        found += int(part["found"].to_numpy(bool)[large].sum())
    return stated, found
