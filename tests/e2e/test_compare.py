"""Finished runs beside each other: `farm compare`, and the viewer's table of several recordings."""

import contextlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from finished import Say, again, folder
from processes import Farm
from recordings import read, texts
from rerun.chunk import RrdReader

pytestmark = pytest.mark.usefixtures("grips_found_once")


def test_a_comparison_holds_each_runs_numbers(done: Farm, say: Say) -> None:
    output = say("compare", "runs/a", "runs/b", "--to", "c.rrd")
    assert "written to c.rrd; look at it with: farm view c.rrd" in output
    path = done.folder / "c.rrd"
    (recording,) = RrdReader(path).recordings()
    assert (recording.application_id, recording.recording_id) == (
        "rolloutfarm comparison",
        "comparison",
    )
    entities = read(path)
    for name in ("a", "b"):
        (batch,) = [b for b in entities[f"/runs/{name}/return"] if "generation" in b.schema.names]
        (column,) = [n for n in batch.schema.names if n.endswith("scalars")]
        lines = done.progress(name)
        returns = [
            *(p["mean_policy_return"] for p in lines),
            done.summary(name)["mean_policy_return"],
        ]
        assert [v[0] for v in batch.column(column).to_pylist()] == returns
        assert batch.column("generation").cast("int64").to_pylist() == [
            0,
            *(p["generation"] for p in lines),
        ]
        assert batch.column("rollouts").cast("int64").to_pylist() == [
            0,
            *(p["rollouts"] for p in lines),
        ]
        frames = sum(
            b.num_rows
            for b in entities[f"/runs/{name}/world/object"]
            if "sim_time" in b.schema.names
        )
        assert frames == len(again(done, name).trajectory.times)
    (table,) = texts(path, "/table")
    assert "| policy | kernel | projected |" in table
    assert "| seed | 0 | 5 |" in table
    assert (
        f"| hash | {done.summary('a')['parameters_sha256'][:8]} |"
        f" {done.summary('b')['parameters_sha256'][:8]}" in table
    )


@pytest.mark.slow
def test_a_summary_that_is_not_there_yet(done: Farm, tmp_path: Path) -> None:
    shutil.copytree(folder(done).path, tmp_path / "a")
    (tmp_path / "a" / "summary.json").unlink()
    done.call("compare", "runs/a", str(tmp_path / "a"), "--to", str(tmp_path / "c.rrd"))
    (table,) = texts(tmp_path / "c.rrd", "/table")
    figure = f"{done.summary('a')['mean_policy_return']:.3f}"
    assert f"| return of the final policy | {figure} | - |" in table


def test_a_recording_has_its_runs_properties(done: Farm) -> None:
    values = {}
    for entity, batches in read(folder(done).recording).items():
        if entity.startswith("/__properties/"):
            for batch in batches:
                for name in batch.schema.names:
                    values[f"{entity.rpartition('/')[2]} {name.rpartition(':')[2]}"] = batch.column(
                        name
                    ).to_pylist()[0]
    summary = done.summary("a")
    assert values["run seed"] == [0]
    assert values["run policy"] == ["kernel"]
    assert values["run preset"] == ["own"]
    assert values["result return"] == [summary["mean_policy_return"]]
    assert values["result success"] == [summary["mean_policy_success"]]


@pytest.mark.slow
def test_several_recordings_are_a_table_in_the_viewer(done: Farm, tmp_path: Path) -> None:
    import rerun_cli
    from rerun.experimental import ViewerClient

    from learner.recording.viewing import free_port, once_loaded, show_table

    other = tmp_path / "other.rrd"
    done.call("replay", "runs/a", "--to", str(other))
    files = [str(folder(done).recording), str(other)]
    port = free_port()
    # `python -m rerun` would only be its parent
    binary = Path(rerun_cli.__file__).with_name("rerun")
    command = [binary, *files, "--bind", "127.0.0.1", "--port", str(port), "--headless"]
    home = {
        name: str(tmp_path)
        for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_RUNTIME_DIR")
    }
    with (tmp_path / "viewer.log").open("w+") as log:
        viewer = subprocess.Popen(command, env={**os.environ, **home}, stdout=log, stderr=log)
        try:
            success = once_loaded(port, lambda: viewer.poll() is not None, show_table)
            if viewer.poll() is not None:
                log.seek(0)
                pytest.skip(
                    "the viewer needs Vulkan (Debian: mesa-vulkan-drivers libvulkan1):"
                    f" {log.read()[-200:]}"
                )
            assert success
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            columns: set[str] = set()

            def draws() -> bool:
                client.take_screenshot()  # a viewer without a window draws when it is asked
                with contextlib.suppress(ConnectionError):  # not drawn yet
                    columns.update(column.name for column in client.get_table_schema())
                return bool(columns)

            done.wait_for(draws)
        finally:
            viewer.terminate()
            viewer.wait(20)
    assert {
        "property:run:seed",
        "property:run:preset",
        "property:result:return",
        "property:result:success",
    } <= columns
