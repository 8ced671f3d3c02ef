"""Null distribution of vegetation: how plants that did not change differ between the epochs (Decision 18).

Another sensor, another lane or another week of leaves moves the outline of every crown of a pair a little.
Most crowns did not change between two surveys. So the crowns themselves tell how far an unchanged crown of
this pair moves, and how much that scatters (method, Decision 18).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

_SCATTERS = NUMBERS.vegetation_null.scatters
_ROUNDS = NUMBERS.vegetation_null.rounds
_SETTLED = NUMBERS.vegetation_null.settled
_PRIOR_PLANTS = NUMBERS.vegetation_null.prior_plants
_STAYED = NUMBERS.vegetation_null.stayed
_MOST = NUMBERS.vegetation_null.most_of_leaves


#: Trees are compared with trees, hedges and shrubs with hedges and shrubs.
PlantKind = Literal["crown", "hedge"]
#: What is measured of a plant, with the unit of its values: metres, or a share of what the earlier survey
#: has, or of the mean of both.
PLANT_MEASURES = {
    "outline": "m",
    "top": "m",
    "volume": "share",
    "surface": "share of mean",
    "rise": "m",
    "base": "m",
}


class PlantScatter(StrictModel):
    """Standard deviations between two epochs of plants that did not change."""

    outline: float = Field(
        gt=0, description="Standard deviation of the shift of the outline of unchanged plants [m]"
    )
    top: float = Field(
        gt=0, description="Standard deviation of the top height change of unchanged plants [m]"
    )
    volume: float = Field(
        gt=0,
        description="Standard deviation of the volume change of unchanged plants, as a fraction of the "
        "volume",
    )
    surface: float = Field(
        gt=0, description="Standard deviation of the fraction of new or gone surface of unchanged plants"
    )
    rise: float = Field(
        gt=0, description="Standard deviation of the median rise of the tops of unchanged plants [m]"
    )
    base: float = Field(
        gt=0, description="Standard deviation of the median fall of the base of unchanged crowns [m]"
    )


@dataclass(frozen=True)
class PlantMeasures:
    """Differences of one plant, after minus before, and what they may depend on.

    ``density``: log of the ratio of the points in voxels that both epochs occupy; ``size``: mean reach of the
    plant from its middle [m]; ``voxels``: of either epoch that the other observed. NaN where not measured:
    ``outline`` [m], its standard error ``outline_sigma`` and its ``reach`` [m]; ``top`` [m] and its standard
    error ``top_sigma``; ``volume`` as a share of the earlier, and ``surface`` of the mean surface of both
    epochs;
    ``rise`` [m], the median rise of the tops of its columns, and its standard error ``rise_sigma``; ``base``
    [m], the median fall of the lowest leaves of its columns, and its standard error ``base_sigma``;
    ``section`` and ``section_gate`` [m], the median rise of a section of the hedge and the limit that the
    section passed. ``section_only``: the row is that section alone. ``rise_of_part`` and ``fall_of_part``
    [m]: of the columns of a part of the plant. ``free_gained`` and ``free_lost``: probability that the
    surface that *after*, or *before*, alone has was free in the other epoch. ``tops_unseen``: its columns
    were compared, but the space above their lower tops was not observed. ``height``: of its top above the
    ground [m]. ``gained_on_side`` and
    ``lost_on_side``: the fraction of its voxels that *after*, or *before*, alone has, deep in space that was
    free in the other epoch, where they lie on one side of the plant; 0 elsewhere.
    """

    kind: PlantKind
    density: float
    size: float
    voxels: int
    reach: float
    outline: float
    outline_sigma: float
    top: float
    volume: float
    surface: float
    rise: float
    rise_sigma: float
    section: float = math.nan
    section_gate: float = math.nan
    section_only: bool = False
    rise_of_part: float = 0.0
    fall_of_part: float = 0.0
    free_gained: float = 1.0
    free_lost: float = 1.0
    top_sigma: float = 0.0
    tops_unseen: bool = False
    base: float = math.nan
    base_sigma: float = math.nan
    height: float = 0.0
    gained_on_side: float = 0.0
    lost_on_side: float = 0.0

    def value(self, measure: str) -> float:
        """Return one of :data:`PLANT_MEASURES`."""
        return float(getattr(self, measure))

    def error(self, measure: str) -> float:
        """Return the standard error of a measure by the plant itself; 0 where it has none of its own."""
        own = float(getattr(self, f"{measure}_sigma", 0.0))
        return 0.0 if math.isnan(own) else own


class VegetationNullConfig(StrictModel):
    """How the unchanged plants of a pair are found and used."""

    enabled: bool = Field(
        True,
        description="Compare plants with the unchanged plants of the pair (Decision 18); otherwise use "
        "fixed limits alone",
    )
    plants: int = Field(
        12,
        ge=5,
        description="Number of matched plants of one kind from which the scatter measured on the pair is "
        "used",
    )
    certain: float = Field(
        3.0,
        gt=0,
        description="Number of standard deviations of unchanged plants beyond which a change is claimed",
    )
    slope: float = Field(
        0.15,
        gt=0,
        description="Expected dependence of a plant measure on density and size, for a factor of e [m or 1]",
    )
    changed: float = Field(
        4.0,
        gt=1,
        description="Scale of the differences of plants that changed, in stated standard deviations [1]. "
        "Raise it where plants are cut or grow by much",
    )
    changed_share: float = Field(
        0.25,
        gt=0,
        lt=1,
        description="Fraction of the plants of a pair that is expected to have changed; counts as much as "
        "four plants",
    )
    spread: float = Field(
        0.7,
        gt=0,
        description="Natural logarithm of the factor by which the scatter of a pair may differ from the "
        "stated scatter, as a standard deviation [1]",
    )
    stated: PlantScatter = Field(
        PlantScatter(outline=0.10, top=0.10, volume=0.05, surface=0.05, rise=0.08, base=0.1),
        description="Scatter of unchanged plants where a pair has too few plants: the largest on "
        "simulated pairs (64 and 128 beams, crowns swelling 2 to 8 %)",
    )
    least: PlantScatter = Field(
        PlantScatter(outline=0.03, top=0.05, volume=0.03, surface=0.03, rise=0.03, base=0.05),
        description="Smallest scatter of unchanged plants that is accepted as measured on a pair",
    )


@dataclass(frozen=True)
class Expected:
    """What an unchanged plant of this density ratio and size differs by, and the scatter around that.

    ``count`` plants were fitted; 0 says that the scatter is the stated one. ``leaves``: what leaves alone
    changed in nearly all plants of the pair that kept their extent, 0 where that is not known.
    """

    shift: float
    sd: float
    count: int
    leaves: float = 0.0


@dataclass(frozen=True)
class NullFit:
    """Linear model of one measure of one kind of plant: intercept, of log density ratio, of log size.

    ``leaves``: see :class:`Expected`.
    """

    coefficients: tuple[float, float, float]
    centre: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]
    sd: float
    count: int
    leaves: float = 0.0

    def expected(self, plant: PlantMeasures) -> Expected:
        """Return what a plant like this differs by; beyond the fitted plants as at their edge."""
        place = np.clip(_place(plant), self.low, self.high) - self.centre
        shift = self.coefficients[0] + float(place @ np.array(self.coefficients[1:]))
        return Expected(shift, self.sd, self.count, self.leaves)


@dataclass(frozen=True)
class VegetationNull:
    """Fits by ``kind/measure``; what is not there has the stated scatter about no change.

    ``certain``: standard deviations of the unchanged plants beyond which a change is claimed.
    """

    stated: PlantScatter
    certain: float
    fits: dict[str, NullFit] = field(default_factory=dict)

    def expected(self, plant: PlantMeasures, measure: str) -> Expected:
        """Return what an unchanged plant of this kind, density ratio and size differs by."""
        fit = self.fits.get(f"{plant.kind}/{measure}")
        if fit is None:
            return Expected(0.0, float(getattr(self.stated, measure)), 0)
        return fit.expected(plant)


def fit_null(plants: Sequence[PlantMeasures], config: VegetationNullConfig) -> VegetationNull:
    """Fit what unchanged plants differ by to all matched plants of a pair, in any order.

    Hedges are expected to scatter as the crowns of the pair do, which the same sensors saw and which are
    more: of few hedges half may have been cut, and their changes then look like a wide scatter.
    """
    fits: dict[str, NullFit] = {}
    kinds: tuple[PlantKind, ...] = ("crown", "hedge") if config.enabled else ()
    for kind in kinds:
        own = [p for p in plants if p.kind == kind and not p.section_only]
        for measure in PLANT_MEASURES:
            values = np.array([p.value(measure) for p in own])
            known = np.isfinite(values)
            if np.count_nonzero(known) < config.plants:
                continue
            places = np.array([_place(p) for p in own])[known]
            errors = np.array([p.error(measure) for p in own])[known]
            order = np.lexsort((*places.T, errors, values[known]))
            crowns = fits.get(f"crown/{measure}")
            expected = float(getattr(config.stated, measure)) if crowns is None else crowns.sd
            fits[f"{kind}/{measure}"] = _fit(
                places[order], values[known][order], errors[order], measure, expected, config
            )
        fits |= _with_leaves(own, kind, fits, config)
    return replace(no_null(config), fits=fits)


def _with_leaves(
    own: Sequence[PlantMeasures], kind: PlantKind, fits: dict[str, NullFit], config: VegetationNullConfig
) -> dict[str, NullFit]:
    """Fits of volume and surface that know what leaves alone changed in the plants of a kind.

    Leaves fall from some plants and not from others: most plants scatter little, and a few lose a quarter of
    their surface while their tops and outlines stay. A loss of that size is usual in the pair, and tells
    nothing.
    """
    found = {}
    kept = [p for p in own if _kept_extent(p, kind, fits)]
    for measure in ("volume", "surface"):
        fit = fits.get(f"{kind}/{measure}")
        stayed = [p for p in kept if math.isfinite(p.value(measure))]
        if fit is None or len(stayed) < config.plants:
            continue
        apart = [abs(p.value(measure) - fit.expected(p).shift) for p in stayed]
        found[f"{kind}/{measure}"] = replace(fit, leaves=float(np.quantile(apart, _MOST)))
    return found


def _kept_extent(plant: PlantMeasures, kind: PlantKind, fits: dict[str, NullFit]) -> bool:
    """Tell whether the tops and the outline of a plant were both measured and stayed."""
    pairs = ((plant.value(m), fits.get(f"{kind}/{m}")) for m in ("rise", "outline"))
    return all(fit is not None and abs(v - fit.expected(plant).shift) < _STAYED for v, fit in pairs)


def _place(plant: PlantMeasures) -> Floats:
    """Return what unchanged plants may differ by (2,): log of the density ratio, log of the size."""
    return np.array([plant.density, math.log(plant.size)])


def _fit(
    places: Floats,
    values: Floats,
    errors: Floats,
    measure: str,
    expected: float,
    config: VegetationNullConfig,
) -> NullFit:
    """Fit one measure (N,) against covariates (N, 2), with plants that changed as a second component.

    A plant either did not change, and scatters normally about the model, or did, and follows a wide Cauchy
    distribution. A plant scatters by its own standard error (N,) as well: few points of some plants do not
    widen the scatter of the others. Among standard deviations from the least one upward, the one of the
    greatest posterior is taken, where ``expected`` is the most probable one before. Slopes are held near zero
    as far as ``slope`` says: few plants would else explain changes by their size.
    """
    least = float(getattr(config.least, measure))
    low, high = (np.quantile(places, q, axis=0) for q in (0.05, 0.95))
    centre = np.median(places, axis=0)
    design = np.column_stack([np.ones(len(values)), np.clip(places, low, high) - centre])
    tried = np.geomspace(least, max(float(np.ptp(values)), 2.0 * least), _SCATTERS)
    wide = config.changed * float(getattr(config.stated, measure))
    fits = [_with_scatter(design, values, errors, float(sd), wide, config) for sd in tried]
    prior = -0.5 * (np.log(tried / expected) / config.spread) ** 2
    best = int(np.argmax(prior + [likelihood for likelihood, _ in fits]))
    a, b, c = (float(v) for v in fits[best][1])
    return NullFit((a, b, c), _pair(centre), _pair(low), _pair(high), float(tried[best]), len(values))


def _with_scatter(
    design: Floats,
    values: Floats,
    errors: Floats,
    sd: float,
    wide: float,
    config: VegetationNullConfig,
) -> tuple[float, Floats]:
    """Return the log likelihood of a standard deviation and the coefficients (3,) of its model, by EM.

    ``wide``: scale of the differences of plants that changed.
    """
    found = np.array([_shortest_half_middle(values), 0.0, 0.0])
    own = np.hypot(sd, errors)
    precision = 1.0 / own**2
    pull = np.diag([1e-9, config.slope**-2, config.slope**-2])
    changed = config.changed_share
    likelihood = -math.inf
    for _ in range(_ROUNDS):
        rest = values - design @ found
        same = (1.0 - changed) * np.exp(-0.5 * (rest / own) ** 2) / (own * math.sqrt(2.0 * math.pi))
        other = changed / (math.pi * wide * (1.0 + (rest / wide) ** 2))
        last, likelihood = likelihood, float(np.log(same + other).sum())
        if likelihood - last < _SETTLED:
            break
        weight = same / (same + other)
        trust = weight * precision
        found = np.linalg.solve(design.T @ (design * trust[:, None]) + pull, design.T @ (trust * values))
        changed = (len(values) - float(weight.sum()) + _PRIOR_PLANTS * config.changed_share) / (
            len(values) + _PRIOR_PLANTS
        )
    return likelihood, found


def _pair(values: Floats) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _shortest_half_middle(values: Floats) -> float:
    """Median of the shortest interval with half of the values (N,)."""
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    start = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
    return float(np.median(ordered[start : start + half]))


def null_words(null: VegetationNull) -> str:
    """Write a null as JSON."""
    return json.dumps({name: asdict(fit) for name, fit in sorted(null.fits.items())})


@switchable("unchanged_plants_of_the_pair", lambda _, config: no_null(config))
def null_of(words: str, config: VegetationNullConfig) -> VegetationNull:
    """Read what :func:`null_words` wrote."""
    fits = {
        name: NullFit(
            coefficients=tuple(fit["coefficients"]),
            centre=tuple(fit["centre"]),
            low=tuple(fit["low"]),
            high=tuple(fit["high"]),
            sd=fit["sd"],
            count=fit["count"],
            leaves=fit["leaves"],
        )
        for name, fit in json.loads(words).items()
    }
    return replace(no_null(config), fits=fits)


def no_null(config: VegetationNullConfig) -> VegetationNull:
    """Return the null of a pair of which no plants are known."""
    return VegetationNull(config.stated if config.enabled else config.least, config.certain)
