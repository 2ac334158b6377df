"""Loggers: the values in TensorBoard's files and wandb; their errors do not affect learning."""

import json
import struct
import sys
import warnings
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import pytest
from made import stats

from farm.errors import ConfigError
from farm.net.stats import GenerationStats
from learner.loggers.base import Loggers

CONFIG = {"version": 2, "seed": 3}
SUMMARY = {"run": "r", "generations": 2, "state": "finished", "robust_return": None}
OWN = """
class Failing:
    def __init__(self, folder, config, done):
        self.file = folder / "own.txt"
        self.file.write_text(f"{config['seed']} {done}")
    def generation(self, figures):
        if figures["generation"] == 2:
            raise OSError("the disk is\\nfull")
    def end(self, summary):
        self.file.write_text("ended")

class Shy(Failing):
    def __init__(self, folder, config, done):
        raise RuntimeError("no account")

class Nothing:
    pass
"""


def figures(generation: int) -> GenerationStats:
    measures = {"height": 0.25, "push": None}
    return stats(
        generation,
        return_mean=-0.5 * generation,
        mean_policy_success=True,
        success_rate=None,
        measures=measures,
    )


def logged(names: tuple[str, ...], folder: Path, *, first: int = 1, last: int = 2) -> None:
    loggers = Loggers(names, folder, CONFIG, first - 1)
    for generation in range(first, last + 1):
        loggers.generation(figures(generation))
    loggers.end(SUMMARY)
    loggers.end({})


def events(folder: Path) -> list[object]:
    """Of TensorBoard's files, oldest first: records of length (8 bytes), checksum (4), an Event,
    checksum (4).
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tensorboardX.proto.event_pb2 import Event
    records = []
    for path in sorted(folder.glob("events.*")):
        content = path.read_bytes()
        while content:
            (size,) = struct.unpack("<Q", content[:8])
            records.append(Event.FromString(content[12 : 12 + size]))
            content = content[16 + size :]
    return records


def test_tensorboard_has_every_figure_of_every_generation(tmp_path: Path) -> None:
    logged(("tensorboard",), tmp_path)
    curves, texts = defaultdict(list), {}
    for event in events(tmp_path / "tensorboard"):
        for value in event.summary.value:
            if value.HasField("simple_value"):
                curves[value.tag].append((event.step, value.simple_value))
            else:
                texts[value.tag.removesuffix("/text_summary")] = value.tensor.string_val[0].decode()
    assert curves["return_mean"] == [(1, -0.5), (2, -1.0)]
    assert curves["mean_policy_success"] == [(1, 1.0), (2, 1.0)]
    assert curves["measures_height"] == [(1, 0.25), (2, 0.25)]
    tables = {"measures", "mean_policy_measures"}
    names = (
        set(GenerationStats.__dataclass_fields__)
        - {"generation", "success_rate", "validation"}
        - tables
    )
    assert set(curves) == names | {"measures_height"}, "what is not known is left out"
    for name, expected in (("config", CONFIG), ("summary", SUMMARY)):
        assert json.loads(texts[name].removeprefix("```json\n").removesuffix("\n```")) == expected


def test_a_run_that_goes_on_replaces_what_was_logged_beyond_its_checkpoint(tmp_path: Path) -> None:
    logged(("tensorboard",), tmp_path, last=3)
    before = len(events(tmp_path / "tensorboard"))
    logged(("tensorboard",), tmp_path, first=3, last=4)
    starts = [
        event.step
        for event in events(tmp_path / "tensorboard")[before:]
        if event.HasField("session_log")
    ]
    assert starts == [3]  # TensorBoard drops older events from this step on


def test_wandb_has_the_figures_and_goes_on_with_the_same_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[str, object]] = []
    run = SimpleNamespace(
        log=lambda figures, step: calls.append((f"step {step}", figures["return_mean"])),
        summary=SimpleNamespace(update=lambda summary: calls.append(("summary", summary))),
        finish=lambda exit_code: calls.append(("finish", exit_code)),
    )

    def init(**settings: object) -> object:
        calls.append(("init", (settings["name"], settings["id"], settings["config"])))
        return run

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init, Settings=dict))
    logged(("wandb",), tmp_path)
    start = (tmp_path.name, (tmp_path / "wandb" / "id").read_text(), CONFIG)
    end = [("summary", SUMMARY), ("finish", 0)]
    assert calls == [("init", start), ("step 1", -0.5), ("step 2", -1.0), *end]
    calls.clear()
    logged(("wandb",), tmp_path, first=3, last=3)
    assert calls == [("init", start), ("step 3", -1.5), *end]
    calls.clear()
    # A host was expelled: no step is logged twice in one run
    logged(("wandb",), tmp_path, first=2, last=2)
    assert (
        calls[0]
        == ("init", (tmp_path.name, (tmp_path / "wandb" / "id").read_text(), CONFIG))
        != ("init", start)
    )
    assert calls[1:] == [("step 2", -1.0), *end]


@pytest.mark.slow
def test_wandb_itself_without_a_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="wandb is not installed: pip install '.[wandb]'")
    monkeypatch.setenv("WANDB_MODE", "offline")
    logged(("wandb",), tmp_path)
    assert list(tmp_path.glob("wandb/offline-run-*/*.wandb"))


def test_one_that_fails_ends_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "own.py").write_text(OWN)
    logged((f"{tmp_path}/own.py:Failing", "tensorboard"), tmp_path, last=3)
    (message,) = caplog.messages
    assert (
        message
        == f"--log {tmp_path}/own.py:Failing ends here, learning continues: OSError: the disk is"
        " full"
    )
    assert (tmp_path / "own.txt").read_text() == "3 0"
    assert max(event.step for event in events(tmp_path / "tensorboard")) == 3


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("mlflow", "unknown logger 'mlflow'; known are tensorboard, wandb, or FILE.py:CLASS"),
        ("tensorboard", r"--log tensorboard needs tensorboardX: pip install tensorboardX$"),
        ("own.py:Shy", "--log own.py:Shy cannot begin: RuntimeError: no account"),
        (
            "own.py:Nothing",
            "--log own.py:Nothing: it is no logger: it has no generation and no end",
        ),
    ],
)
def test_those_that_cannot_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, reason: str
) -> None:
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ConfigError, match=reason):
        Loggers(("own.py:Failing", name), tmp_path, CONFIG, 0)
    assert (tmp_path / "own.txt").read_text() == "ended"
