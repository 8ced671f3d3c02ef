"""Building extensions: unmatched buildings that were built onto a matched one, or removed from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial import cKDTree

from subiaco_change.decisions.voxel_objects import Voxels
from subiaco_change.instance_splitting.one_epoch_parts import PartConfig
from subiaco_change.segmentation.clustering import cell_clusters
from subiaco_geo.frames import Floats

_ROUND = 0.75  # a part that touches its host with so much of itself stands round it, however large it is
_SMALL = 0.1  # less than this share of its host is no house, whatever stands on both sides
_CAR = 2.3  # no car is taller [m]
_ROOM = 2.4  # no room is lower: a shed beside a house is no wing [m]
_LEANS = 0.25  # what touches a second building with more of itself stands between the two
_WITHIN = 0.3  # share of a host inside a part in one epoch alone, from which the part was the house itself
_PARTY = 0.5  # walls so near the edge of an outline are shared with a neighbour [m]
_BESIDE = 0.5  # less of a neighbour lies within the outline of a house in the epoch without it
_HALF_STOREY = 1.5  # an adjoining part that is taller by more is another house [m]
_UNDERSIDE = 0.6  # what begins higher, in shares of its top, stands on nothing
_NEIGHBOURS = 6  # voxels, itself among them, whose normals are compared
_HIDDEN = 0.5  # less than this share of a wall is seen to be gone where something hides it
_SMOOTH = 0.78  # mean cosine between the normals of neighbours: leaves stay below 0.75


def find_wings(pairs: Sequence[tuple[Voxels, Voxels]], config: PartConfig) -> dict[int, int]:
    """Map wings to their hosts, both positions in a list of buildings.

    Parameters
    ----------
    pairs : sequence of (Voxels, Voxels)
        A building in *before* and *after*; one that stands in one epoch alone
        is empty in the other.
    config : PartConfig

    Returns
    -------
    dict
        A wing is as high as a room and touches its host; it is smaller than
        ``subordinate`` of it and no half storey taller, or stands round it, and does not
        stand between parts of it that would be apart without it: a house
        pulled from a row was no wing.
    """
    known = list(pairs)
    wings: dict[int, int] = {}
    while True:
        found = _wings_of(known, wings, config)
        if not found:
            return wings
        wings |= found
        for wing, host in found.items():  # what touches a wing touches its host
            before, after = (
                first.add(second) for first, second in zip(known[host], pairs[wing], strict=True)
            )
            known[host] = (before, after)


def _wings_of(
    pairs: Sequence[tuple[Voxels, Voxels]], taken: dict[int, int], config: PartConfig
) -> dict[int, int]:
    """Map wings that touch their hosts, less those that are taken."""
    hosts = [i for i, pair in enumerate(pairs) if all(map(len, pair)) and max(_top(v) for v in pair) >= _ROOM]
    wings: dict[int, int] = {}
    for number, pair in enumerate(pairs):
        epoch = 0 if len(pair[0]) else 1
        if number in taken or len(pair[1 - epoch]) or not len(pair[epoch]):
            continue
        wing = pair[epoch].xyz
        contact = [_contact(wing, pairs[i][epoch].xyz, config) for i in hosts]
        if not contact or max(contact) == 0:
            continue
        host = hosts[int(np.argmax(contact))]
        if _is_wing(pair[epoch], pairs[host], epoch, contact, config):
            wings[number] = host
    return wings


def _is_wing(
    wing: Voxels, host: tuple[Voxels, Voxels], epoch: int, contact: Sequence[int], config: PartConfig
) -> bool:
    """Tell whether a part of one epoch alone is a wing of the building that the part touches most."""
    body, other = host[epoch], host[1 - epoch]
    round_it = max(contact) >= _ROUND * len(wing)
    free = float((wing.seen & ~wing.still).mean())
    if round_it and free < _HIDDEN and _over(wing, other) >= _BESIDE:
        return True  # a wall of the house that a wing of the other epoch hides
    if _top(wing) < _ROOM or (len(contact) > 1 and sorted(contact)[-2] > _LEANS * len(wing)):
        return False  # lower than a room, or between two buildings
    share = _bulk(wing) / max(_bulk(body), 1e-9)
    if share >= config.subordinate and not round_it:
        return _inside(other.xyz, wing.xyz) >= _WITHIN  # its walls stand where the wing was
    if _floats(wing, body):
        return False
    if _over(wing, other) < _BESIDE and not round_it and _rises(wing, body):
        return False
    return share < _SMALL or not any(_between(wing.xyz, side.xyz, config) for side in host if len(side))


def built(voxels: Voxels) -> bool:
    """Tell walls and roofs from cars and leaves, whatever their class: taller than a car, and smooth."""
    if len(voxels) < _NEIGHBOURS or voxels.height.max() < _CAR:
        return False
    near = cKDTree(voxels.xyz).query(voxels.xyz, k=_NEIGHBOURS)[1][:, 1:]
    along = np.abs(np.einsum("ikj,ij->ik", voxels.normal[near], voxels.normal))
    return bool(along.mean() >= _SMOOTH)


def _inside(host: Floats, wing: Floats) -> float:
    """Share of the places of a host (N, 3) that lie well inside the outline of a wing (M, 3)."""
    outline = shapely.MultiPoint(wing[:, :2]).convex_hull.buffer(-_PARTY)
    return float(shapely.contains_xy(outline, host[:, 0], host[:, 1]).mean()) if len(host) else 0.0


def _floats(wing: Voxels, host: Voxels) -> bool:
    """Tell a crown from a wing: it begins high above the ground beside its host, not above it."""
    if wing.height.min() < max(_CAR, _UNDERSIDE * wing.height.max()):
        return False
    return _over(wing, host) < 0.5


def _rises(wing: Voxels, host: Voxels) -> bool:
    """Tell whether a wing is taller than its host by half a storey."""
    return _top(wing) - _top(host) > _HALF_STOREY


def _over(wing: Voxels, host: Voxels) -> float:
    """Share of a wing above or within the outline of its host."""
    outline = shapely.MultiPoint(host.xyz[:, :2]).convex_hull
    return float(shapely.contains_xy(outline, wing.xyz[:, 0], wing.xyz[:, 1]).mean())


def _contact(wing: Floats, host: Floats, config: PartConfig) -> int:
    low, high = host[:, :2].min(axis=0) - config.touch, host[:, :2].max(axis=0) + config.touch
    near = wing[((wing[:, :2] >= low) & (wing[:, :2] <= high)).all(axis=1), :2]
    if len(near) == 0:
        return 0
    return int(np.isfinite(cKDTree(host[:, :2]).query(near, distance_upper_bound=config.touch)[0]).sum())


def _bulk(voxels: Voxels) -> float:
    """Volume of the upright body around voxels [m3]: walls alone were seen of many a house."""
    area = shapely.MultiPoint(voxels.xyz[:, :2]).convex_hull.buffer(0.25).area
    return float(area * _top(voxels))


def _top(voxels: Voxels) -> float:
    return float(np.quantile(voxels.height, 0.95))


def _between(wing: Floats, host: Floats, config: PartConfig) -> bool:
    """Tell whether the wing touches parts of the host that do not touch each other."""
    labels = cell_clusters(host[:, :2], config.touch)
    touching = np.isfinite(cKDTree(wing[:, :2]).query(host[:, :2], distance_upper_bound=config.touch)[0])
    sizes = np.bincount(labels)
    parts = [k for k in np.unique(labels[touching]) if sizes[k] >= 0.1 * len(host)]
    return len(parts) > 1
