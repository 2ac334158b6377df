"""A robot whose model is in an installed package."""

import sys
from pathlib import Path

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.tasks.base import Task
from farm.tasks.probe import specification

MODEL = """<mujoco><include file="parts.xml"/><worldbody><geom size="0.1"/></worldbody></mujoco>"""
PARTS = """<mujoco><worldbody><body><joint name="a"/><geom size="0.1"/></body></worldbody>
  <actuator><motor joint="a"/></actuator></mujoco>"""


class Packaged(Task):
    """Its robot is elsewhere, and gets a floor here."""

    package = "robots_of_a_test"
    root = "models"
    xml = "robot.xml"

    def mjcf(self) -> str:
        """With a floor."""
        floor = '<geom name="floor" type="plane" size="1 1 1"/>'
        return super().mjcf().replace("<worldbody>", f"<worldbody>{floor}")

    def reward(self, sim, action):
        """0."""
        return np.zeros(len(sim))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "robots_of_a_test"
    (folder / "models").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise SystemExit('imported')")
    (folder / "models/robot.xml").write_text(MODEL)
    (folder / "models/parts.xml").write_text(PARTS)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("installed")
def test_a_model_of_a_package_is_read_without_importing_it() -> None:
    task = Packaged()
    assert sorted(task.sources) == ["parts.xml", "robot.xml"]
    assert task.model.geom("floor").id >= 0
    assert specification(task).action == 1
    assert "robots_of_a_test" not in sys.modules


@pytest.mark.usefixtures("installed")
def test_who_has_its_files_needs_no_package(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = Packaged().sources
    monkeypatch.undo()
    assert Packaged(files=sources).model.ngeom == 3


@pytest.mark.parametrize("name", ["no_such_package", "json.decoder", "keyword", "", " ", "."])
def test_a_package_that_is_not_there_is_one_line(name: str) -> None:
    kind = type("Other", (Packaged,), {"package": name})
    words = "there is no file" if not name else "which is not installed here: install it with pip"
    with pytest.raises(ConfigError, match=words):
        kind()
