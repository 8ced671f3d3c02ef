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
    view_edge: float = Field(
        3.5,
        description="Ratio of the points in the two elevation steps below the end of the field of view to "
        "those in the two steps beyond the end",
    )
    view_edge_trend: float = Field(
        2.0,
        description="Largest ratio of the points in two elevation steps to those in the next two below the "
        "end of the field of view: elsewhere high objects become rare, and the view does not end",
    )
    view_edge_points: int = Field(
        20, description="Least number of points in the two elevation steps below the end of the field of view"
    )
    view_points: int = Field(
        4000, description="Largest number of points of a tile from which the field of view is estimated"
    )
    grazing_slack: float = Field(
        3.0,
        description="Depth tolerance on surfaces at a grazing angle, a multiple of a cell "
        "of a depth image at the range",
    )
    sector_steps: int = Field(
        36, description="Number of steps of azimuth around, in which blind arcs of a sensor are estimated"
    )
    sector_cloud: float = Field(
        0.25,
        description="Fraction of the cells around a pose that must hold points for the pose to show blind "
        "azimuths: elsewhere the drive lies outside its cloud",
    )
    sector_cell: float = Field(
        1.0, description="Edge of the horizontal cells that show into which azimuths a sensor looked [m]"
    )
    sector_near: tuple[float, float] = Field(
        (5.0, 15.0),
        description="Distances from the path between which a cell holds points where a sensor looked that "
        "way; a nearer cell spans too many azimuths [m]",
    )
    sector_pose_spacing: float = Field(
        0.5, description="Distance along the trajectory between poses that show blind azimuths [m]"
    )
    sector_evidence: float = Field(
        40.0,
        description="Number of cells with points that must be due, and lacking, before azimuths are blind",
    )
    sector_stray: float = Field(
        0.1, description="Fraction of the cells due that may hold points although their azimuths are blind"
    )
    sector_edge: float = Field(
        2.0,
        description="Number of cells that must hold points, and do not, for the last step of a blind arc",
    )
    sector_seen: float = Field(
        0.3,
        description="Fraction of the cells due that hold points in azimuths into which the sensor looked, "
        "those hidden by walls and vehicles left out; no more hold points in the last step of a blind arc",
    )
    sector_beside: int = Field(
        2, description="Number of steps beside a blind arc in which the sensor must have looked"
    )
    sector_least_deg: float = Field(
        60.0,
        description="Smallest sector that blind azimuths leave; where less is left, the cloud ends at the "
        "drive and all azimuths count as seen [deg]",
    )
    sector_places: int = Field(
        200_000, description="Largest number of cells of a drive from which blind azimuths are estimated"
    )


FREE_SPACE = FreeSpaceNumbers()
