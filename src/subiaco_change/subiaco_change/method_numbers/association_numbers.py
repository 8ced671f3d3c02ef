"""Numbers of matching objects and of splitting instances."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class ChangedHousesNumbers(StrictModel):
    """Numbers of ``instance_splitting/changed_houses.py``."""

    room_height: float = Field(
        2.0, description="Height from which an object in a row of houses is a house, not a fence [m]"
    )
    foot_height: float = Field(
        0.5, description="Height from which the foot of a front tells whether a house is gone [m]"
    )
    changed_share: float = Field(
        0.05,
        description="Fraction of the voxels of a slot of a row, above that of quiet slots, which one epoch "
        "alone has from which the slot changed",
    )
    clear_share: float = Field(
        0.1, description="Mean fraction of the voxels of a changed house that one epoch alone must have"
    )
    gone_share: float = Field(
        0.5,
        description="Fraction of the foot of a front that one epoch alone must have for the house to be gone "
        "or new, and of what is above the foot for its storeys to be",
    )
    left_columns: float = Field(
        0.3,
        description="Largest fraction of the columns of a house that is gone or new in which the other epoch "
        "has anything as high as a room",
    )
    quiet_quantile: float = Field(
        0.25, description="Fraction of the slots of a row that count as quiet, those that changed least"
    )
    part_of_usual: float = Field(
        0.3,
        description="Fraction of the usual change of the slots of a stretch below which a slot did not "
        "change",
    )
    sudden_step: float = Field(
        0.7,
        description="Fraction of the change of height of a house that must be reached at its party wall",
    )
    least_top: float = Field(
        0.6,
        description="Smallest height of a building between two houses in one epoch alone, as a fraction of "
        "that of the lower house, for the building to be a house of the row; also of a tall one at its end",
    )
    garage_height: float = Field(
        3.2, description="Height up to which a building beside a house is its garage, and no house [m]"
    )
    houses_of_row: int = Field(
        3,
        description="Number of houses, as long as the changed one, that remain of a row at whose end a house "
        "is new or gone",
    )
    half_of_pair: float = Field(
        0.85,
        description="Smallest ratio of the widths of the two houses of a pair of which one is new or gone",
    )
    pair_front: float = Field(
        6.5, description="Smallest width of each house of a pair of which one is new or gone [m]"
    )
    narrow_front: float = Field(
        5.5, description="Smallest width of each house of a pair that is higher than its houses are wide [m]"
    )
    confirmed_voxels: int = Field(
        40,
        description="Number of voxels of one epoch alone, seen free on both sides, that a changed part of a "
        "long building must have",
    )
    confirmed_gap: float = Field(
        1.0, description="Gap along a long building across which such voxels are of one changed part [m]"
    )
    part_depth: float = Field(
        4.0,
        description="Smallest depth to which both epochs saw a long building along its changed part, and of "
        "a tall building at the end of a row [m]",
    )
    rest_share: float = Field(
        2.0,
        description="Ratio of the length of a building without a change to that of its changed part, from "
        "which the part is an object of its own",
    )
    rest_length: float = Field(
        12.0,
        description="Smallest length of the rest of a building of which a changed part is an object of its "
        "own [m]",
    )
    end_front: float = Field(
        4.5,
        description="Smallest width of a house at the end of a row; what is narrower may be an extension [m]",
    )
    wall_reach: float = Field(
        1.0, description="Distance beside a changed house of a row within which its walls lie [m]"
    )
    same_top: float = Field(0.75, description="Largest height difference of houses of one height [m]")
    tall_top: float = Field(
        9.0,
        description="Height from which a building at the end of a row is no extension of the house beside "
        "it, though it is higher or less deep [m]",
    )
    tall_half: float = Field(
        0.6,
        description="Smallest ratio of the widths of a building that is so tall and of the rest of its row",
    )
    neighbour_share: float = Field(
        0.8,
        description="Fraction of the width of a house along which its neighbour must be unchanged",
    )
    across_row: float = Field(
        0.5,
        description="Component along a row of the unit normal of a wall below which the wall faces across the"
        " row, as a ratio",
    )


class CostsNumbers(StrictModel):
    """Numbers of ``association/costs.py``."""

    paper_weights: tuple[float, float, float] = Field(
        (1.0, 2.0, 0.5),
        description="Weights of distance, height and size in the paper's cost",
    )
    intersection_reach: float = Field(
        0.5,
        description="Distance within which voxels of two objects intersect [m]",
    )


class FelledCrownsNumbers(StrictModel):
    """Numbers of ``instance_splitting/felled_crowns.py``; ``top_reach`` also of ``one_epoch_parts.py``."""

    tall: float = Field(2.0, description="Height above ground above which a plant is a crown [m]")
    cleared: float = Field(
        1.0,
        description="Height above ground up to which points of the other epoch lie on the ground where a "
        "crown was felled [m]",
    )
    beside: float = Field(
        0.35,
        description="Distance from the places of a crown within which beams are counted, as a fraction of "
        "the distance at which points occupy a place",
    )
    grown: float = Field(
        0.7,
        description="Distance from the middle of a felled crown to its edge, as a fraction of the distance "
        "at which points occupy a place",
    )
    joined: float = Field(
        0.8,
        description="Edge of the cells in which places of one felled crown are connected, as a fraction of "
        "the distance at which points occupy a place",
    )
    neighbours: int = Field(
        4,
        description="Number of nearest points of the other epoch, seen from above, that lie on the ground in "
        "the middle of a crown that was felled",
    )
    chance: float = Field(
        1e-6,
        description="Probability that beams all reach the ground through a standing crown, below which the "
        "crown was felled",
    )
    fewest_points: int = Field(5, description="Number of points of a felled crown that is an object")
    top_reach: float = Field(
        2.0,
        description="Distance from the top of a crown within which no other crown is higher [m]",
    )


class HedgeSectionsNumbers(StrictModel):
    """Numbers of ``instance_splitting/hedge_sections.py``."""

    cell: float = Field(0.5, description="Edge of the columns whose tops are compared [m]")
    largest_height: float = Field(
        3.0,
        description="Height of a plant above which its tops are observed from below and not compared [m]",
    )
    foot: float = Field(
        1.0, description="Height above ground below which each column of a hedge beside a tree begins [m]"
    )
    column_points: int = Field(2, description="Number of points that a column needs in each epoch")
    section_columns: int = Field(6, description="Number of columns that a section of a hedge needs")
    section_length: float = Field(1.5, description="Shortest section of a hedge [m]")
    observed_share: float = Field(
        0.5,
        description="Fraction of the changed surface of a section that the other epoch must observe",
    )


class StandingTrunksNumbers(StrictModel):
    """Numbers of ``decisions/standing_trunks.py``."""

    width: float = Field(1.2, description="Largest width of the trunk of a tree, with what clings to it [m]")
    foot: float = Field(
        1.6, description="Height above the ground below which a trunk begins, seen over a car or a hedge [m]"
    )
    least_top: float = Field(
        1.0, description="Smallest height of a trunk that was left standing; a felled tree leaves a stump [m]"
    )
    crown: float = Field(1.0, description="Height by which a tree must rise over the trunk [m]")
    reach: float = Field(
        0.3,
        description="Distance of a trunk from the middle of the crown, as a fraction of the crown's radius",
    )


class MergedInstancesNumbers(StrictModel):
    """Numbers of ``instance_splitting/merged_instances.py``."""

    cell: float = Field(0.5, description="Edge of the columns that separate bodies side by side [m]")


class OneEpochPartsNumbers(StrictModel):
    """Numbers of ``instance_splitting/one_epoch_parts.py``."""

    cell: float = Field(0.5, description="Edge of the columns of a part [m]")
    little_left: float = Field(
        0.5,
        description="Ratio of the voxels that both epochs have to the observed ones of a part in one epoch "
        "alone up to which unseen space belongs to the part",
    )
    vehicle_end: float = Field(
        1.5,
        description="Length along a vehicle below which a part in one epoch alone is its end: a shorter one "
        "stood in its place [m]",
    )
    far_share: float = Field(
        0.2,
        description="Fraction of the voxels of a part that must lie farther from points of the other epoch "
        "than its spacing explains",
    )
    remains_inside: float = Field(
        0.5,
        description="Fraction of a piece of an instance that must lie within the outline of a part in one "
        "epoch alone for the piece to belong to it; the part must be larger than this fraction of the "
        "largest piece, and than the whole of any other",
    )
    object_voxels: int = Field(
        50,
        description="Number of voxels that both epochs have from which the remainder of an instance is an "
        "object, for example the garage of a demolished house",
    )
    overhang: float = Field(
        0.25,
        description="Height above a part from which a point hangs over the part [m]",
    )


class PlacesSeenFreeNumbers(StrictModel):
    """Numbers of ``instance_splitting/places_seen_free.py``."""

    free_probability: float = Field(
        0.9,
        description="Probability of being free from which a place near points of the other epoch counts as "
        "observed free",
    )
    neighbours: int = Field(
        6, description="Number of nearest points of the other epoch that show whether its surface is smooth"
    )
    smooth_normals: float = Field(
        0.9,
        description="Smallest mean cosine between the normals of neighbours on a smooth surface, as a ratio",
    )


class RowsOfHousesNumbers(StrictModel):
    """Numbers of ``instance_splitting/merged_instances.py`` and ``instance_splitting/changed_houses.py``."""

    cell: float = Field(0.5, description="Edge of the columns in which houses of a row are compared [m]")
    house_front: float = Field(3.0, description="Smallest width of a house of a row [m]")
    shared_columns: float = Field(
        0.2,
        description="Fraction of the columns of a house that lie in a house of the other epoch from which "
        "both overlap",
    )


class SplitMergeNumbers(StrictModel):
    """Numbers of ``decisions/split_merge.py``."""

    whole_share: float = Field(
        0.75,
        description="Fraction of the columns of a hedge from which the hedge changed as a whole",
    )
    wall_reach: float = Field(
        0.5,
        description="Distance outside the outline of a building within which its walls lie [m]",
    )
    inside_share: float = Field(
        0.5,
        description="Fraction of one side of a building within the outline of the rest from which both "
        "are one building",
    )
    remains: float = Field(
        0.33,
        description="Fraction of the height of a building in one epoch below which what the other epoch has"
        " in its place is no part of it",
    )
    least_observed: float = Field(
        0.5,
        description="Observed fraction below which a part of a building gets no row of its own",
    )


class TreesOverShrubsNumbers(StrictModel):
    """Numbers of ``instance_splitting/trees_over_shrubs.py``."""

    shrub_height: float = Field(
        3.0, description="Height above ground up to which what both epochs have is a shrub [m]"
    )
    tree_height: float = Field(
        4.0,
        description="Height above ground from which what one epoch has over a shrub is a tree, and no "
        "vehicle beside a hedge [m]",
    )
    times_higher: float = Field(
        2.5,
        description="Ratio of the height of a tree to that of the shrub beneath from which the tree is an "
        "object of its own",
    )
    top_quantile: float = Field(0.95, description="Fraction of the voxels of a plant that lie below its top")
    free_share: float = Field(
        0.9,
        description="Fraction of the observed voxels above a shrub that the other epoch must not have",
    )
    observed_share: float = Field(
        0.5, description="Fraction of the voxels above a shrub that the other epoch must observe"
    )
    view_share: float = Field(
        0.1,
        description="Fraction of the voxels of a tree over a shrub that must lie no higher than the view of "
        "the other epoch is known to have reached",
    )
    crown_width: float = Field(1.5, description="Smallest width of the crown of a tree over a shrub [m]")


class VehicleBodiesNumbers(StrictModel):
    """Numbers of ``objects/vehicle_bodies.py``."""

    width: tuple[float, float] = Field(
        (1.3, 2.9),
        description="Widths of the rectangle around the points of a closed vehicle [m]; a bus with mirrors "
        "is the widest",
    )
    length: tuple[float, float] = Field(
        (2.5, 13.0), description="Lengths of the rectangle around the points of a closed vehicle [m]"
    )
    top_share: float = Field(
        0.9, description="Fraction of the points of a vehicle that lie below the top of its body"
    )
