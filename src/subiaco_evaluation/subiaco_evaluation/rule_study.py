"""Ablation of rules: every rule of the method switched off in turn on simulated surveys, scored in pairs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from subiaco_change.config import ChangeConfig
from subiaco_change.method_rules import RULES, STAGES_OF_RULES, known_rules
from subiaco_change.pipeline import detect_in_tiles
from subiaco_change.records import TiledResult
from subiaco_evaluation import object_matching as objects
from subiaco_evaluation.grid import rasterise
from subiaco_evaluation.layouts import in_after_frame
from subiaco_evaluation.paired import block_differences, tile_matrices
from subiaco_evaluation.rule_runner import FullRunner, PartialRunner, RuleNotes
from subiaco_evaluation.scoring import EvaluationConfig, joined_truth
from subiaco_evaluation.truth import SurveyTruth, read_truth
from subiaco_geo.atomic import whole_file
from subiaco_geo.codes import CHANGED, Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints
from subiaco_geo.sources import open_epoch
from subiaco_geo.work.source_code import source_fingerprint
from subiaco_geo.work.store import DiskStore
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import fingerprint

#: What tells a folder of a study from another folder.
MARKER = "study.json"
TABLE, RUNS, PAGE = "rules.csv", "runs.csv", "rules.md"
BASELINE = "baseline"
_CLOUDS = ("ply", "laz", "las")
_BLOCK = 40.0  # edge of the blocks that the bootstrap draws [m]


@dataclass(frozen=True)
class RuleRun:
    """Score of one survey without one rule.

    ``cells`` (B, 5, 6): change matrix of every block of cells; ``objects`` (K, 3): east and north of a block,
    and changes found less wrong claims there; ``used``: rules whose answer once differed from that without
    them, known of the baseline alone.
    """

    cells: Ints
    objects: Ints
    used: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Job:
    survey: Path
    rule: str
    folder: Path
    config: ChangeConfig


def run_rule_study(
    surveys: Sequence[Path],
    output: Path,
    config: ChangeConfig,
    progress: Callable[[str, float], None] | None = None,
    *,
    only: Sequence[str] = (),
    jobs: int = 1,
    evaluation: EvaluationConfig | None = None,
) -> pd.DataFrame:
    """Score the method on surveys without each of its rules; a study that was stopped goes on.

    Only what a rule touches is done again: a run shares with the baseline the results of all tasks in which
    the answer of the rule never differed from that without it, and of tasks that rest on equal results.
    The second registration is left out: it rests on what was found changed, and would move everything. A rule
    whose answer never differs in the baseline of a survey is not run there, because nothing would change.

    Parameters
    ----------
    surveys : sequence of Path
        Outputs of ``subiaco simulate``, with fused maps. Clouds ``before.ply`` and ``after.ply`` or ``.laz``
        in that folder are compared in place of the maps, with ``before.tum`` and ``after.tum`` if there.
    output : Path
        Scores of every run, ``runs.csv``, ``rules.csv`` and ``rules.md``, written after every run.
    config : ChangeConfig
    progress : callable, optional
    only : sequence of str
        Names of rules; all where empty.
    jobs : int
        Number of runs in parallel.
    evaluation : EvaluationConfig, optional

    Returns
    -------
    DataFrame
        A row a rule: on how many surveys its answer ever differed, its gain in mIoU [percent] and in objects,
        both with 95 % intervals, and what the intervals tell.

    Raises
    ------
    InputError, RegistrationError
    """
    try:
        rules = known_rules(only or RULES)
    except ValueError as error:
        raise InputError(f"--only: {error}") from error
    folders = {_scene(path): output / "runs" / _scene(path) for path in surveys}
    if len(folders) < len(surveys):
        raise InputError("ablate --rules: two surveys have the same name; give each once")
    for path in surveys:
        if not (path / "truth" / "scene.yaml").is_file():
            raise InputError(f"{path}: holds no truth/scene.yaml; give the output of 'subiaco simulate'")
    config = config.model_copy(update={"second_registration": False})
    _begin(output, config)
    bases = [_Job(path, BASELINE, folders[_scene(path)], config) for path in surveys]
    for number, _ in enumerate(_finished(bases, jobs), 1):
        _tell(progress, BASELINE, number / (len(bases) * (len(rules) + 1)))
    tables = StudyTables(output, tuple(folders), rules, evaluation or EvaluationConfig())
    table = tables.write()
    todo = [
        _Job(base.survey, rule, base.folder, config)
        for rule in sorted(rules, key=_first_stage, reverse=True)  # late stages cost least
        for base in bases
        if rule in load_run(base.folder, BASELINE).used
    ]
    for number, job in enumerate(_finished(todo, jobs), 1):
        table = tables.write()
        _tell(progress, job.rule, (len(bases) + number) / (len(bases) + len(todo)))
    return table


def _tell(progress: Callable[[str, float], None] | None, name: str, fraction: float) -> None:
    if progress is not None:
        progress(name, fraction)


def _first_stage(rule: str) -> int:
    """Return the place of the first stage in which a rule acts."""
    return min(STAGES_OF_RULES.index(stage) for stage in RULES[rule].stages)


def _scene(survey: Path) -> str:
    return survey.resolve().name


def _begin(output: Path, config: ChangeConfig) -> None:
    """Make the folder of a study, or find that it is one of this code and these settings."""
    key = fingerprint([source_fingerprint("subiaco_change.config"), config])
    path = output / MARKER
    if path.is_file():
        if json.loads(path.read_text(encoding="utf-8")).get("key") != key:
            raise InputError(f"{output}: holds a study of other code or settings; give another folder")
        return
    if output.exists() and any(output.iterdir()):
        raise InputError(f"{output}: is no folder of a study of rules; give another folder")
    output.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps({"key": key}), encoding="utf-8")


def _finished(jobs: Sequence[_Job], workers: int) -> Iterator[_Job]:
    """Yield jobs as they are finished; those that have a result are not done again."""
    todo = [job for job in jobs if not _result(job.folder, job.rule).is_file()]
    if workers == 1 or len(todo) < 2:
        for job in todo:
            _run(job)
            yield job
        return
    with ProcessPoolExecutor(workers, get_context("forkserver")) as pool:
        futures = {pool.submit(_run, job): job for job in todo}
        for future in as_completed(futures):
            future.result()
            yield futures[future]


def _result(folder: Path, rule: str) -> Path:
    return folder / f"{rule}.npz"


def load_run(folder: Path, rule: str) -> RuleRun:
    """Return the score of a run; that of the baseline where the rule never differed and was not run."""
    path = _result(folder, rule)
    if not path.is_file():
        path = _result(folder, BASELINE)
    with np.load(path, allow_pickle=False) as stored:
        return RuleRun(stored["cells"], stored["objects"], tuple(stored["used"].tolist()))


def _run(job: _Job) -> None:
    """Compare one survey without one rule, and keep the score; the baseline records the rules at work."""
    job.folder.mkdir(parents=True, exist_ok=True)
    store, notes = DiskStore((job.folder / ".stages").absolute()), RuleNotes(job.folder / ".used")
    keys = job.folder / "keys.json"
    if job.rule == BASELINE:
        whole = FullRunner(store, notes)
        score = score_run(_compare(job, job.config, whole), _scene_truth(job.survey))
        score = replace(score, used=tuple(sorted(whole.used)))
        with whole_file(keys) as temporary:
            temporary.write_text(json.dumps(whole.keys), encoding="utf-8")
    else:
        off = known_rules([*job.config.rules_off, *job.rule.split("+")])
        known = json.loads(keys.read_text(encoding="utf-8"))
        partly = PartialRunner(store, notes, known, frozenset(off) - set(job.config.rules_off))
        result = _compare(job, job.config.model_copy(update={"rules_off": off}), partly)
        score = replace(load_run(job.folder, BASELINE), used=())
        if partly.scored_moved:
            score = score_run(result, _scene_truth(job.survey))
    with whole_file(_result(job.folder, job.rule)) as temporary, temporary.open("wb") as stream:
        used = np.array(score.used, dtype="U64")
        np.savez(stream, cells=score.cells, objects=score.objects, used=used)


def _compare(job: _Job, config: ChangeConfig, runner: TaskRunner) -> TiledResult:
    """Compare a survey in this process, with results of stages that an earlier run left."""
    before, after = (open_epoch(*epoch_files(job.survey, epoch)) for epoch in ("before", "after"))
    return detect_in_tiles((before, after), config, runner)


def epoch_files(survey: Path, epoch: str) -> tuple[Path, Path | None]:
    """Return where an epoch lies: a cloud and perhaps a trajectory beside its map, or else the map."""
    clouds = [path for ending in _CLOUDS if (path := survey / f"{epoch}.{ending}").is_file()]
    way = survey / f"{epoch}.tum"
    return (clouds[0] if clouds else survey / epoch), (way if clouds and way.is_file() else None)


@dataclass(frozen=True)
class SceneTruth:
    """Truth of a survey in the frame of *after*: points by epoch, and their cells."""

    points: Mapping[str, Any]
    cells: Any


def scene_truth(truth: SurveyTruth, config: EvaluationConfig | None = None) -> SceneTruth:
    """Bring the truth of a survey to the form that runs are scored with."""
    points = in_after_frame(truth)
    return SceneTruth(points, _rasterised(list(points.values()), config or EvaluationConfig()))


@lru_cache(maxsize=8)
def _scene_truth(survey: Path) -> SceneTruth:
    """Read the truth of a survey: once, for all runs of it in this process."""
    return scene_truth(read_truth(survey))


def score_run(result: TiledResult, truth: SceneTruth, config: EvaluationConfig | None = None) -> RuleRun:
    """Score a comparison by blocks: cells by the published protocol, objects found and wrongly claimed."""
    settings, real, true = config or EvaluationConfig(), truth.points, truth.cells
    whole = result.whole()
    epochs = ((whole.before, real["before"]), (whole.after, real["after"]))
    said = _rasterised([p for p, _ in epochs], settings)
    known = true.codes < 5
    place = np.minimum(np.searchsorted(said.keys, true.keys[known]), len(said.keys) - 1)
    codes = np.where(said.keys[place] == true.keys[known], said.codes[place], int(Change.UNOBSERVED))
    kept = np.where(codes != Change.NOT_REPORTED, true.codes[known], Change.UNOBSERVED)
    cells = tile_matrices(true.keys[known], kept, codes, settings.grid, _BLOCK)
    points = objects.together(*(objects.transfer(p, r, settings.radius) for p, r in epochs))
    return RuleRun(cells, _object_blocks(whole.records, points, real, settings))


def _rasterised(clouds: Sequence[Any], config: EvaluationConfig) -> Any:
    return rasterise(
        np.concatenate([c.world() for c in clouds]),
        np.concatenate([np.asarray(c.fields["change"]).astype(np.int64) for c in clouds]),
        np.repeat([0, 1], [len(c) for c in clouds]),
        config.grid,
    )


def _object_blocks(records: Any, points: objects.PointPairs, real: Any, config: EvaluationConfig) -> Ints:
    """Return changes found less wrong claims of every block (K, 3)."""
    table = pd.DataFrame(
        {
            "object_id": [r.object_id for r in records],
            "label": [r.change.label for r in records],
            "class": [r.semantic.label for r in records],
            "confidence": [r.confidence for r in records],
        }
    )
    claims = objects.changed_rows(objects.row_verdicts(table, points, config.object_share), config.min_points)
    wrong = [int(i) for i in claims.index[(claims["scored"] > 0) & ~claims["right"]]]
    by_id = {r.object_id: r for r in records}
    cloud = joined_truth(real)
    changes = objects.true_changes(cloud, points, config.min_points, config.min_size)
    found = changes.index[changes["found"] >= config.object_share - 1e-9]
    places = [(*_block(by_id[i].x, by_id[i].y), -1) for i in wrong]
    change = np.asarray(cloud.fields["change"]).astype(np.int64)
    keys = np.asarray(cloud.fields["object"]) * 8 + change
    world = cloud.world()
    changed = np.isin(change, CHANGED)
    middles = pd.DataFrame(world[changed, :2], columns=["x", "y"]).groupby(keys[changed]).mean()
    places += [(*_block(*middles.loc[key].tolist()), 1) for key in found]
    if not places:
        return np.zeros((0, 3), dtype=np.int64)
    counted = pd.DataFrame(places, columns=["east", "north", "net"]).groupby(["east", "north"])["net"].sum()
    return np.array([(*where, net) for where, net in counted.items()], dtype=np.int64).reshape(-1, 3)


def _block(x: float, y: float) -> tuple[int, int]:
    return int(np.floor(x / _BLOCK)), int(np.floor(y / _BLOCK))


@dataclass
class StudyTables:
    """Tables of a study in a folder, written again after every run; gains that are known are kept."""

    output: Path
    scenes: tuple[str, ...]
    rules: tuple[str, ...]
    config: EvaluationConfig
    _gains: dict[tuple[str, tuple[str, ...]], dict[str, float]] = field(default_factory=dict)

    def write(self) -> pd.DataFrame:
        """Write the tables as far as the runs are finished; return that of the rules."""
        bases = {scene: load_run(self._folder(scene), BASELINE) for scene in self.scenes}
        rows, every = [], []
        for rule in self.rules:
            used = [scene for scene in self.scenes if rule in bases[scene].used]
            done = [scene for scene in used if _result(self._folder(scene), rule).is_file()]
            single = {scene: self._gain(rule, (scene,), bases) for scene in done}
            every += [{"rule": rule, "scene": scene, **gain} for scene, gain in single.items()]
            row: dict[str, Any] = {"rule": rule, "guards": RULES[rule].guards}
            row |= {"used_on": len(used), "surveys": len(self.scenes)}
            if len(done) < len(used):
                rows.append(row | {"verdict": "not finished"})
                continue
            pooled = self._gain(rule, self.scenes, bases) if used else _NOTHING
            rows.append(row | pooled | {"verdict": _verdict([pooled, *single.values()])})
        table = pd.DataFrame(rows)
        table.to_csv(self.output / TABLE, index=False, lineterminator="\n", float_format="%.3f")
        pd.DataFrame(every).to_csv(self.output / RUNS, index=False, lineterminator="\n", float_format="%.3f")
        (self.output / PAGE).write_text(study_markdown(table), encoding="utf-8")
        return table

    def _folder(self, scene: str) -> Path:
        return self.output / "runs" / scene

    def _gain(self, rule: str, scenes: tuple[str, ...], bases: Mapping[str, RuleRun]) -> dict[str, float]:
        """Return the gain of a rule over some surveys, score with it less that without, and intervals."""
        if (rule, scenes) not in self._gains:
            pairs = [(bases[scene], load_run(self._folder(scene), rule)) for scene in scenes]
            found = block_differences(
                [(base.cells, other.cells) for base, other in pairs],
                [_aligned(base.objects, other.objects) for base, other in pairs],
                self.config.draws,
                self.config.seed,
            )
            self._gains[rule, scenes] = {
                f"{kind}{end}": value
                for kind, values in found.items()
                for end, value in zip(("", "_low", "_high"), values, strict=True)
            }
        return self._gains[rule, scenes]


_NOTHING = {f"{kind}{end}": 0.0 for kind in ("miou", "objects") for end in ("", "_low", "_high")}


def _verdict(gains: Sequence[Mapping[str, float]]) -> str:
    """Say what the intervals of all surveys together, and of each survey where a rule was used, tell."""
    if len(gains) < 2:
        return "never differed"
    pays = any(gain[f"{kind}_low"] > 0 for gain in gains for kind in ("miou", "objects"))
    costs = any(gain[f"{kind}_high"] < 0 for gain in gains for kind in ("miou", "objects"))
    if pays:
        return "mixed" if costs else "pays"
    return "costs" if costs else "no gain shown"


def _aligned(first: Ints, second: Ints) -> Ints:
    """Differences (K,) of the counts of blocks, first less second, over the blocks of both."""
    total: dict[tuple[int, int], int] = {}
    for sign, counts in ((1, first), (-1, second)):
        for east, north, net in counts.tolist():
            total[east, north] = total.get((east, north), 0) + sign * net
    return np.array([total[key] for key in sorted(total)], dtype=np.int64)


def study_markdown(table: pd.DataFrame) -> str:
    """Return the table of a study as Markdown; gains are scores with the rule less those without it."""
    head = ["rule", "surveys where used", "gain in mIoU (95 %)", "gain in objects (95 %)", "verdict"]
    lines = [head, ["---"] * len(head)]
    for row in table.to_dict("records"):
        cells = [str(row["rule"]), f"{row['used_on']} of {row['surveys']}"]
        for kind, digits in (("miou", 2), ("objects", 0)):
            values = [row.get(f"{kind}{end}", float("nan")) for end in ("", "_low", "_high")]
            known = all(np.isfinite(values))
            text = "{:+.{d}f} ({:+.{d}f} to {:+.{d}f})".format(*values, d=digits) if known else "–"
            cells.append(text)
        lines.append([*cells, str(row["verdict"])])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
