"""The ablation command on fused simulated maps (preset easy, seed 3)."""

from __future__ import annotations

import pandas as pd
import pytest

MIOU = "miou"


def test_variants_are_run_and_scored_beside_the_full_method(command, survey_of_both, tmp_path):
    maps = [survey_of_both / "before", survey_of_both / "after", survey_of_both]
    chosen = ["--only", "without objects", "--registration", "identity"]
    ran = command("ablate", *maps, "-o", tmp_path / "out", *chosen)
    assert ran.code == 0, ran.err
    rows = pd.read_csv(tmp_path / "out" / "ablations.csv").set_index("variant")
    assert list(rows.index) == ["full", "without objects"]
    assert rows[MIOU].between(0, 100).all()
    assert "| without objects |" in ran.out
    for name in ("full", "without_objects"):
        assert (tmp_path / "out" / name / "0" / "changes.csv").is_file()


def test_an_unknown_variant_or_a_missing_truth_is_refused(refused, survey_of_both, tmp_path):
    maps = [survey_of_both / "before", survey_of_both / "after"]
    refused(["ablate", *maps, "-o", tmp_path / "out"], "in threes")
    refused(
        ["ablate", *maps, survey_of_both, "-o", tmp_path / "out", "--only", "magic"],
        "'magic': not known",
        "Decision 13 reverted",
    )


@pytest.mark.slow
def test_a_rule_that_is_switched_off_is_scored_against_the_full_method(command, survey_of_both, tmp_path):
    ran = command("ablate", "--rules", survey_of_both, "-o", tmp_path / "out", "--only", "closed_gaps")
    assert ran.code == 0, ran.err
    rows = pd.read_csv(tmp_path / "out" / "rules.csv").set_index("rule")
    assert list(rows.index) == ["closed_gaps"]
    assert rows.loc["closed_gaps", "verdict"] in ("never differed", "no gain shown", "pays", "costs", "mixed")
    assert "| closed_gaps |" in ran.out
    again = command("ablate", "--rules", survey_of_both, "-o", tmp_path / "out", "--only", "closed_gaps")
    assert again.out == ran.out


def test_a_name_that_is_no_rule_is_refused(refused, survey_of_both, tmp_path):
    refused(
        ["ablate", "--rules", survey_of_both, "-o", tmp_path / "out", "--only", "closed_gap"],
        "did you mean closed_gaps",
    )
    refused(["ablate", "--rules", survey_of_both, "-o", tmp_path / "out", "--overwrite"], "leave them out")
