"""The numbers of the method that no setting reaches, in one place, each with unit and meaning.

The modules name them at their beginning. They are frozen: who changes one, changes it here, raises
``METHOD_VERSION`` in :mod:`subiaco_geo.settings`, and every result says so (``method`` in ``run.json``).
"""

from __future__ import annotations

from subiaco_change.method_numbers.association_numbers import (
    ChangedHousesNumbers,
    CostsNumbers,
    FelledCrownsNumbers,
    HedgeSectionsNumbers,
    MergedInstancesNumbers,
    OneEpochPartsNumbers,
    PlacesSeenFreeNumbers,
    RowsOfHousesNumbers,
    SplitMergeNumbers,
    StandingTrunksNumbers,
    TreesOverShrubsNumbers,
    VehicleBodiesNumbers,
)
from subiaco_change.method_numbers.decision_numbers import (
    AbsenceNumbers,
    BuildingExtensionsNumbers,
    ColumnVolumesNumbers,
    ConfidenceNumbers,
    DrivenLaneNumbers,
    DynamicObjectsNumbers,
    GroundCellsNumbers,
    GroundChangeNumbers,
    LayersNumbers,
    ObjectDecisionNumbers,
    PlantMeasuresNumbers,
    PlantTopsNumbers,
    PointLabelsNumbers,
    RulesNumbers,
    SpaceCarvingNumbers,
    TrailInPiecesNumbers,
    TrailShapesNumbers,
    VegetationNullNumbers,
    ViewOfCrownsNumbers,
    VoxelObjectsNumbers,
)
from subiaco_change.method_numbers.registration_numbers import (
    CoarseNumbers,
    CommonFrameNumbers,
    CorrelationNumbers,
    DisplacedStartsNumbers,
    DisplacementLodNumbers,
    FeaturesNumbers,
    FittingNumbers,
    IcpNumbers,
    NdtNumbers,
    PairNumbers,
    PlanesNumbers,
    PlausibilityNumbers,
    RegisterNumbers,
    RegistrationUncertaintyNumbers,
    VerticalBiasNumbers,
    WarpNumbers,
)
from subiaco_change.method_numbers.segmentation_numbers import (
    BuildingInteriorsNumbers,
    InstancesNumbers,
    RaisedGroundNumbers,
    RoofStructuresNumbers,
    SpacingNumbers,
    SparseNumbers,
    SurveyPlacesNumbers,
    ThinTrailsNumbers,
    TrailEndsNumbers,
    TrailShapeNumbers,
    TrailSwathsNumbers,
    ViewFromAboveNumbers,
    VisibilityEvidenceNumbers,
    WiresAndPolesNumbers,
)
from subiaco_change.method_numbers.tiling_numbers import TilingNumbers
from subiaco_geo.config import StrictModel
from subiaco_geo.free_space.numbers import FREE_SPACE, FreeSpaceNumbers


class MethodNumbers(StrictModel):
    """All numbers of the method beside its settings, by the module that uses them."""

    absence: AbsenceNumbers = AbsenceNumbers()
    building_interiors: BuildingInteriorsNumbers = BuildingInteriorsNumbers()
    building_extensions: BuildingExtensionsNumbers = BuildingExtensionsNumbers()
    layers: LayersNumbers = LayersNumbers()
    changed_houses: ChangedHousesNumbers = ChangedHousesNumbers()
    column_volumes: ColumnVolumesNumbers = ColumnVolumesNumbers()
    confidence: ConfidenceNumbers = ConfidenceNumbers()
    correlation: CorrelationNumbers = CorrelationNumbers()
    displaced_starts: DisplacedStartsNumbers = DisplacedStartsNumbers()
    driven_lane: DrivenLaneNumbers = DrivenLaneNumbers()
    dynamic_objects: DynamicObjectsNumbers = DynamicObjectsNumbers()
    ground_cells: GroundCellsNumbers = GroundCellsNumbers()
    ground_change: GroundChangeNumbers = GroundChangeNumbers()
    object_decision: ObjectDecisionNumbers = ObjectDecisionNumbers()
    plant_measures: PlantMeasuresNumbers = PlantMeasuresNumbers()
    plant_tops: PlantTopsNumbers = PlantTopsNumbers()
    point_labels: PointLabelsNumbers = PointLabelsNumbers()
    rules: RulesNumbers = RulesNumbers()
    space_carving: SpaceCarvingNumbers = SpaceCarvingNumbers()
    trail_in_pieces: TrailInPiecesNumbers = TrailInPiecesNumbers()
    trail_shapes: TrailShapesNumbers = TrailShapesNumbers()
    vegetation_null: VegetationNullNumbers = VegetationNullNumbers()
    view_of_crowns: ViewOfCrownsNumbers = ViewOfCrownsNumbers()
    voxel_objects: VoxelObjectsNumbers = VoxelObjectsNumbers()
    costs: CostsNumbers = CostsNumbers()
    felled_crowns: FelledCrownsNumbers = FelledCrownsNumbers()
    hedge_sections: HedgeSectionsNumbers = HedgeSectionsNumbers()
    standing_trunks: StandingTrunksNumbers = StandingTrunksNumbers()
    merged_instances: MergedInstancesNumbers = MergedInstancesNumbers()
    one_epoch_parts: OneEpochPartsNumbers = OneEpochPartsNumbers()
    places_seen_free: PlacesSeenFreeNumbers = PlacesSeenFreeNumbers()
    rows_of_houses: RowsOfHousesNumbers = RowsOfHousesNumbers()
    split_merge: SplitMergeNumbers = SplitMergeNumbers()
    trees_over_shrubs: TreesOverShrubsNumbers = TreesOverShrubsNumbers()
    vehicle_bodies: VehicleBodiesNumbers = VehicleBodiesNumbers()
    instances: InstancesNumbers = InstancesNumbers()
    raised_ground: RaisedGroundNumbers = RaisedGroundNumbers()
    roof_structures: RoofStructuresNumbers = RoofStructuresNumbers()
    thin_trails: ThinTrailsNumbers = ThinTrailsNumbers()
    trail_ends: TrailEndsNumbers = TrailEndsNumbers()
    trail_shape: TrailShapeNumbers = TrailShapeNumbers()
    trail_swaths: TrailSwathsNumbers = TrailSwathsNumbers()
    wires_and_poles: WiresAndPolesNumbers = WiresAndPolesNumbers()
    coarse: CoarseNumbers = CoarseNumbers()
    features: FeaturesNumbers = FeaturesNumbers()
    fitting: FittingNumbers = FittingNumbers()
    icp: IcpNumbers = IcpNumbers()
    ndt: NdtNumbers = NdtNumbers()
    pair: PairNumbers = PairNumbers()
    planes: PlanesNumbers = PlanesNumbers()
    plausibility: PlausibilityNumbers = PlausibilityNumbers()
    warp: WarpNumbers = WarpNumbers()
    registration_findings: RegisterNumbers = RegisterNumbers()
    common_frame: CommonFrameNumbers = CommonFrameNumbers()
    displacement_lod: DisplacementLodNumbers = DisplacementLodNumbers()
    registration_uncertainty: RegistrationUncertaintyNumbers = RegistrationUncertaintyNumbers()
    vertical_bias: VerticalBiasNumbers = VerticalBiasNumbers()
    spacing: SpacingNumbers = SpacingNumbers()
    sparse: SparseNumbers = SparseNumbers()
    visibility_evidence: VisibilityEvidenceNumbers = VisibilityEvidenceNumbers()
    survey_places: SurveyPlacesNumbers = SurveyPlacesNumbers()
    view_from_above: ViewFromAboveNumbers = ViewFromAboveNumbers()
    tiling: TilingNumbers = TilingNumbers()
    free_space: FreeSpaceNumbers = FREE_SPACE


NUMBERS = MethodNumbers()
