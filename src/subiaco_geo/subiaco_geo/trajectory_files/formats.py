"""What a trajectory file of another system holds, and what has to be said about it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.crs import MAP_FRAME
from subiaco_geo.frames import Floats, Ints

#: Scale of the times of a trajectory: UTC since 1970, GPS since 1980, seconds of a GPS week, or no known one.
Clock = Literal["utc", "gps", "week", "none"]
FormatName = Literal["auto", "tum", "sbet", "pos", "csv"]
GPS_EPOCH_NS = 315_964_800 * 10**9  # 1980-01-06 in UTC
WEEK_NS = 604_800 * 10**9
#: Earlier stamps are no dates: seconds since a recording began, or of a GPS week.
DATED_NS = 946_684_800 * 10**9


class TrajectoryColumns(StrictModel):
    """Names of the columns of a table of poses; a list is tried in its order, upper and lower case alike."""

    time: tuple[str, ...] = Field(
        ("time", "gps_time", "gpstime", "gpstime[s]", "utc", "timestamp", "seconds", "t"),
        description="Columns that may hold the time: seconds, or ISO 8601",
    )
    east: tuple[str, ...] = Field(
        ("x", "east", "easting", "e"), description="Columns that may hold the easting [m]"
    )
    north: tuple[str, ...] = Field(
        ("y", "north", "northing", "n"), description="Columns that may hold the northing [m]"
    )
    latitude: tuple[str, ...] = Field(
        ("latitude", "lat"), description="Columns that may hold the latitude [deg]"
    )
    longitude: tuple[str, ...] = Field(
        ("longitude", "lon", "long"), description="Columns that may hold the longitude [deg]"
    )
    height: tuple[str, ...] = Field(
        ("z", "height", "h", "altitude", "alt", "h-ell", "elevation"),
        description="Columns that may hold the height [m]",
    )
    roll: tuple[str, ...] = Field(("roll",), description="Columns that may hold the roll")
    pitch: tuple[str, ...] = Field(("pitch",), description="Columns that may hold the pitch")
    heading: tuple[str, ...] = Field(
        ("heading", "azimuth"), description="Columns that may hold the heading, clockwise from north"
    )
    yaw: tuple[str, ...] = Field(("yaw",), description="Columns that may hold the yaw")
    quaternion: tuple[str, str, str, str] = Field(
        ("qx", "qy", "qz", "qw"), description="Columns with the quaternion of the body in the map axes"
    )


class TrajectoryFormat(StrictModel):
    """How the trajectory file of one epoch is read."""

    kind: FormatName = Field(
        "auto",
        description="Format of the trajectory file: tum, sbet (Applanix), pos (RTKLIB), csv (named columns), "
        "or auto: by the ending and the first line of the file",
    )
    clock: Literal["auto", "utc", "gps"] = Field(
        "auto",
        description="Time scale of the stamps; auto: what an RTKLIB header says, gps for SBET, else utc",
    )
    gps_week: int | None = Field(
        None, ge=0, le=9999, description="GPS week of stamps in seconds of the week; unset: undated [1]"
    )
    leap_seconds: int = Field(18, ge=0, le=60, description="Offset GPS - UTC [s]")
    match_times: bool = Field(
        True,
        description="Use only the poses during which the points of the cloud were measured, where its "
        "points carry GPS time",
    )
    declared_frame: str = Field(
        MAP_FRAME,
        description="Geodetic system of latitude and longitude, such as GDA2020 or ITRF2014; map: the datum "
        "of the CRS of the cloud",
    )
    epoch: float | None = Field(
        None,
        ge=1980,
        le=2200,
        description="Decimal year of the survey, needed where the geodetic system moves with the plates "
        "[years]",
    )
    crs: str | None = Field(
        None, description="CRS of eastings and northings of the table; unset: the CRS of the cloud"
    )
    geoid_grid: Path | None = Field(
        None,
        description="Geoid model (.gtx, .tif) of the heights of the cloud, where these are above a geoid "
        "(AHD) and the heights of the trajectory above the ellipsoid",
    )
    columns: TrajectoryColumns = Field(
        default_factory=TrajectoryColumns, description="Columns of a table of poses"
    )
    angles: Literal["deg", "rad"] = Field("deg", description="Unit of the angles of a table of poses")
    attitude: Literal["auto", "ned", "enu"] = Field(
        "auto",
        description="Convention of the angles of a table: ned (roll about forward, pitch nose up, heading "
        "clockwise from north), enu (roll, pitch nose down, yaw counter-clockwise from east); auto: ned "
        "where a column heading exists, enu where a column yaw exists",
    )
    lever_arm: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description="Position of the LiDAR from the reference point of the trajectory: forward, left, up [m]",
    )
    mounting_deg: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description="Rotation of the LiDAR in the axes forward, left, up of the body: roll, pitch, yaw [deg]",
    )


class EpochTrajectories(StrictModel):
    """How the trajectory files of both epochs are read."""

    before: TrajectoryFormat = Field(
        default_factory=TrajectoryFormat, description="How --trajectory-before is read"
    )
    after: TrajectoryFormat = Field(
        default_factory=TrajectoryFormat, description="How --trajectory-after is read"
    )


@dataclass(frozen=True)
class RecordedPath:
    """Rows of a trajectory file, before they are brought to the cloud.

    Parameters
    ----------
    times_ns : (N,) int64
        In the scale of ``clock``; seconds of the week from zero on.
    clock : str
    positions : (N, 3) float64
        Latitude, longitude [deg], ellipsoidal height [m] where ``geographic``, else east, north, height [m].
    geographic : bool
    rotations : (N, 3, 3) float64, optional
        From body axes (forward, left, up) to local axes (east, true or grid north as the positions have it,
        up); None where the file has positions alone.
    """

    times_ns: Ints
    clock: Clock
    positions: Floats
    geographic: bool
    rotations: Floats | None = None
