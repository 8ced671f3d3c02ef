"""Building extensions: unmatched buildings that were built onto a matched one, or removed from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import shapely
from scipy.spatial import cKDTree

from subiaco_change.association.config import PartConfig
from subiaco_change.geometry import in_box_around, in_outline_of
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import applies, never, switchable
from subiaco_change.objects.column_volumes import BUILT_UP, OpenGround
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.layers import is_layer
from subiaco_change.objects.space_carving import are_level
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_change.quantiles import quantile_of
from subiaco_geo.frames import Floats

_ROUND = NUMBERS.building_extensions.enclosing_share
_CAR = NUMBERS.building_extensions.car_height
_ROOM = NUMBERS.building_extensions.room_height
_WITHIN = NUMBERS.building_extensions.host_inside
_PARTY = NUMBERS.building_extensions.party_wall
_PLACES = NUMBERS.building_extensions.host_places
_GAP = NUMBERS.building_extensions.host_gap
_ADJOINS = NUMBERS.building_extensions.least_contact
_LEANS = NUMBERS.building_extensions.second_contact
_UNDERSIDE = NUMBERS.building_extensions.underside
_NEIGHBOURS = NUMBERS.building_extensions.normal_neighbours
_SMOOTH = NUMBERS.building_extensions.smoothness
_FACING = NUMBERS.building_extensions.facing
_SLOPED = NUMBERS.building_extensions.sloped
_JOINT = NUMBERS.building_extensions.joint
_FENCE = NUMBERS.building_extensions.fence_height
_GARAGE = NUMBERS.changed_houses.garage_height
_LEAST = NUMBERS.changed_houses.least_top
_OPEN = NUMBERS.building_extensions.open_gap
_FOOT = NUMBERS.building_extensions.foot
_THICK = NUMBERS.building_extensions.roof_band
_ROOF = NUMBERS.building_extensions.roof_share
_BARE = NUMBERS.building_extensions.bare_share
_BEGINS = NUMBERS.roof_structures.foot_quantile
_LOWEST = NUMBERS.roof_structures.lowest
_OVER = NUMBERS.roof_structures.share


def find_building_extensions(
    pairs: Sequence[tuple[Voxels, Voxels]], config: PartConfig, ground: OpenGround = BUILT_UP
) -> dict[int, int]:
    """Map extensions to their hosts, both positions in a list of buildings.

    Parameters
    ----------
    pairs : sequence of (Voxels, Voxels)
        A building in *before* and *after*; one that stands in one epoch alone
        is empty in the other.
    config : PartConfig
    ground : OpenGround, optional
        What both epochs saw of the space around.

    Returns
    -------
    dict
        An extension is as high as a room and touches its host, or stands on it; it is smaller than
        ``subordinate`` of it, or stands round it. A house with an open gap beside it is no
        extension.
    """
    known = list(pairs)
    extensions: dict[int, int] = {}
    while True:
        apart = partial(stands_apart, pairs=pairs, taken=extensions, config=config, ground=ground)
        found = _touching_extensions(known, extensions, config, apart, ground)
        if not found:
            return extensions
        extensions |= found
        for extension, host in found.items():  # what touches an extension touches its host
            before, after = (
                first.add(second) for first, second in zip(known[host], pairs[extension], strict=True)
            )
            known[host] = (before, after)


@switchable("gap_beside_house", never)
def stands_apart(
    number: int,
    host: int,
    pairs: Sequence[tuple[Voxels, Voxels]],
    taken: dict[int, int],
    config: PartConfig,
    ground: OpenGround,
) -> bool:
    """Tell a house beside another one from a wing.

    The walls of a wing meet those of its house somewhere above a fence. Between two houses the epoch that
    holds both saw the gap open, though eaves may reach over it. Nor does a house hang on another one by
    something smaller than itself between them.
    """
    epoch = 0 if len(pairs[number][0]) else 1
    extension, body = pairs[number][epoch], pairs[host][epoch]
    walls = extension.select(~are_level(extension)), body.select(~are_level(body))
    for part, side in (walls, (extension, body)):  # roofs count where no walls lie near
        distance, nearest = cKDTree(side.xyz[:, :2]).query(part.xyz[:, :2])
        near = distance < config.touch
        if near.any():
            break
    else:
        links = [pairs[e][epoch] for e, h in taken.items() if h == host and len(pairs[e][epoch])]
        return sum(map(_enclosed_volume, links)) < _enclosed_volume(extension)
    if _meet(part, side) or extension.height.min() > _FOOT:
        return False
    middle = 0.5 * (part.xyz[near, :2] + side.xyz[nearest[near], :2])
    open_ = ground.bare(epoch)(middle)
    empty = ground.empty[epoch]
    if empty is not None:
        open_ |= empty(np.column_stack([middle, part.xyz[near, 2]]))
    return bool(open_.mean() >= _OPEN)


def _meet(part: Voxels, side: Voxels) -> bool:
    """Tell whether two bodies come together above the height of a fence, and not only one above the other."""
    tall = [v.xyz[v.height > _FENCE] for v in (part, side)]
    return all(map(len, tall)) and bool((cKDTree(tall[1]).query(tall[0])[0] < _JOINT).any())


def _touching_extensions(
    pairs: Sequence[tuple[Voxels, Voxels]],
    taken: dict[int, int],
    config: PartConfig,
    apart: Callable[[int, int], bool],
    ground: OpenGround,
) -> dict[int, int]:
    """Map extensions to the hosts that they touch most closely, less those that are taken.

    Houses apart do not touch. A wing that fills the gap between two houses comes near both, and a house that
    leans on two others, as near to one as to the other, is an extension of neither.
    """
    hosts = [i for i, pair in enumerate(pairs) if all(map(len, pair)) and max(_top(v) for v in pair) >= _ROOM]
    extensions: dict[int, int] = {}
    for number, pair in enumerate(pairs):
        epoch = 0 if len(pair[0]) else 1
        if number in taken or len(pair[1 - epoch]) or not len(pair[epoch]):
            continue
        extension = pair[epoch].xyz
        sides = [pairs[i][epoch] for i in hosts]
        bodies = [_body(v, pair[epoch]) for v in sides]
        gaps = _gaps_below(pair[epoch], bodies)
        if not any(len(g) for g in gaps):
            gaps = [gaps_to_host(extension, body, config.touch) for body in bodies]
            gaps = [g[:0] if len(g) and apart(number, i) else g for g, i in zip(gaps, hosts, strict=True)]
        if not any(len(g) for g in gaps):
            continue
        keys = [remoteness(g) for g in gaps]
        nearest = keys.index(min(keys))
        host, contact = hosts[nearest], len(gaps[nearest])
        as_near = sorted(len(g) for g, key in zip(gaps, keys, strict=True) if key[0] == keys[nearest][0])
        leans = len(as_near) > 1 and as_near[-2] > _LEANS * len(extension)
        if applies("part_between_buildings", leans):
            continue
        if _is_extension(pair[epoch], pairs[host], epoch, contact, config, ground.bare(epoch)):
            extensions[number] = host
    return extensions


def _body(host: Voxels, extension: Voxels) -> Floats:
    """Return the places (N, 3) of a host at which an extension touches it.

    No wall between two lots makes an extension, and a house that touches the garage of another one alone is
    none.
    """
    garage = max(_FENCE, min(_GARAGE, _LEAST * _top(extension)))
    least = garage if len(host) and _top(host) > garage else _FENCE
    return host.xyz[host.height > least]


def _is_extension(
    extension: Voxels,
    host: tuple[Voxels, Voxels],
    epoch: int,
    contact: int,
    config: PartConfig,
    bare: Empty,
) -> bool:
    """Tell whether a part of one epoch alone is an extension of the building that the part touches most.

    What lies close to a wall within the outline of the building that the other epoch has there is no layer
    before the wall: a house was replaced by a larger one. ``contact``: number of places of the part that
    touch the building. ``bare`` tells of places (N, 2) whether that epoch met the ground there.
    """
    body, other = host[epoch], host[1 - epoch]
    if is_layer(extension.xyz, other) and _share_above(extension, other) < 0.5:
        return False
    if contact < _ADJOINS * len(extension) or _top(extension) < _ROOM:
        return False
    whole = max(_enclosed_volume(v) for v in host)  # as large as the survey that saw more of it shows
    share = _enclosed_volume(extension) / max(whole, 1e-9)
    if share >= config.subordinate and contact < _ROUND * len(extension):
        stood = _inside(other.xyz, extension.xyz) >= _WITHIN  # its walls stand where the extension was
        return applies("part_as_large_as_building", stood)
    return not (_is_elevated(extension, body) or is_open_roof(extension, bare))


@switchable("smooth_extensions", never)
def is_smooth_surface(voxels: Voxels) -> bool:
    """Tell walls and roofs from cars and leaves, whatever their class.

    They are taller than a car and smooth, and face the directions of one rectangle.
    """
    if len(voxels) < _NEIGHBOURS or voxels.height.max() < _CAR:
        return False
    near = cKDTree(voxels.xyz).query(voxels.xyz, k=_NEIGHBOURS)[1][:, 1:]
    along = np.abs(np.einsum("ikj,ij->ik", voxels.normal[near], voxels.normal))
    return bool(along.mean() >= _SMOOTH) and rectangularity(voxels.normal) >= _FACING


def rectangularity(normal: Floats) -> float:
    """Return how well surfaces face the four directions of one rectangle, seen from above.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals of either sign.

    Returns
    -------
    float
        Length of the mean of four times the azimuth, on the unit circle, of what is not level: 1 for a
        house, near 0 for a crown; 1 if all is level.
    """
    steep = np.hypot(normal[:, 0], normal[:, 1]) > _SLOPED
    if not steep.any():
        return 1.0
    azimuth = np.arctan2(normal[steep, 1], normal[steep, 0])
    return float(np.abs(np.exp(4j * azimuth).mean()))


def _inside(host: Floats, extension: Floats) -> float:
    """Share of the places of a host (N, 3) that lie well inside the outline of an extension (M, 3)."""
    return float(in_outline_of(extension[:, :2], host[:, :2], -_PARTY).mean()) if len(host) else 0.0


@switchable("crown_beside_building", never)
def _is_elevated(extension: Voxels, host: Voxels) -> bool:
    """Tell a crown from an extension: it begins high above the ground beside its host, not above it."""
    if extension.height.min() < max(_CAR, _UNDERSIDE * extension.height.max()):
        return False
    return _share_above(extension, host) < 0.5


@switchable("open_roofs", never)
def is_open_roof(extension: Voxels, bare: Empty) -> bool:
    """Tell a carport or a pergola from a wing: little stands below its roof, and the ground there was met.

    ``bare`` tells of places (N, 2) whether the epoch that has it met the ground there.
    """
    roof = extension.height > _top(extension) - _THICK
    return bool(roof.mean() >= _ROOF and bare(extension.xyz[roof, :2]).mean() >= _BARE)


def _share_above(extension: Voxels, host: Voxels) -> float:
    """Share of an extension above or within the outline of its host."""
    return float(in_outline_of(host.xyz[:, :2], extension.xyz[:, :2]).mean())


def _no_gaps(*_: object) -> list[Floats]:
    """Return no gaps."""
    return []


@switchable("storeys_set_back", _no_gaps)
def _gaps_below(extension: Voxels, hosts: Sequence[Floats]) -> list[Floats]:
    """Return, of each host (N, 3), a gap of 0 m for every place (M,) of a storey that lies over it.

    A storey begins above a room, and most of it lies over the host, of which the street may show no roof.
    """
    if quantile_of(extension.height, _BEGINS) < _LOWEST:
        return []
    over = [in_outline_of(host[:, :2], extension.xyz[:, :2]) for host in hosts]
    return [np.zeros(np.count_nonzero(o) if o.mean() >= _OVER else 0) for o in over]


def gaps_to_host(extension: Floats, host: Floats, touch: float) -> Floats:
    """Return how far the places of an extension that touch a host lie from it, seen from above (M,) [m]."""
    near = extension[in_box_around(extension[:, :2], host[:, :2], touch), :2] if len(host) else host
    if len(near) == 0:
        return np.zeros(0)
    distance = cKDTree(host[:, :2]).query(near, distance_upper_bound=touch)[0]
    return np.asarray(distance[np.isfinite(distance)])


def remoteness(gaps: Floats) -> tuple[float, int]:
    """Return a key that is least for the host of an extension, by the gaps (M,) between both [m].

    Where two houses are as near as walls are known, the one decides that more places of the extension touch.
    """
    if len(gaps) == 0:
        return math.inf, 0
    return round(float(np.sort(gaps)[:_PLACES].mean()) / _GAP), -len(gaps)


def _enclosed_volume(voxels: Voxels) -> float:
    """Volume of the upright body around voxels [m3]: walls alone were seen of many a house."""
    area = shapely.MultiPoint(voxels.xyz[:, :2]).convex_hull.buffer(0.25).area
    return float(area * _top(voxels))


def _top(voxels: Voxels) -> float:
    return float(np.quantile(voxels.height, 0.95))
