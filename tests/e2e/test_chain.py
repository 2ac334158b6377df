"""`farm chain`: learnt gaits in turn, from the command line."""

import json

import pytest
from processes import Farm
from recordings import read

pytestmark = pytest.mark.slow

GAITS = ("middle-on", "index-off", "index-on", "middle-off")


def test_four_gaits_go_round(farm: Farm) -> None:
    flags = ("--policy", "constant", "--initial-sigma", "0.2", "--generations", "15", "--no-record")
    for gait in GAITS:
        farm.call("run", "--preset", gait, "--name", gait, *flags)
        assert farm.summary(gait)["robust_success_rate"] >= 0.95
    runs = [f"runs/{gait}" for gait in GAITS]
    results = json.loads(farm.call("chain", *runs, "--starts", "5", "--steps", "100", "--json"))
    assert (results["starts"], results["steps"]) == (5, 100)
    assert results["cycles_at_least"]["1"] == 1.0
    assert results["changes_min"] >= 4
    again = json.loads(farm.call("chain", *runs, "--starts", "5", "--steps", "100", "--json"))
    assert again == results
    output = farm.call(
        "chain", *runs, "--starts", "2", "--steps", "30", "--shown", "20", "--video", "film.gif"
    )
    assert "4 policies in turn, 2 perturbed starts" in " ".join(output.split())
    assert "written to chain.rrd" in output
    assert (farm.folder / "film.gif").stat().st_size > 10_000
    entities = read(farm.folder / "chain.rrd")
    assert any("tactile" in str(entity) for entity in entities), "what was felt is in the recording"


def test_gaits_that_do_not_fit_are_named(farm: Farm) -> None:
    flags = ("--policy", "constant", "--generations", "1", "--no-record")
    farm.call("run", "--preset", "middle-on", "--name", "a", *flags)
    farm.call("run", "--preset", "index-on", "--name", "b", *flags)
    farm.call("run", "--preset", "middle-off", "--pose", "opposed", "--name", "c", *flags)
    output = farm.call("chain", "runs/a", "runs/b", status=2)
    assert (
        "a policy that ends in index+middle+thumb is not followed by one from middle+thumb: give"
        " runs of" in output
    )
    assert len(output.splitlines()) == 1
    output = farm.call("chain", "runs/a", "runs/c", status=2)
    assert "simulate different models: learn both on the same one" in " ".join(output.split())
