"""The learning curves of a run."""

from made import report, stats

from learner.recording.curves import statistics


def sigma(mean: float) -> list[float]:
    """Mean, least and greatest sigma, as they are drawn."""
    told = report(stats(sigma_mean=mean, sigma_min=0.1, sigma_max=0.1))
    [column] = [each for each in statistics([told]) if each.entity == "/learning/sigma"]
    [values] = [part.as_arrow_array().to_pylist() for part in column.columns]
    return list(values[0])


def test_a_rounded_mean_is_no_curve_of_its_own() -> None:
    assert sigma(0.1) == [0.1, 0.1, 0.1]
    assert sigma(0.10000000000000002) == [0.1, 0.1, 0.1]
    assert sigma(0.09999999999999999) == [0.1, 0.1, 0.1]
