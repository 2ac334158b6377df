"""The command with which workers join a learner, as it is shown."""

import socket
from pathlib import Path

from farm.net.tls import Bundle
from learner.run.config import configure
from learner.run.launch import Placement, how_to_join
from learner.run.setup import problem


def test_a_file_is_named_as_the_worker_has_it(pole: str, tmp_path: Path) -> None:
    own = problem(configure(pole))
    path = pole.rpartition(":")[0]
    here = how_to_join(Placement(), own)
    assert here == f"farm worker --connect tcp/127.0.0.1:7447 --allow-file {path}"
    trusted = how_to_join(Placement(listen="tcp/0.0.0.0:7447", trusted=True), own)
    name = Path(path).name
    host = socket.gethostname()
    assert trusted == f"farm worker --connect tcp/{host}:7447 --allow-file {name}"
    bundle = Bundle(tmp_path, "learner", "learner", ("lab",))
    encrypted = how_to_join(Placement(listen="tls/0.0.0.0:7447", tls=bundle), own)
    assert encrypted == "farm worker --connect tls/lab:7447 --tls worker-NAME --accept-code"


def test_a_task_of_the_farm_needs_no_file() -> None:
    built_in = problem(configure("finger-gait"))
    assert how_to_join(Placement(), built_in) == "farm worker --connect tcp/127.0.0.1:7447"
