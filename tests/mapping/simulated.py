"""Two drives of one epoch through one simulated street, opposite ways."""

from dataclasses import replace
from pathlib import Path

from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory, read_tum
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.pipeline import map_survey
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_sim.config import LidarMode, SimulationConfig, TruthConfig
from subiaco_sim.drives import Survey, plan_survey
from subiaco_sim.labels import label_scene
from subiaco_sim.survey import _simulate_epoch

HOUR_NS = 3600 * 10**9
SIMULATION = SimulationConfig(
    preset="easy",
    mode=LidarMode.COLUMNS_512,
    duration=6.0,
    seed=1,
    ground_cell=0.6,
    truth=TruthConfig(leaf=0.5, pose_spacing=20.0),
)
MAPPING = MappingConfig(gnss=GnssConfig(min_length=8.0))


def there_and_back() -> dict[str, Survey]:
    """The survey *before*, and one an hour later the other way through the same scene."""
    survey = plan_survey(SIMULATION)
    there, other = survey.drives["before"], survey.drives["after"]
    motion = replace(other.motion, start_ns=there.motion.start_ns + HOUR_NS)
    back = replace(there, number=other.number, motion=motion)
    return {"there": survey, "back": replace(survey, drives={**survey.drives, "before": back})}


def map_two_drives(folder: Path) -> tuple[dict[str, Path], dict[str, Trajectory], Survey, SurveyMap]:
    """Record both drives and map them together; give bags, true LiDAR poses, scene and map."""
    surveys = there_and_back()
    for name, survey in surveys.items():
        _simulate_epoch(folder / name, survey, "before", label_scene(survey.scene), lambda *_: None)
    bags = {name: folder / name for name in surveys}
    truth = {name: read_tum(folder / name / "truth" / "trajectory.tum") for name in surveys}
    return bags, truth, surveys["there"], map_survey(list(bags.values()), MAPPING)
