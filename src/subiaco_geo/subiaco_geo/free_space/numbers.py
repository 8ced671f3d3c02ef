"""Numbers of the expected visibility that no setting reaches, each with unit and meaning.

They are frozen: who changes one raises ``METHOD_VERSION`` in :mod:`subiaco_geo.settings`. The change run
writes them out with its other numbers (``method`` in ``run.json``).
"""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class FreeSpaceNumbers(StrictModel):
    """Numbers of ``subiaco_geo/free_space/``."""

    level_thickness: float = Field(
        0.2,
        description="Smallest height of a point on a level surface in a depth image, as a fraction of its "
        "width",
    )
    widest_cosine: float = Field(
        0.05,
        description="Smallest cosine of the elevation, a ratio, by which a point in a depth image is widened",
    )
    spin_axis_deg: float = Field(
        35.0,
        description="Largest angle between the vertical and an axis of the sensor that is the spin "
        "axis [deg]",
    )
    elevation_step_deg: float = Field(
        0.5, description="Step of the elevations at which an unknown field of view is estimated [deg]"
    )
    range_step: float = Field(
        0.5, description="Step of the ranges at which an unknown range of a sensor is estimated [m]"
    )
    elevations_per_range: int = Field(
        10, description="Number of elevation steps from one histogram of ranges to the next"
    )
    view_points: int = Field(
        4000, description="Largest number of points of a tile from which the field of view is estimated"
    )
    grazing_slack: float = Field(
        3.0,
        description="Depth tolerance on surfaces at a grazing angle, a multiple of a cell "
        "of a depth image at the range",
    )


FREE_SPACE = FreeSpaceNumbers()
