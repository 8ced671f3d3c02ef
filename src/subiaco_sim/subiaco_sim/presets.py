"""The scenes that can be asked for by name."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_sim.changes import apply_changes, ground_changes, replaced_cars
from subiaco_sim.city import BLOCK, CITY_ROW, city_block, city_road, city_tile
from subiaco_sim.config import Beams, FaultConfig, MapErrorConfig, SimulationConfig
from subiaco_sim.events import let_time_pass, work_the_ground
from subiaco_sim.families.build import StreetSize, build_street
from subiaco_sim.families.config import Family, StreetConfig
from subiaco_sim.families.plan import StreetPlan, plan_street
from subiaco_sim.ground import Road
from subiaco_sim.movers import random_movers
from subiaco_sim.neighbourhood import lay_out_crowded
from subiaco_sim.scene import Scene
from subiaco_sim.scene_config import Character, SceneConfig, Seasons
from subiaco_sim.suburb import dense_route, lay_out, make_terrain

AnyModel = TypeVar("AnyModel", bound=StrictModel)
_NO_FAULTS = FaultConfig()
_NO_ERRORS = MapErrorConfig()


@dataclass(frozen=True)
class Preset:
    """A street plan and how much happens along it."""

    waypoints: Callable[[], Floats]
    frontage: float  # width of a lot [m]
    rounds: int  # how often the stock of changes is dealt
    margin: float  # land around the street [m]
    cell: float  # edge of the ground mesh [m]
    duration: float  # of each drive [s]
    speed: float  # [m/s]
    beams: tuple[Beams, Beams] = (128, 128)  # before, after
    place: tuple[float, float] = (0.5, 0.5)  # where along the route the drives lie
    lanes: tuple[int, int] = (0, 0)  # of the two drives, counted from the crown
    scene: SceneConfig | None = None  # crowded where given
    divergence: float = 0.0  # of the beams [rad]
    wet_road: float = 0.0
    faults: FaultConfig = _NO_FAULTS
    maps: MapErrorConfig = _NO_ERRORS
    slope: float = 0.02  # steepest lie of the land [m per m]
    gentlest: float = 0.0  # least slope along x [m per m]
    pitch: tuple[float, float] | None = None  # between the loops of a city, east and north [m]


@dataclass(frozen=True)
class FamilyPreset(Preset):
    """A street that its seed draws: course, land, sensors, lanes and what stands there."""

    family: Family = Family.SUBURB
    hard: bool = False
    length: float = 210.0  # of the street [m]

    def plan(self, street: StreetConfig, seed: int) -> StreetPlan:
        """Draw the plan of the street."""
        return plan_street(self.family, hard=self.hard, config=street, seed=seed)


def winding_street() -> Floats:
    """One street of 260 m with two gentle bends."""
    x = np.linspace(-130.0, 130.0, 14)
    return np.column_stack([x, 11.0 * np.sin(x / 48.0)])


def block_loop() -> Floats:
    """Once around a block of 110 m x 84 m with rounded corners, and 30 m into it again."""
    half_x, half_y, radius = 55.0, 42.0, 17.0
    corners = [(half_x, -half_y), (half_x, half_y), (-half_x, half_y), (-half_x, -half_y)]
    points = [np.array([[0.0, -half_y]])]
    for turn, (x, y) in enumerate(corners):
        angle = np.radians(np.linspace(-90, 0, 4) + 90 * turn)
        centre = np.array([x - np.sign(x) * radius, y - np.sign(y) * radius])
        points.append(centre + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        if turn in (0, 2):
            points.append(np.array([[x, 0.0]]))
        if turn == 1:
            points.append(np.array([[12.0, y], [-12.0, y]]))
    points.append(np.array([[0.0, -half_y]]))
    return np.concatenate(points)


def winding_road() -> Floats:
    """Return a road of some 440 m that winds up a hillside."""
    x = np.linspace(-200.0, 200.0, 21)
    return np.column_stack([x, 30.0 * np.sin(x / 62.0) + 6.0 * np.sin(x / 23.0)])


PRESETS: dict[str, Preset] = {
    "easy": Preset(winding_street, 15.5, 1, 45.0, 0.3, 20.0, 6.5),
    "default": Preset(
        block_loop,
        15.0,
        1,
        38.0,
        0.3,
        42.0,
        7.0,
        beams=(64, 128),
        scene=SceneConfig(),
        slope=0.04,
        divergence=8e-4,
    ),
    "hard": Preset(
        winding_road,
        14.0,
        1,
        42.0,
        0.3,
        42.0,
        8.5,
        beams=(64, 128),
        place=(0.35, 0.35),  # each from its own end: either leaves out what the other begins with
        lanes=(0, 1),
        scene=SceneConfig(
            character=Character(
                terraces=0.16,
                shops=0.12,
                apartments=0.12,
                street_trees=0.85,
                parked=0.6,
                trucks=0.22,
                lanes=2,
                median=0.4,
            ),
            seasons=Seasons(deciduous=0.5, bare=0.2, sway=0.4, growth=0.04),
        ),
        slope=0.08,
        gentlest=0.055,
        divergence=1.2e-3,
        wet_road=0.5,
        faults=FaultConfig(packet_loss=0.002, reordered=0.005, canyons=True, multipath=2),
        maps=MapErrorConfig(shift=1.2, rotation_deg=0.8, drift=0.08, shear=0.06, duplicates=0.1),
    ),
    "city": Preset(
        city_block,
        15.0,
        1,
        38.0,
        0.3,
        56.0,
        6.0,
        beams=(64, 128),
        scene=SceneConfig(),
        slope=0.04,
        divergence=8e-4,
        pitch=BLOCK,
    ),
}


def _family(family: Family, *, hard: bool) -> FamilyPreset:
    """Return the preset of a family; its waypoints only say how long the street is."""
    length = 210.0
    return FamilyPreset(
        lambda: np.array([[-length / 2, 0.0], [length / 2, 0.0]]),
        frontage=0.0,
        rounds=0,
        margin=42.0,
        cell=0.3,
        duration=26.0,
        speed=7.0,
        divergence=1.2e-3 if hard else 8e-4,
        wet_road=0.4 if hard else 0.0,
        maps=MapErrorConfig(shift=0.8, rotation_deg=0.5, drift=0.05, shear=0.03) if hard else _NO_ERRORS,
        faults=FaultConfig(packet_loss=0.002, canyons=True, multipath=1) if hard else _NO_FAULTS,
        family=family,
        hard=hard,
        length=length,
    )


for _kind in Family:
    for _hard in (False, True):
        PRESETS[f"{_kind}{'_hard' if _hard else ''}"] = _family(_kind, hard=_hard)


def find_preset(name: str) -> Preset:
    """Return a preset by name.

    Raises
    ------
    InputError
        There is none of that name.
    """
    if name not in PRESETS:
        raise InputError(f"preset {name}: not available; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


def build_scene(
    name: str,
    seed: int,
    ground_cell: float | None = None,
    loop: int = 0,
    asked: SceneConfig | None = None,
    reverse_after: bool = True,
) -> Scene:
    """Build the scene of a preset, or of one loop of a city; the same arguments give the same scene."""
    preset = find_preset(name)
    rng = np.random.default_rng([seed, 7] if loop == 0 else [seed, 7, loop])
    route = dense_route(preset.waypoints() + loop_offset(preset, loop))
    cell = ground_cell or preset.cell
    if preset.scene is not None:
        told = _merged(preset.scene, asked) if asked else preset.scene
        ways = (-1.0, 1.0 if reverse_after else -1.0)  # of the traffic, against the survey vehicle
        if preset.pitch is not None:
            return _city_scene(preset, told, route, cell, (seed, loop), ways)
        return _crowded_scene(preset, told, route, cell, rng, ways)
    layout = lay_out(route, preset.frontage, rng)
    terrain = make_terrain(Road(route), preset.margin, cell, rng)
    items = replaced_cars(apply_changes(layout, preset.rounds), rng)
    ground = ground_changes(layout, len(items) + 1, preset.rounds)
    return Scene(terrain, tuple(items), tuple(ground), route)


def build_family_scene(config: SimulationConfig) -> Scene:
    """Build the scene of a family preset from settings that are complete."""
    preset = find_preset(config.preset)
    assert isinstance(preset, FamilyPreset)
    size = StreetSize(config.street.length or preset.length, preset.margin, config.ground_cell or preset.cell)
    plan = preset.plan(config.street, config.seed)
    return build_street(plan, size, config.street, bool(config.reverse_after), config.seed)


def loop_offset(preset: Preset, loop: int) -> Floats:
    """Return where a loop of a city lies (2,): rows of five, eastwards, then northwards [m]."""
    if preset.pitch is None:
        return np.zeros(2)
    return np.array([loop % CITY_ROW, loop // CITY_ROW]) * np.array(preset.pitch)


def _crowded_scene(
    preset: Preset,
    told: SceneConfig,
    route: Floats,
    cell: float,
    rng: np.random.Generator,
    ways: tuple[float, float],
) -> Scene:
    character = told.character
    road = Road(route, character.widen, character.median)
    terrain = make_terrain(road, preset.margin, cell, rng, preset.slope)
    east = np.copysign(max(abs(terrain.slope[0]), preset.gentlest), terrain.slope[0])
    layout = lay_out_crowded(route, preset.frontage, rng, character)
    terrain = replace(terrain, slope=(float(east), terrain.slope[1]), lines=tuple(layout.lines))
    items = let_time_pass(layout, told.seasons, told.shares)
    ground = work_the_ground(layout, len(items) + 1)
    movers = random_movers(len(items) + len(ground) + 1, 0.25 * len(route), character, ways, rng)
    return Scene(terrain, tuple(items), tuple(ground), route, movers)


def _city_scene(
    preset: Preset,
    told: SceneConfig,
    route: Floats,
    cell: float,
    which: tuple[int, int],
    ways: tuple[float, float],
) -> Scene:
    """Build one loop (seed, loop) of a city: its block and as much of the neighbours as is in sight."""
    seed, loop = which
    land = np.random.default_rng([seed, 7])  # the lie of the land is the city's
    terrain = make_terrain(Road(route), preset.margin, cell, land, preset.slope)
    road = city_road(loop % CITY_ROW, loop // CITY_ROW, told.character.widen)
    tile = city_tile(loop, preset.frontage, told, seed, terrain.bounds)
    terrain = replace(terrain, road=road, lines=tuple(tile.lines))
    rng = np.random.default_rng([seed, 8, loop])
    first = len(tile.items) + len(tile.ground) + 1
    movers = random_movers(first, 0.25 * len(route), told.character, ways, rng)
    return Scene(terrain, tuple(tile.items), tuple(tile.ground), route, movers)


def _merged(base: AnyModel, asked: AnyModel) -> AnyModel:
    """Return settings with those that were asked for, to any depth."""
    update = {}
    for name in asked.model_fields_set:
        old, new = getattr(base, name), getattr(asked, name)
        update[name] = _merged(old, new) if isinstance(old, StrictModel) else new
    return base.model_copy(update=update)


def with_preset(config: SimulationConfig) -> SimulationConfig:
    """Return the settings with those of the preset wherever nothing else was asked for."""
    preset = find_preset(config.preset)
    if isinstance(preset, FamilyPreset):
        config = _drawn(preset, config)
    elif config.street != StreetConfig():
        raise InputError(f"street: preset {config.preset} has none of these settings; take suburb or dense")
    if preset.scene is None and config.scene != SceneConfig():
        raise InputError(f"scene: preset {config.preset} has none of these settings; take a crowded preset")
    lidar = {"divergence": preset.divergence, "wet_road": preset.wet_road}
    asked = {name for name in config.lidar.model_fields_set if getattr(config.lidar, name) is not None}
    return config.model_copy(
        update={
            "duration": config.duration or preset.duration,
            "ground_cell": config.ground_cell or preset.cell,
            "beams_before": config.beams_before or preset.beams[0],
            "beams_after": config.beams_after or preset.beams[1],
            "lane_before": preset.lanes[0] if config.lane_before is None else config.lane_before,
            "lane_after": preset.lanes[1] if config.lane_after is None else config.lane_after,
            "reverse_after": True if config.reverse_after is None else config.reverse_after,
            "scene": _merged(preset.scene or SceneConfig(), config.scene),
            "lidar": config.lidar.model_copy(update={k: v for k, v in lidar.items() if k not in asked}),
            "faults": _merged(preset.faults, config.faults),
            "maps": _merged(preset.maps, config.maps),
        }
    )


def _drawn(preset: FamilyPreset, config: SimulationConfig) -> SimulationConfig:
    """Return the settings with what the seed draws wherever nothing else was asked for."""
    plan = preset.plan(config.street, config.seed)
    sensors = [None if beams else name for beams, name in zip(_beams(config), plan.sensors, strict=True)]
    return config.model_copy(
        update={
            "sensor_before": config.sensor_before or sensors[0],
            "sensor_after": config.sensor_after or sensors[1],
            "lane_before": plan.lane[0] if config.lane_before is None else config.lane_before,
            "lane_after": plan.lane[1] if config.lane_after is None else config.lane_after,
            "reverse_after": plan.reverse_after if config.reverse_after is None else config.reverse_after,
        }
    )


def _beams(config: SimulationConfig) -> tuple[int | None, int | None]:
    return config.beams_before, config.beams_after


def family_of(name: str) -> str | None:
    """Return the family of streets that a preset belongs to; None for those of the first edition."""
    preset = find_preset(name)
    return str(preset.family) if isinstance(preset, FamilyPreset) else None


def simulator_hash() -> str:
    """Return a short hash of the simulator's own source: the same hash and seed give the same survey."""
    digest = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def preset_hash(name: str) -> str:
    """Return a short hash of everything that a preset says."""
    preset = find_preset(name)
    said = {k: str(v) for k, v in vars(preset).items() if k != "waypoints"}
    text = repr(sorted(said.items())).encode() + preset.waypoints().round(6).tobytes()
    return hashlib.sha256(text).hexdigest()[:16]
