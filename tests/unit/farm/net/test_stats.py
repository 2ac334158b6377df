"""Lines of progress.jsonl: the names do not change, so that old files can be read."""

import json

import pytest

from farm.net.stats import GenerationStats

STORED = (
    '{"version": 2, "generation": 2, "rollouts": 24, "return_mean": -5.45, "return_min": -6.5,'
    ' "return_max": -4.25, "return_std": 0.5, "best": -4.25, "baseline": -5.5,'
    ' "mean_policy_return": -5.5, "mean_policy_success": false, "success_rate": 0.25, "sigma_mean":'
    ' 0.77, "sigma_min": 0.5, "sigma_max": 1.5, "mean_norm": 15.0, "ended": 1, "failed": 2,'
    ' "clamped": 3, "reissued": 4, "workers": 5, "seconds": 6.5}'
)
"""As version 2 wrote it; a change of names needs another version."""


def test_a_stored_line_is_read_back() -> None:
    stats = GenerationStats.from_dict(json.loads(STORED))
    assert json.dumps(stats.to_dict()) == STORED
    assert (stats.generation, stats.best, stats.mean_policy_success, stats.seconds) == (
        2,
        -4.25,
        False,
        6.5,
    )


def test_what_a_task_or_an_algorithm_does_not_know_is_none() -> None:
    unknown = dict.fromkeys(("baseline", "mean_policy_success", "success_rate"))
    stats = GenerationStats.from_dict({**json.loads(STORED), **unknown})
    assert (stats.baseline, stats.mean_policy_success, stats.success_rate) == (None, None, None)
    assert GenerationStats.from_dict(stats.to_dict()) == stats


def test_further_fields_do_no_harm() -> None:
    stored = json.loads(STORED)
    assert GenerationStats.from_dict({**stored, "weather": "fine"}) == GenerationStats.from_dict(
        stored
    )


def test_refused() -> None:
    values = json.loads(STORED)
    with pytest.raises(ValueError, match="version 2"):
        GenerationStats.from_dict({**values, "version": 1})
    with pytest.raises(ValueError, match="not a line"):
        GenerationStats.from_dict([])  # type: ignore[arg-type]
    for wrong in ({"best": "high"}, {"generation": 2.5}, {"baseline": []}, {"rollouts": None}):
        with pytest.raises(ValueError, match=f"whose {next(iter(wrong))} is"):
            GenerationStats.from_dict(values | wrong)
    del values["best"], values["workers"]
    with pytest.raises(ValueError, match="without best, workers"):
        GenerationStats.from_dict(values)
