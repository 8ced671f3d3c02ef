"""Subiaco in Python: make and open maps, compare two epochs, read what changed.

>>> import subiaco
>>> subiaco.make_map(["bags/2025/loop01", "bags/2025/loop02"], "out/2025")      # doctest: +SKIP
>>> changes = subiaco.compare("out/2023", "out/2025", "out/change")             # doctest: +SKIP
>>> changes.table[changes.table.label == "Added"]                               # doctest: +SKIP

What is imported here changes only with a note in the changelog; everything else in the packages may change
between versions.
"""

from subiaco.changes import Changes, ChangeTable, compare, open_changes, run_comparison
from subiaco.maps import make_map, open_map
from subiaco_change.extensions import DecisionFunction, RegistrationFunction, SegmentationFunction
from subiaco_change.records import ChangeRecord
from subiaco_change.request import ChangeRequest
from subiaco_geo import __version__
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError, RegistrationError, SubiacoError
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.request import MappingRequest

__all__ = [
    "Change",
    "ChangeRecord",
    "ChangeRequest",
    "ChangeTable",
    "Changes",
    "DecisionFunction",
    "InputError",
    "MappingRequest",
    "PointCloud",
    "RegistrationError",
    "RegistrationFunction",
    "SegmentationFunction",
    "Semantic",
    "SubiacoError",
    "SurveyMap",
    "__version__",
    "compare",
    "make_map",
    "open_changes",
    "open_map",
    "run_comparison",
]
