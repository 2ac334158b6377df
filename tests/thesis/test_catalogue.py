"""The experiments of the thesis' reproduction, as data."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from trials import made, rising

from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.claims import features_for
from benchmarks.thesis.experiment import (
    Data,
    judge,
    trial,
    verdict,
)
from benchmarks.thesis.setups import FITTED, SETUPS, config, setup
from farm.errors import ConfigError
from farm.net import keys
from farm.tasks.standard import nominal
from learner.run.config import RunConfig, configure, to_dict
from learner.run.setup import problem


def test_every_experiment_shows_set_ups_that_exist_and_every_set_up_is_shown():
    names = {name for experiment in EXPERIMENTS.values() for name in experiment.curves.values()}
    assert names | {base for base, _ in FITTED.values()} == set(SETUPS) | set(FITTED)
    assert not set(SETUPS) & set(FITTED)


def test_set_ups_are_different_and_their_names_can_be_runs():
    assert all(keys.checked("run", f"{name}-s0") for name in (*SETUPS, *FITTED))
    # A set-up that was learnt once more
    again = {name for name in SETUPS if name.endswith("-30")} | {"object-bar"}
    once = [json.dumps(to_dict(config)) for name, config in SETUPS.items() if name not in again]
    assert len(set(once)) == len(once), "two names for one set-up"


@pytest.mark.parametrize(
    "name", ["joints-D300-30", "object-cylinder", "direct-joints-N5", "cosine-joints-D100"]
)
def test_set_ups_can_be_begun(name):
    assert problem(config(name)).policy.size > 0


def test_a_fitted_start_changes_width_and_first_sigma_or_one_of_them():
    def of(name):
        settings = config(name)
        return settings.policy_config.bandwidth, settings.algorithm_config.initial_sigma

    printed, both = of("contacts-D1500"), of("contacts-D1500-fitted")
    assert printed == (1.0, 2.0)
    assert (of("contacts-D1500-width"), of("contacts-D1500-sigma")) == (
        (both[0], 2.0),
        (1.0, both[1]),
    )
    # d 17, mu 1: sigma = h sqrt(2 / d), and a spread moves the exponent by one.
    assert 17 * both[1] ** 2 / (2 * both[0] ** 2) == pytest.approx(1.0)
    x0 = nominal(problem(config("contacts-D1500")).task)
    assert both[0] == 0.5 * float(np.sqrt(((1.0 - x0) ** 2).sum())), (
        "as when the experiments were made"
    )
    assert replace(
        config("contacts-D1500-fitted"), policy_config=config("contacts-D1500").policy_config
    ) == replace(
        config("contacts-D1500"), algorithm_config=config("contacts-D1500-fitted").algorithm_config
    )


def test_a_set_up_is_its_preset_with_what_is_named_changed():
    changed = setup("thesis", features=7, pairs=3, state="tactile", generations=9)
    assert (changed.policy_config.features, changed.algorithm_config.pairs) == (7, 3)
    assert (changed.task_config.state, changed.generations) == ("tactile", 9)
    assert (
        replace(changed.algorithm_config, pairs=15) == configure(preset="thesis").algorithm_config
    )
    with pytest.raises(ConfigError, match="unknown setting fetures"):
        setup("thesis", fetures=7)


def test_trials_differ_in_their_seed_and_may_be_cut_but_not_stretched():
    run = RunConfig(generations=20)
    assert trial(run, 3) == replace(run, seed=3)
    assert trial(run, 0, 5).generations == 5
    assert trial(run, 0, 50).generations == 20


def test_nothing_is_said_of_a_set_up_without_runs(tmp_path):
    pytest.importorskip("matplotlib")
    from benchmarks.thesis.figures import draw

    experiment = EXPERIMENTS["fig-4.5"]
    nothing = made(np.full((3, 9), np.nan), states=("missing",) * 3, succeeded=np.zeros(3, bool))
    configs = {label: config(name) for label, name in experiment.curves.items()}
    data = Data({"N 50": nothing, "N 15": made(rising(4, -1, 9, 3))}, {}, configs)
    assert judge(experiment, data) == []
    assert verdict([]) == "open"
    svg = draw(experiment, data, tmp_path)[1].read_text()
    assert "N 50: trial 0 missing" in " ".join(re.sub("<[^>]*>", " ", svg).split())


def test_the_features_that_the_thesis_recommends():
    """Plage 2016, table 3.2, up to its rounding; 62 numbers where it says 63, and 594 features
    where it says 560.
    """
    assert [features_for(8, e) for e in (0.1, 0.2, 0.3)] == [1600, 280, 93]
    assert [features_for(17, e) for e in (0.1, 0.2, 0.3)] == [3400, 594, 198]
    assert [features_for(54, e) for e in (0.1, 0.2, 0.3)] == [10800, 1887, 627]
    assert features_for(63, 0.1) == 12600
