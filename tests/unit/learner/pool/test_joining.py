"""The commands with which workers join a learner and a run continues, as they are shown."""

import json
import socket
from pathlib import Path

import pytest

from farm.net.tls import Bundle
from learner.pool.placement import Placement, how_to_join, how_to_resume

OWN = (Path("/home/lab/pole.py"),)


def test_a_file_is_named_as_the_worker_has_it() -> None:
    here = how_to_join(Placement(), OWN)
    assert here == "farm worker --connect tcp/127.0.0.1:7447 --allow-file /home/lab/pole.py"
    trusted = how_to_join(Placement(listen="tcp/0.0.0.0:7447", trusted=True), OWN)
    host = socket.gethostname()
    assert trusted == f"farm worker --connect tcp/{host}:7447 --allow-file pole.py"


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["lab-1"], "--tls certs/worker-lab-1 --accept-code"),
        (
            ["lab-1", "lab-2"],
            "--tls certs/worker-lab-1 --accept-code   # on lab-1; lab-2 likewise",
        ),
        (
            ["a", "b", "c", "d"],
            "--tls certs/worker-a --accept-code   # on a; b, c, ... likewise",
        ),
        (
            [],
            "--tls worker-NAME --accept-code   # NAME: farm certificates add CERTS --worker NAME",
        ),
    ],
)
def test_a_certificate_is_one_that_is_admitted(
    names: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("certs/learner")
    folder.mkdir(parents=True)
    (folder / "roster.json").write_text(
        json.dumps({"learners": ["learner"], "workers": names, "viewers": []})
    )
    bundle = Bundle(folder, "learner", "learner", ("lab",))
    encrypted = how_to_join(Placement(listen="tls/0.0.0.0:7447", tls=bundle), OWN)
    assert encrypted == f"farm worker --connect tls/lab:7447 {words}"


def test_a_task_of_the_farm_needs_no_file() -> None:
    assert how_to_join(Placement(), ()) == "farm worker --connect tcp/127.0.0.1:7447"


def test_a_run_continues_where_it_was(tmp_path: Path) -> None:
    run = Path("runs/a")
    assert how_to_resume(Placement(workers=2, listen="tcp/127.0.0.1:9"), run) == (
        "farm run --resume runs/a"
    )
    assert how_to_resume(Placement(), run) == "farm learner --resume runs/a"
    mine = how_to_join(Placement(), (Path("my tasks/walk.py"),))
    assert mine.endswith("--allow-file 'my tasks/walk.py'")
    assert how_to_resume(Placement(), Path("my runs/a")) == "farm learner --resume 'my runs/a'"
    bundle = Bundle(tmp_path, "learner", "learner", ("lab",))
    encrypted = Placement(listen="tls/0.0.0.0:7447", tls=bundle, farm="mine")
    assert how_to_resume(encrypted, run) == (
        f"farm learner --listen tls/0.0.0.0:7447 --tls {tmp_path} --farm mine --resume runs/a"
    )
    routed = Placement(connect=("tcp/a:1", "tcp/b:1"))
    assert how_to_resume(routed, run) == (
        "farm learner --connect tcp/a:1 --connect tcp/b:1 --resume runs/a"
    )
    trusting = Placement(listen="tcp/0.0.0.0:7447", trusted=True)
    assert how_to_resume(trusting, run) == (
        "farm learner --listen tcp/0.0.0.0:7447 --trust-network --resume runs/a"
    )
