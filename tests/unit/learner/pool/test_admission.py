"""Which workers a run admits."""

from farm.net.messages import WorkRequest
from learner.pool.admission import Admission


def want(worker: str = "a/1", credits: int = 4, fingerprint: str = "bits") -> WorkRequest:
    return WorkRequest(
        worker=worker,
        credits=credits,
        idle=(),
        version="7.7",
        fingerprint=fingerprint,
        host="h",
        cores=2,
    )


def test_a_device_is_admitted_among_mixed_machines() -> None:
    assert "it is a device" in str(Admission("bits").refusal(want(fingerprint="")))
    assert Admission("bits", any_rounding=True).refusal(want(fingerprint="")) is None


def test_only_machines_with_the_runs_numbers_are_admitted() -> None:
    for reference in ("bits", "bi"):
        admission = Admission(reference)
        assert admission.refusal(want()) is None
        reason = str(admission.refusal(want(fingerprint="others")))
        assert f"(fingerprint others, the run's is {reference}:" in reason
        assert "--fingerprint others" in reason
        assert "--any-rounding" in reason


def test_mixed_machines_on_request() -> None:
    admission = Admission("bits", any_rounding=True)
    assert admission.refusal(want(fingerprint="others")) is None
    assert admission.fingerprint == "bits"


def test_no_worker_of_an_expelled_host_is_admitted() -> None:
    admission = Admission("bits", {"a": "it lies"})
    assert admission.refusal(want("a/3")) == "it lies"
    assert admission.refusal(want("b/1")) is None
