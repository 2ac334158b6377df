"""A worker with a certificate says in one line that what listens does not admit it."""

from pathlib import Path

import pytest
from stage import FARM, WAIT, until

from farm.commands import certificates
from farm.net import keys
from farm.net.session import connect, free_endpoint, listen
from farm.net.tls import find
from workers import worker as workers
from workers.config import WorkerConfig

pytest.importorskip("cryptography")


def test_a_name_that_the_roster_lacks_is_told_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(workers, "_LOOK", 0.0)
    certs = tmp_path / "certs"
    certificates.main(["new", str(certs), "--learner", "127.0.0.1", "--worker", "known"])
    authority = certificates.Authority.load(certs / "ca")
    authority.issue(certs / "worker-late", "worker", "late", 1, ())
    endpoint = free_endpoint().replace("tcp/", "tls/")

    def joined(name: str, session) -> workers.Worker:
        bundle = certs / f"worker-{name}"
        config = WorkerConfig(connect=(endpoint,), tls=bundle, farm=FARM)
        worker = workers.Worker(config, session)
        worker.join()
        return worker

    with listen(endpoint, FARM, find(certs, "learner")) as learner:
        learner.token(keys.learner_token(FARM, "r"))
        with connect((endpoint,), WAIT, lambda: False, find(certs, "worker", "known")) as session:
            worker = joined("known", session)
            until(lambda: (worker.turn(), worker.inbox.runs)[1])
            assert caplog.messages == []
            learner._tokens.pop().undeclare()
            until(lambda: (worker.turn(), not worker.inbox.runs)[1])
            worker.turn()
            assert caplog.messages == [], "it was admitted: its learner has left"
        learner.token(keys.learner_token(FARM, "r"))
        with connect((endpoint,), WAIT, lambda: False, find(certs, "worker", "late")) as session:
            worker = joined("late", session)
            until(lambda: (worker.turn(), caplog.messages)[1])
    [line] = caplog.messages
    assert "does not admit late" in line
    assert "farm certificates add CERTS --worker late" in line
    assert "--resume RUN" in line
