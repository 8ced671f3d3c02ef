"""A map with known changes: the recipe of the edits, and the map that a second drive would give."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from subiaco_evaluation.injection.config import InjectionConfig
from subiaco_evaluation.injection.edits import (
    Donor,
    Edited,
    cut_off,
    grown,
    grown_plant,
    put_object,
    raise_ground,
    reshape,
    take_away,
)
from subiaco_evaluation.injection.occlusion import Sight
from subiaco_evaluation.injection.second_pass import second_pass, with_truth
from subiaco_evaluation.injection.site import Site
from subiaco_evaluation.injection.source_objects import SourceScene, by_turns, label_scene, things_of
from subiaco_geo.cloud_io import READABLE, read_cloud
from subiaco_geo.clouds import voxel_downsample
from subiaco_geo.codes import CHANGED, Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.survey_map import SurveyMap

_LOG = logging.getLogger(__name__)
_WIDEST = 8.0  # radius of the largest object that is put [m]
_SOLID = (Semantic.BUILDING, Semantic.VEGETATION)
#: Beginning of a file's name -> class of the object in it; anything else is *other*.
_FILE_CLASSES = {
    "building": Semantic.BUILDING,
    "tree": Semantic.VEGETATION,
    "vegetation": Semantic.VEGETATION,
    "hedge": Semantic.VEGETATION,
    "car": Semantic.MOBILE,
    "vehicle": Semantic.MOBILE,
}


@dataclass(frozen=True)
class Injected:
    """The map at the working leaf, its edited copy, and the truth of both.

    ``before`` and ``after`` are maps whose clouds carry ``object`` int64,
    ``semantic`` uint8 and ``change`` uint8; ``rows`` are those of ``objects.csv``
    in world coordinates; ``left_out`` counts edits that fitted nowhere.
    """

    before: SurveyMap
    after: SurveyMap
    rows: Sequence[dict[str, object]]
    left_out: dict[str, int]

    def turned_round(self) -> Injected:
        """Let the copy come first: what was put is taken away, what had grown is cut.

        What the second pass misses then looks new; one way alone would never show that.
        """
        rows = []
        for row in self.rows:
            change = Change(int(_OPPOSITE[int(str(row["change"]))]))
            signs = {name: -float(str(row[name])) for name in ("delta_h_m", "delta_v_m3") if name in row}
            rows.append(row | signs | {"change": int(change), "label": change.label})
        return Injected(_opposite(self.after), _opposite(self.before), rows, self.left_out)


_OPPOSITE = np.arange(256, dtype=np.uint8)
_OPPOSITE[list(CHANGED)] = [
    Change.REMOVED,
    Change.ADDED,
    Change.DECREASED,
    Change.INCREASED,
]


def _opposite(survey: SurveyMap) -> SurveyMap:
    turned = _OPPOSITE[np.asarray(survey.cloud.fields["change"])]
    return replace(survey, cloud=survey.cloud.with_fields(change=turned))


def read_donors(folder: Path, leaf: float) -> list[Donor]:
    """Read objects from a folder of clouds, one a file; the name's beginning tells the class.

    Raises
    ------
    InputError
        No cloud is there.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in READABLE) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: holds no object clouds; give a folder of .ply, .las, .laz or .pcd files")
    donors = []
    for file in files:
        xyz = voxel_downsample(read_cloud(file), leaf).xyz
        semantic = next((s for k, s in _FILE_CLASSES.items() if file.stem.lower().startswith(k)), None)
        middle = 0.5 * (xyz.min(axis=0) + xyz.max(axis=0))
        middle[2] = np.quantile(xyz[:, 2], 0.01)
        donors.append(Donor(file.stem, semantic or Semantic.OTHER, xyz - middle, np.full(len(xyz), -1)))
    return donors


def inject(
    survey: SurveyMap,
    config: InjectionConfig,
    donors: Sequence[Donor] = (),
    progress: Callable[[str, float], None] | None = None,
    scene: SourceScene | None = None,
) -> Injected:
    """Put known changes into a map.

    Parameters
    ----------
    survey : SurveyMap
        With a trajectory; a visibility layer is edited too where there is one.
    config : InjectionConfig
    donors : sequence of Donor
        Objects to put; those of the map itself where there are none.
    progress : callable, optional
    scene : SourceScene, optional
        Of :func:`label_scene`, where several copies are made of one map.

    Raises
    ------
    InputError
        The map has no trajectory.
    """
    if survey.trajectory is None or len(survey.trajectory) == 0:
        raise InputError(
            "inject: the map has no trajectory, so what hides what is unknown; give --trajectory"
        )
    say = progress or (lambda _stage, _share: None)
    say("semantics", 0.0)
    scene = scene or label_scene(survey, config)
    cloud = scene.cloud
    edited = _untouched(survey, scene, config)
    say("edits", 0.4)
    left_out = _edit(edited, list(donors))
    say("second pass", 0.9)
    before = replace(survey, cloud=with_truth(cloud, edited))
    after = second_pass(survey, cloud, edited)
    rows = [_in_world(row, cloud.origin) for row in edited.rows]
    return Injected(before, after, rows, left_out)


def _untouched(survey: SurveyMap, scene: SourceScene, config: InjectionConfig) -> Edited:
    assert survey.trajectory is not None
    xyz = scene.cloud.xyz
    sight = Sight.of_drive(survey.trajectory.positions - scene.cloud.origin, config.sight)
    site = Site.of_map(xyz, scene.semantic)
    random = np.random.default_rng(config.seed)
    return Edited(xyz, scene.semantic, scene.instance, sight, site, config, random)


def _edit(edited: Edited, donors: list[Donor]) -> dict[str, int]:
    """Make the edits that the configuration asks for; return how many of each fitted nowhere."""
    config, random = edited.config, edited.random
    things = things_of(edited)
    solid = [t for t in things if edited.semantic[t[0]] in _SOLID]
    movable = [t for t in things if _radius(edited.xyz[t]) < _WIDEST]
    own = donors or [_donor(edited, t, 1.0) for t in movable]
    left: dict[str, int] = {}
    used: set[int] = set()

    def draw(pool: list[Ints], count: int, name: str) -> list[Ints]:
        free = [t for t in pool if int(t[0]) not in used]
        chosen = [free[i] for i in by_turns([int(edited.semantic[t[0]]) for t in free], random)[:count]]
        used.update(int(t[0]) for t in chosen)
        left[name] = count - len(chosen)
        return chosen

    for members in draw(things, config.removed, "removed"):
        take_away(edited, members, _kind(edited, members))
    for members in draw(solid, config.grown, "grown"):
        is_plant = edited.semantic[members[0]] == Semantic.VEGETATION
        factor = 1.0 + random.uniform(*config.growth)
        taller = partial(grown_plant if is_plant else grown, factor=factor, leaf=config.leaf)
        left["grown"] += not reshape(edited, members, _kind(edited, members), taller, "grown")
    for members in draw(solid, config.cut, "cut"):
        shorter = _shorter(edited, members, random.uniform(*config.cutting))
        left["cut"] += not reshape(edited, members, _kind(edited, members), shorter, "cut")
    for members in draw(movable, config.moved, "moved"):
        donor = _donor(edited, members, 1.0)
        take_away(edited, members, donor.kind)
        left["moved"] += not put_object(edited, donor, "moved")
    left["patches"] = config.patches - _patches(edited)
    left["inserted"] = config.inserted
    if own and config.inserted:
        turns = np.concatenate(
            [by_turns([int(d.semantic) for d in own], random) for _ in range(-(-config.inserted // len(own)))]
        )
        for number in turns[: config.inserted]:
            donor = own[number]
            scaled = replace(donor, xyz=donor.xyz * random.uniform(*config.scale))
            left["inserted"] -= put_object(edited, scaled)
    return {name: count for name, count in left.items() if count}


def _shorter(edited: Edited, members: Ints, share: float) -> Callable[[Floats], Floats]:
    """Return how a thing loses a share of its height: a building comes down whole, a plant loses its top."""
    if edited.semantic[members[0]] == Semantic.BUILDING:
        return partial(grown, factor=1.0 - share, leaf=edited.config.leaf)
    return partial(cut_off, share=share)


def _radius(xyz: Floats) -> float:
    return float(np.linalg.norm(xyz[:, :2] - xyz[:, :2].mean(axis=0), axis=1).max())


def _kind(edited: Edited, members: Ints) -> str:
    return Semantic(int(edited.semantic[members[0]])).label


def _donor(edited: Edited, members: Ints, scale: float) -> Donor:
    """Take an object of the map as it was seen."""
    xyz = edited.xyz[members]
    foot = np.append(xyz[:, :2].mean(axis=0), edited.site.ground_below(xyz[:, :2]))
    if np.isnan(foot[2]):
        foot[2] = xyz[:, 2].min()
    poses = edited.sight.poses
    step = poses[np.argmin(np.linalg.norm(poses[:, :2] - foot[:2], axis=1)), :2] - foot[:2]
    semantic = Semantic(int(edited.semantic[members[0]]))
    return Donor(semantic.label, semantic, (xyz - foot) * scale, members, float(np.arctan2(step[1], step[0])))


def _patches(edited: Edited) -> int:
    """Raise and lower ground along the drive; return how many patches were made."""
    config, random = edited.config, edited.random
    made = 0
    poses = edited.sight.poses
    for _ in range(config.tries):
        if made == config.patches or len(poses) < 2:
            break
        number = int(random.integers(0, len(poses) - 1))
        step = poses[number + 1, :2] - poses[number, :2]
        along = float(np.arctan2(step[1], step[0]))
        aside = random.uniform(-10.0, 10.0) * np.array([-np.sin(along), np.cos(along)])
        size = (random.uniform(*config.patch_length), random.uniform(*config.patch_width))
        rise = random.uniform(*config.patch_rise) * random.choice([-1.0, 1.0])
        made += raise_ground(edited, poses[number, :2] + aside, along, size, rise)
    return made


def _in_world(row: dict[str, object], origin: Floats) -> dict[str, object]:
    place = {axis: round(float(str(row[axis])) + float(origin[i]), 3) for i, axis in enumerate("xyz")}
    return row | place
