"""Numbers of point spacing and of free-space evidence."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class SpacingNumbers(StrictModel):
    """Numbers of ``spacing.py``."""

    street_spacing: float = Field(0.36, description="Largest point spacing of a street survey [m]")
    neighbours: int = Field(
        16,
        description="Number of neighbours from which the spacing is measured, more than lie on one scan line",
    )
    sample: int = Field(2000, description="Number of points of a tile from which the spacing is measured")


class SparseNumbers(StrictModel):
    """Numbers of ``sparse.py``."""

    nominal_leaf: float = Field(
        0.25, description="Leaf for which numbers of points per object are stated [m]"
    )


class VisibilityEvidenceNumbers(StrictModel):
    """Numbers of ``visibility_evidence.py``."""

    prior_beams: float = Field(
        0.5,
        description="Number of beams that passed, and that returned, before any is counted (Jeffreys prior)",
    )
