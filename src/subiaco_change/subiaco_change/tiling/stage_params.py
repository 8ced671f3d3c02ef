"""Parameters of the stages, and the slices of the configuration that each of them reads."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

from subiaco_change.config import ChangeConfig
from subiaco_change.method_rules import rules_of_stages
from subiaco_change.tiling.epoch_tiles import Side
from subiaco_geo.frames import Floats
from subiaco_geo.tiles import Tile, tile_named

Slice = TypeVar("Slice")
#: A dataclass whose fields are named like those of :class:`~subiaco_change.config.ChangeConfig`.
AnySlice = TypeVar("AnySlice")


def slice_of(kind: type[AnySlice], config: ChangeConfig) -> AnySlice:
    """Take of a configuration what a stage reads: another setting elsewhere redoes nothing.

    Of the rules that are switched off, a slice holds those that act in its ``RULE_STAGES``.
    """
    names = [own.name for own in fields(kind)]  # type: ignore[arg-type]
    values: dict[str, Any] = {name: getattr(config, name) for name in names}
    if "rules_off" in values:
        values["rules_off"] = rules_of_stages(config.rules_off, vars(kind)["RULE_STAGES"])
    return kind(**values)


@dataclass(frozen=True)
class TileParams(Generic[Slice]):
    """Parameters of a stage that looks at both epochs.

    ``tile``: name of the tile, or *all*; ``size``: edge of a tile [m]; ``origin`` (3,): of the common frame
    in the world [m]; ``config``: what the stage reads of the configuration.
    """

    tile: str
    size: float
    sides: tuple[Side, ...]
    origin: Floats
    config: Slice

    @property
    def rules_off(self) -> tuple[str, ...]:
        """Rules that are switched off in the stage."""
        return tuple(getattr(self.config, "rules_off", ()))

    def square(self, rim: float = 0.0) -> Tile:
        """Return the tile with surroundings of a width [m]."""
        return tile_named(self.tile, self.size, rim)
