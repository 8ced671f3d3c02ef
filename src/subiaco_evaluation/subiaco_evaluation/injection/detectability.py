"""The smallest change that is found with 95 % probability, by class and level of detection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import expit, logit

from subiaco_change.records import ChangeResult
from subiaco_evaluation.object_matching import PointPairs
from subiaco_geo.codes import CHANGED_LABELS
from subiaco_geo.frames import Floats

PROBABILITY = 0.95
#: Probabilities of changes that are about as large as the stated one.
NEAR = (0.90, 0.98)
_SHARE = 0.5  # of the points of a change that must carry its label, as subiaco evaluate
_POINTS = 30  # that a change needs to be counted, as subiaco evaluate
_FEWEST = 12  # changes that a curve needs
_SHIFTS = ("raised", "lowered", "grown", "cut")

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
        :data:`COLUMNS`; changes below the published thresholds, and those of
        which the other epoch could see less than half, are left out. The magnitude of a thing put
        or taken away is its height, of any other change the shift in height.
    """
    lod = np.concatenate([np.asarray(c.fields["lod95"]) for c in (result.before, result.after)])
    found = []
    for row in rows[rows["label"].isin(CHANGED_LABELS)].to_dict("records"):
        whole = points.true_object == row["object_id"]
        mine = whole & (points.true_change == row["change"])
        if mine.sum() < max(_POINTS, _SHARE * whole.sum()):
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

    def probability(self, magnitude: Floats | float, lod: Floats | float) -> Floats:
        """Return the probability for magnitudes at a level of detection [m]."""
        return np.asarray(expit(self.a + self.b * np.log(magnitude) + self.c * np.log(lod)))

    def smallest(self, lod: Floats | float) -> Floats:
        """Return the smallest change [m] found with 95 % probability; NaN where nothing tested reaches it.

        It is never below what was tested.
        """
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            size = np.exp((logit(PROBABILITY) - self.a - self.c * np.log(lod)) / self.b)
        always = self.probability(self.tested[0], lod) >= PROBABILITY
        reached = np.where(size <= self.tested[1], np.maximum(size, self.tested[0]), np.nan)
        return np.asarray(np.where(always, self.tested[0], reached))


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


def statement(changes: pd.DataFrame, curves: dict[tuple[str, str], Curve]) -> pd.DataFrame:
    """Try the curves on changes that they were not fitted on.

    Returns
    -------
    DataFrame
        A row a class and kind, and a last one of all: ``about`` counts changes of about the stated size
        (those that are found with :data:`NEAR` according to the curve), ``about_found`` and
        ``about_expected`` the shares of them that were found and that the curve expects; ``above`` and
        ``above_found`` the same for all from the stated size on.
    """
    parts = []
    for (name, kind), part in changes.groupby(["class_name", "kind"]):
        curve = curves.get((str(name), str(kind)))
        if curve is not None:
            size, lod = (part[column].to_numpy(np.float64) for column in ("magnitude_m", "lod95_m"))
            expected = curve.probability(size, lod)
            tested = (size >= curve.tested[0]) & (size <= curve.tested[1])
            about = tested & (expected >= NEAR[0]) & (expected <= NEAR[1])
            above = size >= curve.smallest(lod)
            parts.append(part.assign(expected=expected, about=about, above=above))
    rows = [_tried(str(p["class_name"].iloc[0]), str(p["kind"].iloc[0]), p) for p in parts]
    none = changes.iloc[:0].assign(expected=0.0, about=False, above=False)
    return pd.DataFrame([*rows, _tried("all", "all", pd.concat(parts) if parts else none)])


def _tried(name: str, kind: str, part: pd.DataFrame) -> dict[str, object]:
    about, above = part[part["about"].astype(bool)], part[part["above"].astype(bool)]
    return {
        "class": name,
        "kind": kind,
        "about": len(about),
        "about_found": round(float(about["found"].mean()), 3) if len(about) else np.nan,
        "about_expected": round(float(about["expected"].mean()), 3) if len(about) else np.nan,
        "above": len(above),
        "above_found": round(float(above["found"].mean()), 3) if len(above) else np.nan,
    }
