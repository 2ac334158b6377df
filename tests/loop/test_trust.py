"""A host with a certificate that lies, over TLS on loopback: what it costs, and that it changes no number."""

import hashlib
import re
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import pole
from rerun.chunk import RrdReader

import farm
from farm import fingerprint
from farm.commands import certificates
from farm.errors import MessageError
from farm.net import codec
from farm.net.messages import WorkRequest
from farm.net.session import Session, connect, free_endpoint, listen
from farm.net.tls import find
from farm.net.work import Failure, Results
from learner.commands import learner as learner_command
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.run.launch import Placement, Run, open_run
from learner.run.states import RolledBack
from learner.scheduler.scheduler import SchedulerConfig
from workers.config import WorkerConfig
from workers.worker import Worker

HOSTS = ("a", "b", "c", "liar")
BOGUS = hashlib.sha256(b"made up").hexdigest()


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates") / "own"
    certificates.main(["new", str(folder), "--learner", "127.0.0.1", *(w for h in HOSTS for w in ("--worker", h))])
    return folder


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    file = pole(tmp_path_factory.mktemp("task") / "mine")
    return configure(f"{file}:Pole", generations=6, pairs=6, initial_sigma=0.5)


Forge = Callable[[Any], Any]


class Forging:
    """A session whose requests and results are changed on their way out; `sent` is set by the first one."""

    def __init__(self, session: Session, forge: Forge) -> None:
        self._session, self._forge, self.sent = session, forge, threading.Event()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def publish(self, key: str, payload: bytes, **how: bool) -> None:
        for kind in (WorkRequest, Results):
            with suppress(MessageError):
                payload = codec.encode(self._forge(codec.decode(payload, kind)))
                break
        self._session.publish(key, payload, **how)
        self.sent.set()


@contextmanager
def host(endpoint: str, certs: Path, name: str, file: Path, forge: Forge = lambda said: said) -> Iterator[None]:
    """A host with this certificate, on a thread; it has asked for work when this returns."""
    config = WorkerConfig(connect=(endpoint,), tls=certs, name=name, allow_file=(file,))
    stop, asked, failed = threading.Event(), threading.Event(), list[BaseException]()

    def serve() -> None:
        try:
            with connect(config.connect, None, stop.is_set, config.bundle) as session:
                forging = Forging(session, forge)
                worker = Worker(config, forging)  # type: ignore[arg-type]
                worker.join()
                while not stop.is_set():
                    worker.turn()
                    if forging.sent.is_set():
                        asked.set()
        except BaseException as error:
            failed.append(error)
            asked.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert asked.wait(30)
        assert not failed, failed
        yield
    finally:
        stop.set()
        thread.join(20)


def tls() -> str:
    return free_endpoint().replace("tcp/", "tls/")


@contextmanager
def opened(config: RunConfig, path: Path, place: Placement, *, resume: bool = False) -> Iterator[Run]:
    with open_run(config, path, place, resume=resume) as run:
        yield run


def finished(run: Run) -> str:
    """Learn to the end; the hash."""
    for _ in run.learn():
        pass
    assert run.summary["state"] == "finished"
    return run.summary["parameters_sha256"]


@pytest.fixture(scope="module")
def honest(certs: Path, config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the run by one honest host."""
    place, folder = Placement(listen=tls(), tls=find(certs, "learner"), record=False), tmp_path_factory.mktemp("honest")
    with opened(config, folder / "honest", place) as run, host(place.listen, certs, "a", file_of(config)):
        return finished(run)


def file_of(config: RunConfig) -> Path:
    return Path(config.task.rpartition(":")[0])


def without_simulating(said: Any) -> Any:
    """Another canary, and returns that are made up."""
    if isinstance(said, WorkRequest):
        return replace(said, canary=BOGUS)
    return replace(said, returns=np.full_like(said.returns, 1000.0))


def admitted(run: Run) -> set[str]:
    return {worker.partition("/")[0] for worker in run.dispatcher.workers}


def refused(caplog: pytest.LogCaptureFixture) -> set[str]:
    """Hosts that the learner refused."""
    found = (re.match(r"worker (\w+)/\S+ is refused", line) for line in caplog.messages)
    return {each[1] for each in found if each}


def test_a_made_up_canary_shuts_out_nobody(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = Placement(listen=tls(), tls=find(certs, "learner"), record=False)
    file = file_of(config)
    with opened(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, without_simulating))
        for name in "ab":
            hosts.enter_context(host(place.listen, certs, name, file))
        assert finished(run) == honest
        assert admitted(run)
    assert refused(caplog) == {"liar"}
    assert run.learner.canary == fingerprint.digest()


def test_hosts_that_wait_at_a_router_are_not_shut_out(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, bundle, file = tls(), find(certs, "learner"), file_of(config)
    place = Placement(connect=(endpoint,), tls=bundle, record=False)
    waiting = [host(endpoint, certs, "liar", file, without_simulating), *(host(endpoint, certs, n, file) for n in "ab")]
    with listen(endpoint, "farm", bundle), ExitStack() as hosts:
        with ThreadPoolExecutor(len(waiting)) as together:  # each asks only when it has been idle for a while
            list(together.map(hosts.enter_context, waiting))
        with opened(config, tmp_path / "r", place) as run:
            assert finished(run) == honest
            assert admitted(run)
    assert refused(caplog) == {"liar"}


def test_a_resumed_run_keeps_whose_numbers_count(certs: Path, config: RunConfig, honest: str, tmp_path: Path) -> None:
    file = file_of(config)
    place = Placement(listen=tls(), tls=find(certs, "learner"), record=False)
    with opened(replace(config, generations=3), tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, without_simulating))
        hosts.enter_context(host(place.listen, certs, "a", file))
        finished(run)
    place = replace(place, listen=tls())
    with opened(config, tmp_path / "r", place, resume=True) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, without_simulating))
        hosts.enter_context(host(place.listen, certs, "b", file))
        assert finished(run) == honest
        assert admitted(run) == {"b"}
        assert run.learner.canary == fingerprint.digest()


def test_the_user_may_say_whose_numbers_count(certs: Path, config: RunConfig, tmp_path: Path) -> None:
    file = file_of(config)
    place = Placement(listen=tls(), tls=find(certs, "learner"), record=False, numbers=BOGUS[:8])
    with opened(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "a", file))
        hosts.enter_context(
            host(
                place.listen, certs, "b", file, lambda s: replace(s, canary=BOGUS) if isinstance(s, WorkRequest) else s
            )
        )
        finished(run)
        assert admitted(run) == {"b"}


def shifted(change: Callable[[np.ndarray], np.ndarray]) -> Forge:
    return lambda said: said if isinstance(said, WorkRequest) else replace(said, returns=change(said.returns))


LIES = {
    "the last bit": shifted(lambda values: np.nextafter(values, np.inf)),
    "one percent": shifted(lambda values: 0.99 * values),
}


def checked(listening: str, certs: Path, part: float = 1.0) -> Placement:
    return Placement(listen=listening, tls=find(certs, "learner"), record=False, scheduler=SchedulerConfig(audit=part))


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_the_learners_own_machine_decides_between_two_hosts(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, lie: Forge
) -> None:
    place, file = checked(tls(), certs), file_of(config)
    with opened(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        for name, forge in (("liar", lie), ("a", lambda said: said)):
            hosts.enter_context(host(place.listen, certs, name, file, forge))
        assert finished(run) == honest
    assert "host liar gave different numbers than this machine" in caplog.text
    assert refused(caplog) == {"liar"}


def test_what_no_second_host_can_check_is_checked_before_the_result_is_final(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place, file = checked(tls(), certs, 0.02), file_of(config)
    with opened(config, tmp_path / "honest-alone", place) as run, host(place.listen, certs, "a", file):
        assert finished(run) == honest
    assert run.summary["checks"] == {"a": 1}
    place = checked(tls(), certs, 0.02)
    with (
        opened(config, tmp_path / "liar-alone", place) as run,
        host(place.listen, certs, "liar", file, LIES["the last bit"]),
        pytest.raises(RolledBack, match="the run goes back to generation 0, before the first answer of"),
    ):
        finished(run)
    assert run.summary["state"] == "interrupted"
    assert list(checkpoints.load(run.learner.folder.checkpoint).expelled) == ["liar"]
    with opened(config, tmp_path / "liar-alone", place, resume=True) as run, host(place.listen, certs, "a", file):
        assert finished(run) == honest


def test_a_mixed_run_says_which_host_nobody_can_check(
    certs: Path, config: RunConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def alone(said: Any) -> Any:
        return replace(said, canary=BOGUS) if isinstance(said, WorkRequest) else LIES["the last bit"](said)

    place, file = replace(checked(tls(), certs, 0.02), mixed=True), file_of(config)
    with opened(config, tmp_path / "r", place) as run, host(place.listen, certs, "liar", file, alone):
        finished(run)
    assert run.summary["checks"] == {"liar": 0}
    assert "the last answers of host liar are unchecked" in caplog.text


def test_hosts_that_only_say_that_jobs_fail_stop_no_run(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place, file, liars = checked(tls(), certs, 0.0), file_of(config), ("b", "c", "liar")
    failed, everywhere = defaultdict[int, set[str]](set), threading.Event()

    def failing(said: Results) -> Failure:
        job = int(said.jobs[0])
        failed[job].add(said.worker)
        if len(failed[job]) == len(liars):
            everywhere.set()
        where = {"run": said.run, "incarnation": said.incarnation, "round": said.round, "worker": said.worker}
        return Failure(**where, index=job, error="ValueError: made up")

    with opened(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        for name in liars:
            hosts.enter_context(host(place.listen, certs, name, file, Late(failing, 2)))
        with ThreadPoolExecutor(1) as pool:
            learnt = pool.submit(finished, run)
            assert everywhere.wait(30)
            hosts.enter_context(host(place.listen, certs, "a", file))
            assert learnt.result(60) == honest
    told = (re.match(r"worker (\w+)/\S+ does not serve this run: it failed at job", line) for line in caplog.messages)
    assert {each[1] for each in told if each} == set(liars)


def test_a_pool_checks_a_lone_host_before_it_gives_out_returns(certs: Path, config: RunConfig) -> None:
    endpoint, file = tls(), file_of(config)
    with listen(endpoint, "farm", find(certs, "learner")), ExitStack() as hosts:
        pool = hosts.enter_context(farm.Farm(config.task, connect=endpoint, tls=certs))
        thetas = np.random.default_rng(0).normal(size=(5, pool.size))
        with farm.Farm(config.task, workers=1) as own:
            right = own.map(thetas, seeds=range(5))
        came = pool.imap(thetas, seeds=range(5))
        liar = hosts.enter_context(ExitStack())
        liar.enter_context(host(endpoint, certs, "liar", file, LIES["the last bit"]))
        wrong = [next(came) for _ in range(5)]
        hosts.enter_context(host(endpoint, certs, "a", file))
        assert dict(came) == dict(enumerate(right.tolist())), "later returns count"
        assert all(value != right[index] for index, value in wrong)
        assert pool.map(thetas, seeds=range(5)).tobytes() == right.tobytes()


class Late:
    """Results that are changed from the `begin`th on, if `which` says so."""

    def __init__(self, lie: Forge, begin: int, which: Callable[[int], bool] = lambda _: True) -> None:
        self.lie, self.begin, self.which, self.sent = lie, begin, which, 0

    def __call__(self, said: Any) -> Any:
        if isinstance(said, Results):
            self.sent += 1
            if self.sent >= self.begin and self.which(self.sent):
                return self.lie(said)
        return said


def all_but_the_best(values: np.ndarray) -> np.ndarray:
    return np.where(values == values.max(), values, values - 0.01 * abs(values))


UNDONE = {
    "the last bit": Late(LIES["the last bit"], 4),
    "one percent": Late(LIES["one percent"], 4),
    "one message in three": Late(LIES["the last bit"], 4, lambda sent: sent % 3 == 0),
    "all but its best": Late(shifted(all_but_the_best), 4),
}


@pytest.mark.parametrize("lie", UNDONE.values(), ids=UNDONE)
def test_a_liar_costs_time_and_no_number(
    certs: Path, config: RunConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture, lie: Late
) -> None:
    """The liar is alone at first, so that its lies are in the state when the second host comes."""
    config, file = replace(config, generations=12), file_of(config)
    place = checked(tls(), certs)
    with opened(config, tmp_path / "honest", place) as run, host(place.listen, certs, "a", file):
        honest = finished(run)
    place, rows, hosts = checked(tls(), certs), list[int](), ExitStack()
    joining, answered = threading.Event(), threading.Event()

    def waiting(said: Any) -> Any:
        if joining.is_set():  # the second host builds the task first, which takes longer than the run
            answered.wait(30)
        return lie(said)

    def answering(said: Any) -> Any:
        if isinstance(said, Results):
            answered.set()
        return said

    with hosts:
        with opened(config, tmp_path / "r", place) as run:
            hosts.enter_context(host(place.listen, certs, "liar", file, waiting))
            learning = run.learn()
            rows.extend(next(learning).generation for _ in range(6))  # at least one lie is in them
            joining.set()
            hosts.enter_context(host(place.listen, certs, "a", file, answering))
            with pytest.raises(RolledBack):
                rows.extend(report.generation for report in learning)
        assert rows[-1] >= 6
        with opened(config, tmp_path / "r", place, resume=True) as run:
            assert run.learner.state.generation == 0, "the liar answered in the first generation"
            assert finished(run) == honest
    lines = run.learner.folder.progress()
    assert [line.generation for line in lines] == list(range(1, 13)), "none is doubled"
    assert [line.rollouts for line in lines] == [12 * each for each in range(1, 13)]
    assert run.summary["undone"] == rows[-1]
    assert refused(caplog) == {"liar"}
    assert len(run.learner.folder.parameters.rows()) == 12


def test_a_run_goes_back_no_further_than_the_liars_first_answer(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place, file = checked(tls(), certs), file_of(config)
    with opened(replace(config, generations=3), tmp_path / "r", place) as run, host(place.listen, certs, "a", file):
        finished(run)
    place = checked(tls(), certs)
    with opened(config, tmp_path / "r", place, resume=True) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, LIES["the last bit"]))
        with pytest.raises(RolledBack, match="generation 3,"):
            finished(run)
    place = checked(tls(), certs)
    with opened(config, tmp_path / "r", place, resume=True) as run, host(place.listen, certs, "a", file):
        assert run.learner.state.generation == 3
        assert finished(run) == honest
    assert sorted(each.name for each in (tmp_path / "r" / "states").iterdir()) == ["0", "3"]


def test_an_expelled_host_is_not_admitted_by_a_resume(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place, file, lie = checked(tls(), certs), file_of(config), LIES["the last bit"]
    with opened(replace(config, generations=3), tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, lie))
        hosts.enter_context(host(place.listen, certs, "a", file))
        finished(run)
    kept = checkpoints.load(run.learner.folder.checkpoint).expelled
    assert list(kept) == ["liar"]
    caplog.clear()
    place = checked(tls(), certs, 0.0)
    with opened(config, tmp_path / "r", place, resume=True) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, lie))
        hosts.enter_context(host(place.listen, certs, "a", file))
        assert finished(run) == honest
    assert refused(caplog) == {"liar"}
    assert f"is refused: {kept['liar']}" in caplog.text


def test_an_expulsion_is_saved_before_the_generation_ends(certs: Path, config: RunConfig, tmp_path: Path) -> None:
    place, file = checked(tls(), certs), file_of(config)
    with opened(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        learner, saved = run.learner, list[tuple[int, list[str]]]()
        save = type(learner.folder).save

        def noted(folder: RunFolder, at: Checkpoint, **how: bool) -> None:
            save(folder, at, **how)
            saved.append((at.state["generation"], list(checkpoints.load(folder.checkpoint).expelled)))

        hosts.enter_context(host(place.listen, certs, "liar", file, LIES["one percent"]))
        hosts.enter_context(host(place.listen, certs, "a", file))
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(RunFolder, "save", noted)
            finished(run)
    first = next(at for at, (_, expelled) in enumerate(saved) if expelled)
    before, after = saved[first - 1] if first else (0, []), saved[first]
    assert after[0] == before[0], "it is saved with the state from before the generation under way"


def test_the_command_goes_on_by_itself_and_no_generation_is_recorded_twice(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, bundle, file = tls(), find(certs, "learner"), file_of(config)
    monkeypatch.chdir(tmp_path)
    words = [*configs.flags(config), "--connect", endpoint, "--tls", str(certs / "learner"), "--audit", "1"]
    lied, hosts = threading.Event(), ExitStack()

    def lie(said: Any) -> Any:
        if isinstance(said, Results) and said.round > 3:
            lied.set()
            return LIES["the last bit"](said)
        return said

    def come() -> None:
        assert lied.wait(30)
        hosts.enter_context(host(endpoint, certs, "a", file))

    with listen(endpoint, "farm", bundle), hosts:
        hosts.enter_context(host(endpoint, certs, "liar", file, lie))
        coming = threading.Thread(target=come)
        coming.start()
        assert learner_command.main([*words, "--name", "r", "--quiet"]) == 0
        coming.join()
    folder = RunFolder(tmp_path / "runs" / "r")
    summary = folder.read_summary()
    assert summary is not None
    assert (summary["parameters_sha256"], summary["generations"], summary["state"]) == (honest, 6, "finished")
    assert summary["undone"] > 0
    assert generations(folder.recording) == list(range(1, 7))
    assert generations(folder.path / "undone.rrd") == list(range(1, summary["undone"] + 1))
    assert "the run goes back to generation 0" in (folder.path / "log.txt").read_text()


def generations(path: Path) -> list[int]:
    """Those with a return in a recording, each as often as it is there."""
    chunks = (chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == "/learning/return")
    batches = [batch for batch in chunks if "generation" in batch.schema.names]
    return sorted(number for batch in batches for number in batch.column("generation").cast("int64").to_pylist())
