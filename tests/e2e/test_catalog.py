"""`farm runs --serve`: recordings of runs in Rerun's catalog."""

import shutil
import signal
import socket

import numpy as np
import pytest
from processes import Farm

from farm.net.session import free_endpoint

pytestmark = pytest.mark.slow


def test_each_recorded_run_is_a_segment_of_the_folders_data_set(farm: Farm) -> None:
    catalog = pytest.importorskip("rerun.catalog")
    pytest.importorskip("datafusion")
    for name in ("a", "b"):
        farm.call("run", "--name", name, "--workers", "1", "--pairs", "2", "--generations", "3")
    farm.call(
        "run", "--name", "c", "--no-record", "--workers", "1", "--pairs", "2", "--generations", "1"
    )
    shutil.copytree(farm.folder / "runs/b", farm.folder / "runs/copy")
    process = farm.start("runs", "--serve", free_endpoint().rpartition(":")[2])
    assert process.stdout
    assert (
        process.stdout.readline()
        == "runs/copy is left out: it is a copy of runs/b, with the same recording's id\n"
    )
    announcement = process.stdout.readline()
    assert announcement.startswith("2 recordings at rerun+http://127.0.0.1:")
    address = announcement.split()[3].rstrip(":")
    (runs,) = [each for each in catalog.CatalogClient(address).datasets() if each.name == "runs"]
    assert sorted(runs.segment_ids()) == ["a", "b"]
    rows = runs.filter_contents(["/learning/return"]).reader(index="generation").to_pandas()
    for name in ("a", "b"):
        returns = rows[rows["rerun_segment_id"] == name].sort_values("generation")[
            "/learning/return:Scalars:scalars"
        ]
        expected = [line["return_mean"] for line in farm.progress(name)]
        np.testing.assert_allclose([value[0] for value in returns.dropna()], expected, rtol=1e-6)
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 130


def test_a_port_in_use_is_one_line(farm: Farm) -> None:
    farm.call("run", "--name", "a", "--workers", "1", "--pairs", "2", "--generations", "1")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        output = farm.call("runs", "--serve", str(port), status=2)
    assert "take another port" in output
    assert output.count("\n") == 1
