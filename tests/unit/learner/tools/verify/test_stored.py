"""Verifying runs: whatever was altered, cut or exchanged in a folder is named with its first
generation.
"""

import json
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, Alone, taken_up

from farm.__main__ import main
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run import hash_chain, setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner
from learner.tools.replay import rewind
from learner.tools.verify import command
from learner.tools.verify.stored import Differs, stored
from learner.tools.verify.verify import chosen, verify_some, workers

GENERATIONS = 6


@pytest.fixture(autouse=True)
def _own_secret(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the secret of receipts out of the home of whoever runs the tests."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))


SETTINGS = (
    {},
    {"policy": "linear", "algorithm": "snes", "normalise": True},
    {"policy": "linear", "algorithm": "cma-es", "population": 6, "episodes": 2},
)


def learnt(path: Path, seed: int = 0, **settings: object) -> RunFolder:
    path.parent.mkdir(exist_ok=True)
    (path.parent / "pole.py").write_text(POLE)
    config = configure(
        f"{path.parent / 'pole.py'}:Pole", generations=GENERATIONS, seed=seed, **settings
    )
    problem, at = setup.start(config, path.name)
    learner = Learner(problem, RunFolder.create(path, config), at)
    for _ in learner.learn(Alone(problem)):  # type: ignore[arg-type]
        pass
    learner.folder.write_summary(learner.summary("interrupted", 1, None))
    return learner.folder


def verified(
    folder: RunFolder, generations: Sequence[int] = range(1, GENERATIONS + 1)
) -> list[int]:
    run = stored(folder)
    with workers(run, None, lambda: False) as simulate:
        return [generation for generation, _ in verify_some(run, generations, simulate)]


def forged(folder: RunFolder) -> None:
    """Give the altered files a chain of their own."""
    at, config = checkpoints.load(folder.checkpoint), folder.read_config()
    entries, before = folder.chain.read(), hash_chain.first(config)
    lines = {line.generation: line for line in folder.progress()}
    rows = {int(row["generation"]): row for row in folder.parameters.rows()}
    (folder.path / "chain").unlink()
    for generation, entry in entries.items():
        row = rows[generation]
        state = hash_chain.state_of(at) if generation == len(entries) else entry.state
        before = hash_chain.following(
            before, lines[generation], row["mu"], row["sigma"], np.empty((2, 0)), state
        )
        folder.chain.append(generation, hash_chain.ChainEntry(before, state))
    checkpoints.save(folder.checkpoint, replace(at, chain=before, config=configs.to_dict(config)))
    folder.write_summary((folder.read_summary() or {}) | {"chain": before, "seed": config.seed})


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda each: each.get("algorithm", "default"))
def test_an_honest_run_is_verified(tmp_path: Path, settings: dict[str, object]) -> None:
    folder = learnt(tmp_path / "r", **settings)
    assert verified(folder) == list(range(1, GENERATIONS + 1))


def test_as_many_generations_as_asked_for_are_chosen_and_none_twice(tmp_path: Path) -> None:
    run, rng = stored(learnt(tmp_path / "r")), np.random.default_rng(1)
    assert chosen(run, 1.0, rng) == [1, 2, 3, 4, 5, 6]
    assert len(chosen(run, 0.01, rng)) == 1
    assert len({tuple(chosen(run, 0.5, rng)) for _ in range(50)}) > 5


def one_digit(folder: RunFolder) -> None:
    lines = (folder.path / "progress.jsonl").read_text().splitlines()
    line = json.loads(lines[3])
    line["return_max"] = float(np.nextafter(line["return_max"], np.inf))
    lines[3] = json.dumps(line)
    (folder.path / "progress.jsonl").write_text("\n".join(lines) + "\n")


def cut(folder: RunFolder) -> None:
    lines = (folder.path / "progress.jsonl").read_text().splitlines(keepends=True)
    (folder.path / "progress.jsonl").write_text("".join(lines[:3] + lines[4:]))


def exchanged(folder: RunFolder) -> None:
    lines = (folder.path / "progress.jsonl").read_text().splitlines(keepends=True)
    (folder.path / "progress.jsonl").write_text("".join([*lines[:3], lines[4], lines[3], lines[5]]))


def of_another_run(folder: RunFolder) -> None:
    other = learnt(folder.path.with_name("other"), seed=1)
    (folder.path / "progress.jsonl").write_bytes((other.path / "progress.jsonl").read_bytes())


def in_parameters(folder: RunFolder) -> None:
    """The mean after generation 3, from which generation 4 explored."""
    content = bytearray((folder.path / "parameters").read_bytes())
    row = folder.parameters.rows().dtype.itemsize
    at = len(content) - (GENERATIONS - 2) * row + 8 * 2  # the second number of the third row's mean
    content[at] ^= 1
    (folder.path / "parameters").write_bytes(content)


def a_row_of_parameters(folder: RunFolder) -> None:
    content = (folder.path / "parameters").read_bytes()
    row = folder.parameters.rows().dtype.itemsize
    (folder.path / "parameters").write_bytes(content[:-row])


def in_the_checkpoint(folder: RunFolder) -> None:
    at = checkpoints.load(folder.checkpoint)
    mu = at.state["mu"].copy()
    mu[1] = np.nextafter(mu[1], np.inf)
    checkpoints.save(folder.checkpoint, replace(at, state=at.state | {"mu": mu}))


def in_the_configuration(folder: RunFolder) -> None:
    config = json.loads((folder.path / "config.json").read_text())
    config["seed"] = 7
    (folder.path / "config.json").write_text(json.dumps(config))


def in_the_summary(folder: RunFolder) -> None:
    summary = folder.read_summary()
    assert summary is not None
    folder.write_summary(summary | {"parameters_sha256": "0" * 64})


def in_a_result_of_the_summary(folder: RunFolder) -> None:
    summary = folder.read_summary()
    assert summary is not None
    folder.write_summary(summary | {"best_return": 99.0})


def in_the_rollouts_of_the_summary(folder: RunFolder) -> None:
    summary = folder.read_summary()
    assert summary is not None
    folder.write_summary(summary | {"state": "failed", "rollouts": 10**6})


def a_damaged_summary(folder: RunFolder) -> None:
    (folder.path / "summary.json").write_text('{"state": "finished"')


def another_link(folder: RunFolder) -> None:
    """Two digests of the chain, exchanged."""
    lines = (folder.path / "chain").read_text().splitlines()
    (one, two, a), (four, five, b) = lines[1].split(), lines[3].split()
    lines[1], lines[3] = f"{one} {five} {b}", f"{four} {two} {a}"
    (folder.path / "chain").write_text("\n".join(lines) + "\n")


def a_cut_chain(folder: RunFolder) -> None:
    lines = (folder.path / "chain").read_text().splitlines(keepends=True)
    (folder.path / "chain").write_text("".join(lines[:2]))


def another_count(folder: RunFolder) -> None:
    """In the checkpoint, where neither progress nor parameters have it."""
    at = checkpoints.load(folder.checkpoint)
    checkpoints.save(folder.checkpoint, replace(at, steps=at.steps + 1))


IN_CHAIN = (
    "generation {} differs: progress.jsonl or parameters, or what is before it, have another digest"
    " in chain"
)
ALTERED: dict[Callable[[RunFolder], None], str] = {
    one_digit: IN_CHAIN.format(4),
    cut: "generation 4 differs: progress.jsonl has no line of it",
    exchanged: "generation [45] differs: progress.jsonl has no line of it",
    of_another_run: "generation 1 differs: ",
    in_parameters: IN_CHAIN.format(3),
    a_row_of_parameters: "generation 6 differs: parameters has no row of it",
    in_the_checkpoint: r"generation 6 differs: mu\[1\] is .* in parameters, and .* in checkpoint",
    another_count: "generation 6 differs: checkpoint is not the one that chain says",
    in_the_configuration: "generation 1 differs: --seed is 7 in config.json, and 0 in checkpoint",
    another_link: IN_CHAIN.format(2),
    in_a_result_of_the_summary: (
        r"best_return is 99\.0 in summary.json, and .* by the run's other files"
    ),
    in_the_rollouts_of_the_summary: (
        "rollouts is 1000000 in summary.json, and 48 by the run's other files"
    ),
    a_damaged_summary: "summary.json is damaged",
    a_cut_chain: "generation 3 differs: chain has no line of it",
    in_the_summary: (
        "parameters_sha256 is '0000.*' in summary.json, and .* by the run's other files"
    ),
}
FORGED: dict[Callable[[RunFolder], None], str] = {
    one_digit: (
        "generation 4 differs: return_max is .* in progress.jsonl, and .* when it is repeated"
    ),
    in_parameters: "generation 4 differs: .* in progress.jsonl, and .* when it is repeated",
    in_the_configuration: "generation 1 differs: .* when it is repeated",
}


@pytest.mark.parametrize("alter", ALTERED, ids=lambda each: each.__name__)
def test_what_was_altered_is_named_before_anything_is_repeated(
    tmp_path: Path, alter: Callable[[RunFolder], None]
) -> None:
    folder = learnt(tmp_path / "r")
    alter(folder)
    with pytest.raises(Differs, match=ALTERED[alter]):
        stored(folder)


@pytest.mark.parametrize("alter", FORGED, ids=lambda each: each.__name__)
def test_what_was_altered_with_its_chain_is_named_when_it_is_repeated(
    tmp_path: Path, alter: Callable[[RunFolder], None]
) -> None:
    folder = learnt(tmp_path / "r")
    alter(folder)
    forged(folder)
    with pytest.raises(Differs, match=FORGED[alter]):
        verified(folder)


def test_the_chain_is_of_the_settings_and_not_of_machines(tmp_path: Path) -> None:
    one, two = learnt(tmp_path / "a" / "r"), learnt(tmp_path / "b" / "other")
    assert (one.path / "chain").read_bytes() == (two.path / "chain").read_bytes()
    assert one.chain.read() != learnt(tmp_path / "c", seed=1).chain.read()


def test_the_command_says_it_and_writes_a_receipt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = learnt(tmp_path / "r")
    rollouts = folder.progress()[-1].rollouts
    assert main(["verify", "r", "--share", "1", "--receipt", "receipt.json"]) == 0
    assert (
        f"verified to the bit: 6 of 6 generations of r, {rollouts} rollouts"
        in capsys.readouterr().out
    )
    receipt = json.loads(Path("receipt.json").read_text())
    assert (receipt["generations"], receipt["rollouts"], receipt["difference"]) == (
        [1, 2, 3, 4, 5, 6],
        rollouts,
        None,
    )
    assert receipt["parameters_sha256"] == (folder.read_summary() or {})["parameters_sha256"]
    one_digit(folder)
    assert main(["verify", "r", "--share", "1", "--receipt", "receipt.json"]) == 1
    assert "generation 4 differs: progress.jsonl" in capsys.readouterr().err
    receipt = json.loads(Path("receipt.json").read_text())
    assert (receipt["generations"], receipt["verdict"]) == ([], "different")
    assert "generation 4 differs" in receipt["difference"]


def test_an_interrupted_verification_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    learnt(tmp_path / "r")
    words, repeated = ["verify", "r", "--share", "0.8", "--receipt", "r.json"], command.verify_some

    def pressed(*values: Any) -> Iterator[tuple[int, int]]:
        for count, result in enumerate(repeated(*values), 1):
            if count == 2:
                signal.raise_signal(signal.SIGINT)
            yield result

    with monkeypatch.context() as patched:
        patched.setattr(command, "verify_some", pressed)
        assert main(words) == 130
    assert "stopped; no difference in 1 of 6 generations" in capsys.readouterr().out
    before = json.loads(Path("r.json").read_text())
    assert (before["verdict"], len(before["chosen"]), before["generations"]) == (
        "interrupted",
        5,
        before["chosen"][:1],
    )
    with monkeypatch.context() as patched:
        attempts: list[int] = []
        patched.setattr(
            command,
            "verify_some",
            lambda run, numbers, do: attempts.extend(numbers) or repeated(run, numbers, do),
        )
        assert main(words) == 0
    after = json.loads(Path("r.json").read_text())
    assert attempts == before["chosen"][1:]
    assert (after["verdict"], after["generations"]) == ("the same", before["chosen"])


def test_a_receipt_is_signed_with_a_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    monkeypatch.chdir(tmp_path)
    learnt(tmp_path / "r")
    assert main(["certificates", "new", "certs", "--learner", "localhost"]) == 0
    assert main(["verify", "r", "--receipt", "r.json", "--tls", "certs/learner"]) == 0
    content, signature = Path("r.json").read_bytes(), Path("r.json.sig").read_bytes()
    certificate = x509.load_pem_x509_certificate(json.loads(content)["certificate"].encode())
    certificate.verify_directly_issued_by(
        x509.load_pem_x509_certificate(Path("certs/learner/ca.pem").read_bytes())
    )
    key = certificate.public_key()
    key.verify(signature, content, ec.ECDSA(hashes.SHA256()))
    with pytest.raises(InvalidSignature):
        key.verify(signature, content.replace(b"the same", b"different"), ec.ECDSA(hashes.SHA256()))


def test_other_code_is_said_before_anything_is_computed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = learnt(tmp_path / "r")
    (tmp_path / "pole.py").write_text(POLE + "\n# changed\n")
    at = checkpoints.load(folder.checkpoint)
    checkpoints.save(folder.checkpoint, replace(at, code=at.code | {"simulation": "0" * 64}))
    main(["verify", str(folder.path)])
    errors = capsys.readouterr().err
    assert "the code of its task has changed since the run began" in errors
    assert "the simulation's code (farm/) is of another release than when the run began" in errors


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--tls", "certs"), "--tls is for a farm to --connect to, or to sign a --receipt"),
        (("--all", "--workers", "0"), "--all with --workers 0, without --connect"),
        (("--all", "--workers", "1", "--connect", "tcp/127.0.0.1:1"), "--workers with --connect"),
        (("--share", "0"), "share is 0"),
    ],
)
def test_what_it_cannot_do(
    words: tuple[str, ...], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = learnt(tmp_path / "r")
    assert main(["verify", str(folder.path), *words]) == 2
    assert reason in capsys.readouterr().err


def thinned(folder: RunFolder, every: int) -> None:
    """Keep one generation in `every` in parameters, as a long run does."""
    path = folder.path / "parameters"
    head, body = path.read_bytes().split(b"\n", 1)
    size = folder.parameters.rows().dtype.itemsize
    rows = [body[at : at + size] for at in range(0, len(body), size)]
    path.write_bytes(
        json.dumps(json.loads(head) | {"every": every}).encode()
        + b"\n"
        + b"".join(rows[every - 1 :: every])
    )


def test_generations_are_chosen_whose_state_is_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = learnt(tmp_path / "r")
    thinned(folder, 2)
    run, rng = stored(folder), np.random.default_rng(0)
    assert {each for _ in range(50) for each in chosen(run, 0.5, rng)} == {1, 3, 5}
    assert chosen(run, 1.0, rng) == [1, 2, 3, 4, 5, 6]
    assert verified(folder, [1, 3, 5]) == [1, 3, 5]
    assert "learning the run again" not in caplog.text


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda each: each.get("algorithm", "default"))
def test_generations_whose_state_is_not_kept_are_repeated_in_one_pass(
    tmp_path: Path,
    settings: dict[str, object],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder = learnt(tmp_path / "r", **settings)
    thinned(folder, 3)
    steps: list[int] = []
    before = rewind.LearntAgain.step
    monkeypatch.setattr(
        rewind.LearntAgain, "step", lambda again, do: steps.append(1) or before(again, do)
    )
    assert sorted(verified(folder)) == [1, 2, 3, 4, 5, 6]
    assert len(steps) == 6, "each generation is learnt once"
    assert caplog.text.count("learning the run again up to there") == 1


def test_learning_again_ends_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    thinned(learnt(tmp_path / "r"), 6)
    before, steps = rewind.LearntAgain.step, []

    def stopped(again: rewind.LearntAgain, simulate: Any) -> Any:
        steps.append(again.state.generation)
        if len(steps) == 2:
            signal.raise_signal(signal.SIGTERM)
        return before(again, simulate)

    monkeypatch.setattr(rewind.LearntAgain, "step", stopped)
    assert main(["verify", str(tmp_path / "r"), "--share", "1.0"]) == 130
    assert steps == [0, 1]
    assert "stopped; no difference in" in capsys.readouterr().out


def altered(folder: RunFolder, **values: float) -> None:
    """Change what is written of the third generation."""
    path = folder.path / "progress.jsonl"
    lines = path.read_text().splitlines()
    lines[2] = json.dumps(json.loads(lines[2]) | values)
    path.write_text("\n".join(lines) + "\n")


def test_what_was_altered_is_found_in_the_one_pass(tmp_path: Path) -> None:
    folder = learnt(tmp_path / "r")
    thinned(folder, 6)
    altered(folder, return_mean=0.5)
    with pytest.raises(Differs, match="generation 3 differs: return_mean is 0.5 in progress.jsonl"):
        verified(folder, [2, 3, 5])


def test_a_run_whose_origin_has_gone_on_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    learnt(tmp_path / "first")
    folder = learnt(tmp_path / "r", init_from=str(tmp_path / "first"))
    assert main(["verify", str(folder.path), "--share", "1"]) == 0
    origin, alone = taken_up(tmp_path / "first", generations=GENERATIONS + 2)
    list(origin.learn(alone))  # type: ignore[arg-type]
    assert main(["verify", str(folder.path), "--share", "1"]) == 1
    line = f"it began with the mean of {tmp_path / 'first'}, and can be repeated only if"
    assert line in " ".join(capsys.readouterr().err.split())


def test_another_number_of_rollouts_is_found(tmp_path: Path) -> None:
    folder = learnt(tmp_path / "r")
    thinned(folder, 6)
    altered(folder, rollouts=1000)
    with pytest.raises(
        Differs, match="generation 3 differs: rollouts is 1000 in progress.jsonl, and 24 when"
    ):
        verified(folder, [3])


def without_a_chain(folder: RunFolder) -> None:
    """As runs of releases that had none."""
    (folder.path / "chain").unlink()
    checkpoints.save(folder.checkpoint, replace(checkpoints.load(folder.checkpoint), chain=""))
    (folder.path / "summary.json").unlink()


def test_a_run_of_a_release_without_a_chain_is_said_to_be_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = learnt(tmp_path / "r")
    without_a_chain(folder)
    assert verified(folder) == [1, 2, 3, 4, 5, 6]
    assert "it was learnt by a release without a chain of digests" in caplog.text
    assert "there is none at all, so that only what is repeated is verified" in caplog.text
    one_digit(folder)
    with pytest.raises(Differs, match="generation 4 differs: return_max"):
        verified(folder)


def test_a_run_that_got_its_chain_when_it_was_resumed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = learnt(tmp_path / "r")
    without_a_chain(folder)
    config = replace(folder.read_config(), generations=GENERATIONS + 2)
    problem, at = setup.resumed(folder, config)
    folder.write_config(config)
    for _ in Learner(problem, folder, at).learn(Alone(problem)):  # type: ignore[arg-type]
        pass
    assert verified(folder, [8]) == [8]
    assert "there is none before generation 7" in caplog.text


def test_only_this_users_receipts_are_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    learnt(tmp_path / "r")
    assert main(["verify", "r", "--share", "0.01", "--receipt", "r.json"]) == 0
    honest = json.loads(Path("r.json").read_text())
    made_up = honest | {
        "verdict": "interrupted",
        "chosen": [1, 2],
        "generations": [1, 2],
        "rollouts": 60,
    }
    for receipt in (
        made_up,
        {name: value for name, value in made_up.items() if name != "seal"},
        made_up | {"seal": 3},
    ):
        Path("r.json").write_text(json.dumps(receipt))
        assert main(["verify", "r", "--share", "1.0", "--receipt", "r.json"]) == 2
        assert (
            "r.json says that a verification was interrupted, but was not written by you"
            in capsys.readouterr().err
        )
        assert json.loads(Path("r.json").read_text()) == receipt
    Path("r.json").write_text(json.dumps(made_up | {"verdict": "the same"}))
    assert main(["verify", "r", "--share", "1.0", "--receipt", "r.json"]) == 0
    assert json.loads(Path("r.json").read_text())["generations"] == [1, 2, 3, 4, 5, 6]


def test_a_folder_that_is_no_interrupted_repetition_is_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    learnt(tmp_path / "r")
    learnt(tmp_path / "r.json.run" / "r")
    assert main(["verify", "r", "--all", "--workers", "1", "--receipt", "r.json"]) == 2
    assert (
        "r.json.run is not of an interrupted verification of this run by you"
        in capsys.readouterr().err
    )
    assert (tmp_path / "r.json.run" / "r" / "checkpoint").exists()
    assert not Path("r.json").exists()


def test_what_was_not_compared_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = learnt(tmp_path / "r")
    folder.write_summary((folder.read_summary() or {}) | {"robust_return": 5.0, "prize": "first"})
    assert main(["verify", "r", "--receipt", "r.json"]) == 0
    left = json.loads(Path("r.json").read_text())["not_compared"]
    assert {"state", "seconds", "robust_return", "prize", "checks"} <= {*left}
    assert not {"rollouts", "best_return", "steps", "chain", "mean_policy_return"} & {*left}
    assert f"not compared, of summary.json: {', '.join(left)}" in capsys.readouterr().out
