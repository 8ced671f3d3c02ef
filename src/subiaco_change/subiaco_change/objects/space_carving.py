"""Changes of volume and height of buildings by space carving, as intervals (method, Decision 17).

The envelope of an object in both epochs is cut into cells. In each epoch a cell is solid, free or unknown:

* *solid*: below the highest surface that the epoch has in its column, or behind two walls that the other
  epoch does not have, with nothing but unknown cells between,
  and not seen free: below a canopy is nothing solid,
* *free*: beams of the epoch passed through it, or met the ground in its column, and its own walls are not
  all around it: through a window the inside of a house is seen,
* *unknown*: everything else.

Gained is what was free in *before* and is solid in *after*, lost the reverse. Cells that one epoch knows
and the other does not are counted where they adjoin what changed: they widen the interval. What neither
epoch knows is no evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import (
    applies,
    first_argument,
    none_like_second,
    rule_mask,
    switchable,
)
from subiaco_change.objects.carving_config import CarvingConfig
from subiaco_change.objects.column_volumes import body_tops, tops_of_columns
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.layers import before_walls
from subiaco_change.objects.thin_changes import adjoining, thin_rise
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.bounding_rectangles import wall_axes
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats, Ints

#: Tells of columns (N, 2) whether an epoch met the ground there.
Bare = Callable[[Floats], Mask]
Cells = NDArray[np.bool_]

_TOP = NUMBERS.space_carving.top_tolerance
_FEW = NUMBERS.space_carving.fewest_columns
_MANY = NUMBERS.space_carving.changed_columns
_LOOKED = NUMBERS.space_carving.observed_share
_REFUTED = NUMBERS.space_carving.free_share
_LAYER = NUMBERS.layers.share
_ROOM_SIDES = NUMBERS.space_carving.room_sides
_TOUCHING = np.ones((3, 3, 3), dtype=bool)
_BESIDE_WALL, _BESIDE_ROOF = np.ones((3, 3, 5), dtype=bool), _TOUCHING  # a surface lies anywhere in its cell
_LEVEL = NUMBERS.space_carving.roof_normal
_FACES = ndimage.generate_binary_structure(3, 1)


@dataclass(frozen=True)
class Interval:
    """A difference, after minus before, between bounds."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """The point estimate."""
        return 0.5 * (self.low + self.high)

    def widened(self, by: float) -> Interval:
        """Return the interval with bounds that lie further out."""
        return Interval(self.low - by, self.high + by)

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)


@dataclass(frozen=True)
class Carved:
    """Change of the volume [m3] and of the height [m], and the volume *before* [m3].

    ``gained`` and ``lost``: the volumes [m3], neither negative, of which ``volume`` is the difference.
    ``resolution``: half of a cell over the area of the body [m3]; a smaller change is not observed.
    ``confirmed``: voxels of the walls of what was gained, and of what was lost, whose place the other epoch
    saw free on both sides.
    """

    gained: Interval
    lost: Interval
    height: Interval
    whole: float
    resolution: float = 0.0
    confirmed: tuple[int, int] = (0, 0)

    @property
    def volume(self) -> Interval:
        """What was gained less what was lost [m3]."""
        return Interval(self.gained.low - self.lost.high, self.gained.high - self.lost.low)


@dataclass(frozen=True)
class CarvingEpoch:
    """Voxels of an object in one epoch, and what the epoch knows of the space around.

    ``empty`` is None where nothing tells free space from unknown space.
    """

    voxels: Voxels
    empty: Empty | None
    bare: Bare


@dataclass(frozen=True)
class _Frame:
    """Cells about an object, along its walls: ``corner`` (2,) [m], ``turn`` (2, 2), numbers of cells."""

    corner: Floats
    turn: Floats
    shape: tuple[int, int, int]
    cell: float
    foot: Floats  # (nx, ny) height of the ground [m]

    def slots(self, xy: Floats) -> Ints:
        """Columns (N, 2) of places (N, 2)."""
        return np.floor((xy @ self.turn.T - self.corner) / self.cell).astype(np.int64)

    def cells(self, places: Floats) -> tuple[Ints, Ints, Ints]:
        """Cells that hold places (N, 3), or are the nearest to those outside, as indices of an array."""
        i, j = np.clip(self.slots(places[:, :2]), 0, np.array(self.shape[:2]) - 1).T
        level = np.floor((places[:, 2] - self.foot[i, j]) / self.rise).astype(np.int64)
        return i, j, np.clip(level, 0, self.shape[2] - 1)

    def middles(self) -> Floats:
        """Middles (nx * ny, 2) of the columns [m]."""
        return _middles(self.corner, self.turn, self.shape, self.cell)

    @property
    def levels(self) -> Floats:
        """Heights (nz,) of the middles of the cells above the ground [m]."""
        return np.asarray((np.arange(self.shape[2]) + 0.5) * self.rise, dtype=np.float64)

    @property
    def rise(self) -> float:
        """Height of a cell [m]: tops are known better than walls are placed."""
        return 0.5 * self.cell

    def level(self, heights: Floats) -> Ints:
        """Highest cells whose middles surfaces at heights above the ground reach; -1 below the lowest."""
        return np.floor((heights + _TOP) / self.rise - 0.5).astype(np.int64)

    def below(self, tops: Floats) -> Cells:
        """Tell which cells lie below tops (nx, ny) above the ground [m]."""
        return np.asarray(np.arange(self.shape[2]) <= self.level(tops)[:, :, None])

    @property
    def volume(self) -> float:
        """Volume of a cell [m3]."""
        return self.cell**2 * self.rise


@dataclass(frozen=True)
class _State:
    """What an epoch knows of every cell; ``top`` (nx, ny) of its surfaces [m], 0 where it has none.

    ``not_refuted`` (nx, ny) is the top of what the other epoch has above it and it did not see free [m].
    ``hollow`` lies below a top and was seen free: below a canopy, or behind a window. It is neither solid nor
    known to be outside. ``indoors`` was seen free between walls on all sides, and is not outside either.
    """

    solid: Cells
    free: Cells
    hollow: Cells
    indoors: Cells
    top: Floats
    not_refuted: Floats

    @property
    def unknown(self) -> Cells:
        return ~(self.solid | self.free | self.hollow | self.indoors)


def carve(before: CarvingEpoch, after: CarvingEpoch, config: CarvingConfig) -> Carved:
    """Compare the space that an object takes up in two epochs, of which one may lack it.

    Parameters
    ----------
    before, after : CarvingEpoch
        In one local frame [m].
    config : CarvingConfig
    """
    both = before.voxels, after.voxels
    if sum(map(len, both)) == 0:
        return Carved(Interval(0.0, 0.0), Interval(0.0, 0.0), Interval(0.0, 0.0), 0.0)
    frame = _frame(Voxels.joined(both), config)
    states = tuple(_state(epoch, other.voxels, frame) for epoch, other in ((before, after), (after, before)))
    gain = _difference(states[0], states[1], both, frame, config)
    loss = _difference(states[1], states[0], both[::-1], frame, config)
    old = states[0] if len(before.voxels) else states[1]
    whole = _whole(old, both, gain.cells, frame)
    area = whole / max(float(old.top[old.top > 0].mean()), frame.rise) if (old.top > 0).any() else 0.0
    rooms = [_unseen_roofs(s, d.cells, frame) for s, d in zip(states, (loss, gain), strict=True)]
    height, confirmed = _height(states, rooms, frame, config), (gain.confirmed, loss.confirmed)
    tops = [_tops_between(state, frame, config) for state in states]
    gained = _with_thin(gain, tops, area, frame, config)
    lost = _with_thin(loss, tops[::-1], area, frame, config)
    return Carved(gained, lost, height, whole, 0.5 * frame.rise * area, confirmed)


def _with_thin(
    found: _Difference,
    tops: Sequence[tuple[Floats, Floats]],
    roof: float,
    frame: _Frame,
    config: CarvingConfig,
) -> Interval:
    """Add to a volume [m3] what the roof rose by that is too thin to be carved; ``roof`` is its area [m2]."""
    cell = frame.cell**2
    counted = found.cells.sum(axis=2) * frame.rise
    thin = frame.rise, (config.thickness + 2) * frame.rise  # carving keeps a rise that fills its blocks
    enough = config.known_area / cell
    sure, likely = thin_rise(tops[0], tops[1], counted, thin, roof / cell, enough, config.known_top)
    return Interval(found.volume.low + cell * sure, found.volume.high + cell * likely)


def _frame(voxels: Voxels, config: CarvingConfig) -> _Frame:
    """Cells along the walls of both epochs, with a margin."""
    turn = wall_axes(voxels.xyz[:, :2]).T
    along = voxels.xyz[:, :2] @ turn.T
    tall = float(voxels.height.max()) + 1.0
    extent = np.append(along.max(axis=0) - along.min(axis=0), tall)
    cell = config.cell
    while 2 * np.prod(np.ceil(extent / cell) + 4) > config.max_cells:
        cell *= 1.25
    margin = 2 * cell
    corner = along.min(axis=0) - margin
    nx, ny = (int(np.ceil(v / cell)) + 4 for v in extent[:2])
    shape = (nx, ny, max(int(np.ceil(2 * tall / cell)) + 1, 4))
    middles = _middles(corner, turn, shape, cell)
    foot = voxels.ground_near(middles).reshape(nx, ny)
    return _Frame(corner, turn, shape, cell, foot)


def _middles(corner: Floats, turn: Floats, shape: tuple[int, int, int], cell: float) -> Floats:
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape[:2]), indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray((corner + (index + 0.5) * cell) @ turn)


def _state(epoch: CarvingEpoch, other: Voxels, frame: _Frame) -> _State:
    """Tell solid, free and unknown cells of an epoch.

    A surface of the other epoch that this one has too, though it sampled it elsewhere, counts as its own.
    """
    nx, ny, nz = frame.shape
    own = epoch.voxels.add(_shared(other, epoch))
    top = _tops(own, frame)
    not_refuted = _not_refuted(other, top, frame)
    below = frame.below(top)
    middles = frame.middles()
    open_column = epoch.bare(middles).reshape(nx, ny) & (top == 0)
    free = np.repeat(open_column[:, :, None], nz, axis=2)
    walls, possible = _walls(np.maximum(top, not_refuted), other, frame)
    walled = _sides(walls) >= _ROOM_SIDES
    if epoch.empty is None:  # nothing tells free space: only above what was seen there is room for the sky
        inside = ~below & walled & (_sides(possible) == 4)  # one wall may not have been seen
        sky = free | ((top > 0)[:, :, None] & ~below)
        return _State(below, sky & ~inside, np.zeros_like(below), sky & inside, top, not_refuted)
    # The floor of a room may have been seen through a window; a passage is seen to be open at its end.
    free &= ~(walled & (_sides(walls | _hidden_ends(open_column[:, :, None])) == 4))
    ask = ~free & ~_beside_surfaces(own, below, frame)
    ask |= ~(free | below)
    column, level = np.divmod(np.flatnonzero(ask.ravel()), nz)
    height = frame.foot.ravel()[column] + frame.levels[level]
    free[ask] = epoch.empty(np.column_stack([middles[column], height]))
    # The rear wall of most houses is seen by no survey; a yard is seen to be open.
    inside = ~below & walled & (_sides(possible | _hidden_ends(free)) == 4)
    hollow, outside = free & below, free & ~below & ~inside
    return _State(below & ~hollow, outside, hollow, free & inside, top, not_refuted)


def _hidden_ends(open_: Cells) -> Cells:
    """Tell the outermost cells, or columns (nx, ny, 1), that are not open: no way out was seen there."""
    ends = np.ones(open_.shape[:2], dtype=bool)
    ends[1:-1, 1:-1] = False
    return np.asarray(ends[:, :, None] & ~open_)


def _walls(top: Floats, other: Voxels, frame: _Frame) -> tuple[Cells, Cells]:
    """Return the cells below the known tops (nx, ny) of an epoch, and those with walls it may not have seen.

    The latter are of the other epoch, and their places were not observed. They are no higher than the known.
    """
    unseen = other.select(~other.observed & ~are_level(other))
    possible = np.minimum(np.maximum(top, _tops(unseen, frame)), top.max())
    return frame.below(top), frame.below(possible)


def _no_sides(walls: Cells) -> Ints:
    """Return that no cell has a wall in any direction."""
    return np.zeros(walls.shape, dtype=np.int64)


@switchable("inside_of_buildings", _no_sides)
def _sides(walls: Cells) -> Ints:
    """Count the directions of the grid in which each cell has a wall; between four is the inside of a house.

    Beams reach it through windows, and meet the floor: that shows neither the sky above nor a yard. A yard
    that is open at one side is outside, and so is what lies above the roof.
    """
    return np.sum([*_ways(walls, np.zeros_like(walls))], axis=(0, 1))


@switchable("cells_beside_surfaces", none_like_second)
def _beside_surfaces(voxels: Voxels, below: Cells, frame: _Frame) -> Cells:
    """Cells below tops that surfaces of voxels may fill; between the voxels of a wall are gaps."""
    level = are_level(voxels)
    kinds = ((voxels.select(~level), _BESIDE_WALL), (voxels.select(level), _BESIDE_ROOF))
    filled = np.zeros_like(below)
    for own, reach in kinds:
        filled |= ndimage.binary_dilation(_surface(own, frame) > 0, reach, mask=below)
    return filled


def _none_shared(other: Voxels, *_: object) -> Voxels:
    """Return no voxels."""
    return other.select(np.zeros(len(other), dtype=bool))


@switchable("surface_of_both_epochs", _none_shared)
def _shared(other: Voxels, epoch: CarvingEpoch) -> Voxels:
    """Voxels of the other epoch that this epoch has too, though it sampled them elsewhere.

    They may be of another object of this epoch: a tree before a facade divides it in one epoch alone.
    """
    shared = other.occupied_in_other & (len(epoch.voxels) > 0)
    if epoch.empty is not None and shared.any():
        shared[shared] = ~epoch.empty(other.xyz[shared])
    return other.select(shared)


def _all_refuted(_: Voxels, top: Floats, *__: object) -> Floats:
    """Return no tops."""
    return np.zeros_like(top)


@switchable("surfaces_not_refuted", _all_refuted)
def _not_refuted(other: Voxels, top: Floats, frame: _Frame) -> Floats:
    """Tops (nx, ny) of the other epoch's surfaces above an epoch's own that may have stood there too [m].

    A beam along a wall crosses the wall's columns in front of it and shows free space above what was seen
    of the wall. Surfaces of the other epoch lie in the wall itself: they stood in one epoch alone where most
    of their places were seen free.
    """
    slot = frame.slots(other.xyz[:, :2])
    own = top[slot[:, 0], slot[:, 1]]
    above = other.select((own > 0) & (other.height > own + frame.rise))
    looked = np.count_nonzero(above.observed)
    free = np.count_nonzero(above.observed_unoccupied)
    if looked >= _LOOKED * len(above) and free >= _REFUTED * looked:
        return np.zeros_like(top)
    return _tops(above.select(~above.observed_unoccupied), frame)


def _tops(voxels: Voxels, frame: _Frame) -> Floats:
    return tops_of_columns(frame.slots(voxels.xyz[:, :2]), voxels.height, frame.shape[:2])


def _enclosed(walls: Cells, stops: Cells) -> Cells:
    """Cells behind two walls: along both directions of the grid a wall comes before anything that stops.

    Two walls that meet are enough, opposite ones are not needed: of most wings a street shows the front
    and a side. Behind a single wall nothing tells how deep a building is.
    """
    along, across = _ways(walls, stops)
    behind = (along[0] | along[1]) & (across[0] | across[1])
    return np.asarray((behind | (along[0] & along[1]) | (across[0] & across[1])) & ~walls & ~stops)


def _ways(walls: Cells, stops: Cells) -> Iterator[tuple[Cells, Cells]]:
    """Yield for both axes of the grid which cells a wall comes before, on the way forth and back."""
    for axis in (0, 1):
        back = _follows(np.flip(walls, axis), np.flip(stops, axis), axis)
        yield _follows(walls, stops, axis), np.flip(back, axis)


def _follows(walls: Cells, stops: Cells, axis: int) -> Cells:
    """Cells whose last known cell on the way along an axis is a wall."""
    place = np.arange(1, walls.shape[axis] + 1).reshape([-1 if a == axis else 1 for a in range(3)])
    last_wall = np.maximum.accumulate(np.where(walls, place, 0), axis=axis)
    last_stop = np.maximum.accumulate(np.where(stops, place, 0), axis=axis)
    return np.asarray(last_wall > last_stop)


@dataclass(frozen=True)
class _Difference:
    """What one epoch has and the other had not: volume [m3], cells, wall voxels seen free on both sides."""

    volume: Interval
    cells: Cells
    confirmed: int


def _difference(
    old: _State, new: _State, sides: tuple[Voxels, Voxels], frame: _Frame, config: CarvingConfig
) -> _Difference:
    """Find what was free and is solid; cells that one epoch does not know widen the bounds of its volume.

    ``sides``: the voxels of the old and of the new epoch.

    A surface whose place the other epoch did not observe is no evidence of a change: beams that pass beside a
    surface show the cells around it free, and leave open whether the surface stood there. What it encloses
    counts as possible.
    """
    voxels = sides[1]
    solid = new.solid | _behind_new_walls(old, new, config)
    number, count = ndimage.label(_without_layers(old.free & solid, sides, old, frame), _TOUCHING)
    kinds = (
        voxels.observed_unoccupied,
        ~voxels.occupied_in_other,
        _walls_of_rooms(voxels, new, frame, config),
    )
    part = _parts_of(voxels, number, frame)
    observed, alone, confirmed = (np.bincount(part[kind], minlength=count + 1) for kind in kinds)
    supported = _supported(observed, config)
    sure = _without_thin(supported[number], config)
    # Between free space and a wall lies a cell that is neither: the resolution, and no room to hide in.
    sure |= ndimage.binary_dilation(sure, _FACES) & old.unknown & solid
    changed = _supported(alone, config)[number]
    maybe = (old.free & new.unknown) | (old.unknown & solid)
    reach = ndimage.binary_propagation(_patches(changed, config), _TOUCHING, changed | maybe)
    volume = Interval(float(sure.sum()) * frame.volume, float(reach.sum()) * frame.volume)
    wide = _longer(number, config.roof_width / frame.cell)  # than chimneys
    return _Difference(volume, sure, int(confirmed[supported & wide].sum()))


def _longer(number: Ints, least: float) -> NDArray[np.bool_]:
    """Tell which parts (count + 1,) of an array of cells or columns are longer in plan, in cells."""
    boxes = ndimage.find_objects(number)
    return np.array([False, *(max(side.stop - side.start for side in box[:2]) > least for box in boxes)])


def _walls_of_rooms(voxels: Voxels, state: _State, frame: _Frame, config: CarvingConfig) -> Mask:
    """Tell which voxels (M,) of walls were seen free on both sides, in columns as high as a room.

    Fences and hedges that touch a house are lower. What is level may be a ceiling: one survey looked through
    a window at it, the other past it.
    """
    slot = frame.slots(voxels.xyz[:, :2])
    tall = state.top[slot[:, 0], slot[:, 1]] >= config.room
    return np.asarray(voxels.free_space_confirmed & ~are_level(voxels) & tall)


def are_level(voxels: Voxels) -> Mask:
    """Tell roofs, ceilings and floors (M,) from walls."""
    return np.asarray(np.abs(voxels.normal[:, 2]) > _LEVEL)


def _parts_of(voxels: Voxels, number: Ints, frame: _Frame) -> Ints:
    """Return the part (M,) of a labelled array of cells that holds each voxel's surface, 0 for none."""
    cell, inside = _surface_cells(voxels, frame)
    part = np.zeros(len(voxels), dtype=np.int64)
    part[inside] = number[tuple(cell[inside].T)]
    return part


def _without_layers(changed: Cells, sides: tuple[Voxels, Voxels], state: _State, frame: _Frame) -> Cells:
    """Remove the parts of changed cells most of whose surface lies close before walls that both epochs have.

    What is higher than that stays: a storey behind the scaffolding by which it was built. A wall has nothing
    of the building before it: above a flat roof is no front of the parapet. The front of a wing lies further
    from the wall than scaffolding does, however near to the wall most of its room is.
    """
    if not changed.any():  # as of most houses
        return changed
    old, new = sides[0], sides[1].select(~sides[1].occupied_in_other)
    number, count = ndimage.label(changed, _TOUCHING)
    part = _parts_of(new, number, frame)
    new, part = new.select(part > 0), part[part > 0]
    outdoors = state.free & (state.top == 0)[:, :, None]

    def outside(fronts: Floats) -> Mask:
        return np.asarray(outdoors[frame.cells(fronts)])

    layer = before_walls(new.xyz, old, outside)
    size, covered = (np.bincount(some, minlength=count + 1) for some in (part, part[layer]))
    top = np.zeros(count + 1, dtype=np.int64)
    np.maximum.at(top, part[layer], frame.level(new.height[layer]))
    kept = changed.copy()
    cells, of_cell = np.argwhere(changed), number[changed]
    kept[changed] = (covered <= _LAYER * size)[of_cell] | (cells[:, 2] > top[of_cell])
    return kept


def _supported(voxels: Ints, config: CarvingConfig) -> NDArray[np.bool_]:
    """Tell which parts (count + 1,) of an array of cells hold enough voxels; the first is no part."""
    enough = ~rule_mask("supported_volumes", voxels < config.support)
    enough[0] = False
    return np.asarray(enough)


@switchable("thin_volumes", first_argument)
def _without_thin(changed: Cells, config: CarvingConfig) -> Cells:
    """Remove changed cells that are thinner than the smallest extent of a change."""
    return _opened(changed, [(config.thickness, config.thickness, config.thickness + 1)])


@switchable("lines_of_cells", first_argument)
def _patches(changed: Cells, config: CarvingConfig) -> Cells:
    """Keep changed cells that form a wall or a roof: along an edge, two samplings differ by a line of cells.

    What no epoch knows adjoins every edge: from a line of cells all of it would count as changed.
    """
    wide, tall = config.thickness, config.thickness + 1
    return _opened(changed, [(1, wide, tall), (wide, 1, tall), (wide, wide, wide)])


def _opened(cells: Cells, shapes: Sequence[tuple[int, int, int]]) -> Cells:
    """Keep cells that lie in a filled block of one of some shapes."""
    kept = np.zeros_like(cells)
    for box in ndimage.find_objects(cells.astype(np.int8)):  # the rest is empty: most houses did not change
        for shape in shapes:
            kept[box] |= ndimage.binary_opening(cells[box], np.ones(shape))
    return kept


def _surface(voxels: Voxels, frame: _Frame) -> Ints:
    """Numbers (nx, ny, nz) of voxels, each in the highest cell that its surface makes solid."""
    surface = np.zeros(frame.shape, dtype=np.int64)
    cell, inside = _surface_cells(voxels, frame)
    np.add.at(surface, tuple(cell[inside].T), 1)
    return surface


def _surface_cells(voxels: Voxels, frame: _Frame) -> tuple[Ints, Mask]:
    """Highest cells (M, 3) that the surfaces of voxels make solid, and which are cells of the frame."""
    level = frame.level(voxels.height)
    cell = np.column_stack([frame.slots(voxels.xyz[:, :2]), level])
    return cell, (level >= 0) & (level < frame.shape[2])


def _nothing_behind(_: _State, new: _State, *__: object) -> Cells:
    """Return no cells."""
    return np.zeros_like(new.solid)


@switchable("behind_new_walls", _nothing_behind)
def _behind_new_walls(old: _State, new: _State, config: CarvingConfig) -> Cells:
    """Cells that the walls of one epoch enclose which the other epoch does not have, as high as a room.

    What the other epoch has stops the way to them: behind a fence beside a house there is no room.
    """
    walls = new.solid & ~old.solid & (new.top >= config.room)[:, :, None]
    # A single free cell beside a wall is the part of the wall's own cell that lies in front of it.
    stops = ndimage.binary_opening(new.free, np.ones((2, 2, 1)))
    return walls | (_enclosed(walls, stops | (old.solid & ~walls)) & ~new.free)


def _unseen_roofs(state: _State, alone: Cells, frame: _Frame) -> Floats:
    """Return the tops (nx, ny) of what one epoch alone has where it saw no surface [m], 0 elsewhere."""
    return np.where(alone & (state.top == 0)[:, :, None], frame.levels, 0.0).max(axis=2)


def _height(
    states: Sequence[_State], rooms: Sequence[Floats], frame: _Frame, config: CarvingConfig
) -> Interval:
    """Change of the height that 5 % of the columns reach, of columns whose tops both epochs know.

    The top of a column lies between the highest surface seen in it and the lowest free cell above, or the
    surface of the other epoch that was not seen free: a beam along a wall crosses its columns in front of
    it. A column without a surface is known where free space lies well below the top in the other epoch,
    by more than a roof of 45 degrees falls within a column. The sky above a roof that one epoch did not
    see says nothing of that roof. A column that is open down to less than a room lost its body, which is
    a change of volume. Where few columns have free space above, those without count too, up to the
    highest top of all. Chimneys, parapets and party walls are no roof. A top is known to half of a cell.
    ``rooms``: the tops (nx, ny) of what each epoch alone has [m], 0 where it has nothing; a street shows the
    walls of a storey that stands back from the edge of a flat roof, and none of the roof that they carry.
    """
    ceiling = max(float(state.top.max()) for state in states)
    bounds = [_tops_between(state, frame, config) for state in states]
    columns = (states[0].top > 0) | (states[1].top > 0)
    for (low, high), other in zip(bounds, states[::-1], strict=True):
        columns &= (low > 0) | ((high < other.top - frame.cell - frame.rise) & (high >= config.room))
    capped = columns & np.logical_and(*(np.isfinite(high) for _, high in bounds))
    many = np.count_nonzero(capped) >= max(_FEW, config.capped * np.count_nonzero(columns))
    if applies("capped_columns", many):
        columns = capped
    columns = _tightly_known(columns, bounds, frame, config)
    tops = []
    for (low, high), room in zip(bounds, rooms, strict=True):
        if not (low[columns] > 0).any():
            return Interval(float("nan"), float("nan"))
        known = np.minimum(high, np.maximum(ceiling, low))
        seen = _reached(_without_narrow(low, columns, frame, config, room))
        tops.append((seen, max(_reached(_without_narrow(known, columns, frame, config)), seen)))
    (low_b, high_b), (low_a, high_a) = tops
    return Interval(low_a - high_b, high_a - low_b).widened(0.5 * frame.rise)


def _reached(tops: Floats) -> float:
    """Height that 5 % of some columns (K,) reach [m]."""
    return quantile_of(tops, 0.95)


def _without_narrow(
    top: Floats, columns: Mask, frame: _Frame, config: CarvingConfig, room: Floats | float = 0.0
) -> Floats:
    """Return the tops (K,) of some columns (nx, ny) without what is narrower than a roof [m].

    A wall before a ``room`` (nx, ny), of which the roof was not seen, is as wide as the room [m].
    """
    width = 2 * int(0.5 * config.roof_width / frame.cell) + 1  # columns of the narrowest roof: an odd number
    wide = columns | (room > 0)
    own = np.where(columns, top, room)
    lowest = ndimage.minimum_filter(np.where(wide, own, np.inf), width, mode="nearest")
    roof = ndimage.maximum_filter(np.where(wide, lowest, -np.inf), width, mode="nearest")
    return np.asarray(np.minimum(roof, top)[columns])


@switchable("known_tops", first_argument)
def _tightly_known(
    columns: Mask, bounds: Sequence[tuple[Floats, Floats]], frame: _Frame, config: CarvingConfig
) -> Mask:
    """Return the columns (nx, ny) whose tops both epochs know, if they are the highest ones in both.

    The street shows the front of a raised house and some of its roof. Behind them, ceilings were seen through
    windows, below space of which nothing is known. Columns that certainly rose or fell count too, by however
    much, where many of them adjoin: a chimney has few.
    """
    known = columns & np.logical_and(*(high - low <= config.known_top for low, high in bounds))
    (low_b, high_b), (low_a, high_a) = bounds
    least = min(config.known_area / frame.cell**2, _MANY * np.count_nonzero(columns))
    for above, below in ((low_a, high_b), (low_b, high_a)):
        known |= adjoining(columns & (above >= below + frame.rise), least)
    if np.count_nonzero(known) * frame.cell**2 < config.known_area:
        return columns
    return known if all(_as_high(low, known, columns, frame, config) for low, _ in bounds) else columns


def _as_high(low: Floats, some: Mask, columns: Mask, frame: _Frame, config: CarvingConfig) -> bool:
    """Tell whether some columns reach as high as all do, of their roofs or with what is no roof."""
    if _reached(low[some]) >= _reached(low[columns]) - frame.rise:
        return True
    roofs = (_without_narrow(low, kind, frame, config) for kind in (some, columns))
    reached, all_reached = map(_reached, roofs)
    return reached >= all_reached - frame.rise


def _tops_between(state: _State, frame: _Frame, config: CarvingConfig) -> tuple[Floats, Floats]:
    """Lowest and highest possible top (nx, ny) of every column [m]; inf where no free cell is above.

    Above a room that was seen through its windows lies a roof.
    """
    bottom = np.where(state.free, frame.levels - 0.5 * frame.rise, np.inf)
    above = np.where(bottom >= state.top[:, :, None] - frame.rise, bottom, np.inf).min(axis=2)
    near = rule_mask("roof_gap", above <= state.top + config.roof_gap)
    high = np.where(near, state.top, np.maximum(above, state.top))
    return state.top, np.maximum(high, state.not_refuted)


def _whole(state: _State, voxels: tuple[Voxels, Voxels], gained: Cells, frame: _Frame) -> float:
    """Volume *before* of a body of which a part was seen [m3]: in the rectangle around what stood."""
    stood = state.top > 0
    if not stood.any():
        return 0.0
    xy = np.concatenate([v.xyz[:, :2] for v in voxels])
    slot = frame.slots(xy)
    old = ~np.asarray(gained.any(axis=2))[slot[:, 0], slot[:, 1]]
    old[: len(voxels[0])] = True
    slot = slot[old] if old.any() else slot
    low, high = np.quantile(slot, [0.005, 0.995], axis=0).astype(np.int64)
    inside = np.zeros(stood.shape, dtype=bool)
    inside[low[0] : high[0] + 1, low[1] : high[1] + 1] = True
    return float(body_tops(state.top, inside, state.free, frame.levels).sum()) * frame.cell**2
