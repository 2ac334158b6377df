"""Mistakes in commands on finished runs: one line and the right exit status."""

from pathlib import Path

import pytest
from processes import Farm

from farm.__main__ import main

pytestmark = pytest.mark.usefixtures("grips_found_once")
MISTAKES = [
    (("replay", "runs/a", "--generation", "99"), 2, "generation 99 is not stored"),
    (
        ("replay", "runs/a", "--generation", "0", "--best", "1"),
        2,
        "generation 0 of the run in runs/a has no rollouts",
    ),
    (("replay", "runs/a", "--rollout", "8"), 2, "generation 6 has no rollout 8: there are 0 to 7"),
    (("replay", "runs/a", "--worst", "13"), 2, "worst is 13; expected 1 to 12"),
    (("replay", "runs/a", "--generation", "-1"), 2, "generation is -1; expected 0 to 10000000"),
    (("replay", "runs/a", "--object", "cat"), 2, "unknown object 'cat'; known are bar"),
    (("replay", "runs/a", "--friction", "0"), 2, "friction is 0.0; expected a positive number"),
    (("replay", "runs/a", "--friction", "nan"), 2, "friction is nan; expected a finite number"),
    (("replay", "runs/a", "--speed", "0"), 2, "speed is 0.0; expected 0.01 to 10"),
    (
        ("replay", "runs/a", "--video", "a.avi"),
        2,
        "--video a.avi: expected a name that ends in .gif or .mp4",
    ),
    (
        ("replay", "runs/a", "--video", "none/a.gif"),
        2,
        "cannot write none/a.gif: there is no folder none",
    ),
    (("replay", "runs/a", "--video", "runs.gif"), 2, "--video runs.gif: it is a folder; give an"),
    (("stress", "runs/a", "--out", "runs/a/config.json"), 2, "config.json: it is a file; give an"),
    (("verify", "runs/a", "--receipt", "runs"), 2, "--receipt runs: it is a folder; give another"),
    (("runs", "runs/a/config.json"), 2, "runs/a/config.json is a file; expected a folder of runs"),
    (("replay", "runs/a", "--to", "/proc/a.rrd"), 1, "cannot write /proc/a.rrd"),
    (
        ("replay", "runs/a", "--to", "runs/a/run.rrd"),
        2,
        "--to runs/a/run.rrd would replace the run's own recording",
    ),
    (
        ("replay", "runs/a", "--to", "runs/a/undone.rrd"),
        2,
        "--to runs/a/undone.rrd would replace the run's own",
    ),
    (
        ("verify", "runs/a", "--receipt", "runs/a/config.json"),
        2,
        "--receipt runs/a/config.json exists and is no receipt: take another name",
    ),
    (
        ("run", "--init-from", "runs/none"),
        2,
        "--init-from: ",
    ),
    (
        ("replay", "runs/a", "--to", "runs/a/replay.rrd"),
        2,
        "--to runs/a/replay.rrd would replace the run's own",
    ),
    (
        ("replay", "runs/a", "--to", "runs/a/checkpoint"),
        2,
        "--to runs/a/checkpoint: a recording's name ends in .rrd",
    ),
    (
        ("compare", "runs/a", "runs/b", "--to", "runs/a/config.json"),
        2,
        "a recording's name ends in .rrd",
    ),
    (("view", "runs/a/config.json", "--web"), 2, "runs/a/config.json is not a recording"),
    (("compare", "runs/a"), 2, "farm compare takes 2 to 7 runs, not 1"),
    (("compare", "runs/a", "runs/../runs/a"), 2, "is there twice"),
    (("compare", "runs/a", "nowhere"), 2, "nowhere is not a run's folder"),
    (("compare", "runs/a", "runs/b", "--to", "/proc/c.rrd"), 1, "cannot write /proc/c.rrd"),
    (("view", "runs/a", "nowhere"), 2, "no recording in nowhere"),
    (("runs", "--serve", "0"), 2, "--serve '0' is no port; take one from 1 to 65535"),
    (("runs", "--serve", "9876", "--csv"), 2, "--json, --csv and --serve exclude each other"),
    (("export", "nowhere", "p.npz"), 2, "nowhere is not a run's folder"),
    (("export", "runs/a", "p.zip"), 2, "p.zip: expected a name that ends in .npz or .onnx"),
    (("export", "runs/a", "no/p.npz"), 1, "cannot write no/p.npz: No such file or directory"),
    (("export", "runs/a", "p.npz", "--generation", "99"), 2, "generation 99 is not stored"),
    (("play", "nowhere"), 2, "nowhere is not a run's folder"),
    (("play", "runs/a", "--hold", "-1"), 2, "hold is -1.0; expected 0 to 3600"),
]


@pytest.mark.parametrize(
    ("words", "status", "line"),
    MISTAKES,
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_mistakes(
    done: Farm,
    words: tuple[str, ...],
    status: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(done.folder)
    Path("runs.gif").mkdir(exist_ok=True)
    assert main(words) == status
    output = "".join(capfd.readouterr())
    assert line in output
    assert len(output.strip().splitlines()) == 1, output
