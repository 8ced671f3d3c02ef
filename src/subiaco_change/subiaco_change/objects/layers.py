"""Objects close before a wall that both surveys saw: scaffolding, awnings, parasols.

They hide no wall, and hold no room; a wing does both.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats

_DEPTH = NUMBERS.layers.depth
_FRONT = NUMBERS.layers.front
_AHEAD = NUMBERS.layers.ahead
_NEAREST = NUMBERS.layers.nearest_walls
_STEEP = NUMBERS.layers.wall_normal
_SHARE = NUMBERS.layers.share


def walls_of_both(voxels: Voxels) -> Mask:
    """Tell which voxels (N,) are of walls that both epochs have."""
    steep = np.hypot(voxels.normal[:, 0], voxels.normal[:, 1]) > _STEEP
    return np.asarray(steep & voxels.occupied_in_other)


def _before_none(places: Floats, *_: object) -> Mask:
    """Return that no place lies before a wall."""
    return np.zeros(len(places), dtype=bool)


@switchable("layers_before_walls", _before_none)
def before_walls(places: Floats, voxels: Voxels, outside: Empty | None = None) -> Mask:
    """Tell which places lie close before walls that both epochs have.

    One of the nearest surfaces of walls must face a place: scaffolding stands so close to its wall that some
    of its own surfaces count as in both. A storey lies behind the upper edge of the wall on which it was
    built: what faces a wall lies on the side on which the space in front of the wall was seen free.

    Parameters
    ----------
    places : (N, 3) float64
        In the local frame [m].
    voxels : Voxels
        Of a building in one epoch, and which of them the other epoch has too.
    outside : callable, optional
        Tells which places (N, 3) lie outside the building; None: both sides of a wall count.

    Returns
    -------
    (N,) bool
    """
    walls = voxels.select(walls_of_both(voxels))
    if len(walls) == 0 or len(places) == 0:
        return _before_none(places)
    found = cKDTree(walls.xyz).query(places, k=min(_NEAREST, len(walls)), distance_upper_bound=_DEPTH)
    distance, nearest = (values.reshape(len(places), -1) for values in found)
    place, rank = np.nonzero(np.isfinite(distance))
    wall = nearest[place, rank]
    along = ((places[place] - walls.xyz[wall]) * walls.normal[wall]).sum(axis=1)
    ahead = np.abs(along) >= _AHEAD * distance[place, rank]
    place, wall, along = place[ahead], wall[ahead], along[ahead]
    if outside is not None:
        front = walls.xyz[wall] + np.sign(along)[:, None] * walls.normal[wall] * _FRONT
        place = place[outside(front)]
    before = _before_none(places)
    before[place] = True
    return before


def is_layer(places: Floats, voxels: Voxels) -> bool:
    """Tell whether most of an object with places (N, 3) [m] lies close before walls that both epochs have."""
    return bool(before_walls(places, voxels).mean() > _SHARE)
