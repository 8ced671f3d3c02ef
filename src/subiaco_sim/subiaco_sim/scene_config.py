"""What a crowded street is like and what happens to it: settings of the scene, in YAML like all others."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel

LANE_WIDTH = 3.3  # of every lane but the first [m]


class Character(StrictModel):
    """How built-up and overgrown a street is: shares of lots and places."""

    terraces: float = Field(0.10, ge=0.0, le=1.0, description="Lots with three houses wall to wall [share]")
    shops: float = Field(0.07, ge=0.0, le=1.0, description="Lots with a shop [share]")
    apartments: float = Field(0.06, ge=0.0, le=1.0, description="Lots with a block of flats [share]")
    street_trees: float = Field(0.72, ge=0.0, le=1.0, description="Places at the kerb with a tree [share]")
    twins: float = Field(0.14, ge=0.0, le=1.0, description="Such trees that are two side by side [share]")
    gates: float = Field(0.5, ge=0.0, le=1.0, description="Yards shut off by a tall gate [share]")
    bays: float = Field(0.75, ge=0.0, le=1.0, description="Kerb with marked parking bays [share]")
    parked: float = Field(0.45, ge=0.0, le=1.0, description="Bays that are taken [share]")
    trucks: float = Field(0.10, ge=0.0, le=1.0, description="Trucks among what is parked [share]")
    wires: bool = Field(True, description="Power lines from pole to pole")
    lanes: int = Field(1, ge=1, le=3, description="Lanes each way")
    parking: float = Field(1.3, ge=1.3, le=4.0, description="What parking adds to half the road [m]")
    median: float = Field(0.0, ge=0.0, le=0.7, description="Half the width of a raised median [m]")

    @property
    def widen(self) -> float:
        """How much wider half the road is than that of a plain street [m]."""
        return self.parking + LANE_WIDTH * (self.lanes - 1)


class Seasons(StrictModel):
    """What nature and the wind do between the epochs; no change by the rules."""

    deciduous: float = Field(0.35, ge=0.0, le=1.0, description="Trees that lose leaves [share]")
    bare: float = Field(0.3, ge=0.0, le=1.0, description="Leaf density that remains on them [share]")
    sway: float = Field(0.25, ge=0.0, le=1.0, description="Lean of crowns in the wind [m]")
    growth: float = Field(0.03, ge=0.0, le=0.045, description="Growth of a crown at most [share]")


class SceneConfig(StrictModel):
    """The scene of a crowded preset; what is not asked for is the preset's."""

    character: Character = Character()
    seasons: Seasons = Seasons()
    shares: dict[str, dict[str, float]] = Field(
        {},
        description="Share of a kind of thing that an event happens to, such as {house: {extended: 0.2}}; "
        "kinds and events: subiaco_sim.events.QUOTAS",
    )
