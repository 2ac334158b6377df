"""Files that a class's file names: imported from beside it alone, part of its digest, and sent with
it.
"""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made import pole, spec_of

from farm import neighbours, plugins
from farm.errors import ConfigError, UnservedError
from farm.runner import build_task, served

TASK = """
__neighbours__ = ("gaits", "shapes")
import numpy as np
import farm
import gaits
from gaits import Settings, trot

class Pole(farm.Task):
    Config = Settings
    xml = '''<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator>
          <motor joint="j"/></actuator></mujoco>'''
    steps = 4

    def reward(self, sim, action):
        from shapes import SIZE
        import shapes as again
        assert again.SIZE == SIZE
        return np.full(len(sim), trot(SIZE) + gaits.LEVEL)
"""
GAITS = """
from dataclasses import dataclass
from shapes import *
import farm
LEVEL = 10.0

@dataclass(frozen=True, kw_only=True)
class Settings(farm.TaskConfig):
    pace: float = farm.setting(2.0, above=0.0)
    '''Steps per second.'''

def trot(size):
    return size * SIZE
"""
SHAPES = "SIZE = 3.0\n"


def three(folder: Path, task: str = TASK, gaits: str = GAITS, shapes: str = SHAPES) -> Path:
    for name, text in (("gaits", gaits), ("shapes", shapes)):
        pole(folder, text, f"{name}.py")
    return pole(folder, task)


def rewards(path: Path) -> float:
    task = build_task(plugins.find("tasks", f"{path}:Pole"), {}, None)
    return float(task.reward(np.zeros(1), np.zeros(1))[0])  # type: ignore[arg-type,index]


def digest(path: Path) -> str:
    return plugins.find("tasks", f"{path}:Pole").digest()


def test_neighbours_are_imported_from_beside_the_file_and_nowhere_else(tmp_path: Path) -> None:
    """Also inside functions, by each other, with `*`; and those of two folders do not meet."""
    one = three(tmp_path / "one")
    other = three(tmp_path / "other", shapes="SIZE = 5.0\n")
    assert (rewards(one), rewards(other), rewards(one)) == (19.0, 35.0, 19.0)
    assert not {"gaits", "shapes"} & set(sys.modules)
    assert not list(tmp_path.rglob("__pycache__"))
    pace = build_task(plugins.find("tasks", f"{one}:Pole"), {"pace": 4.0}, None).config.pace
    assert pace == 4.0


def test_a_neighbour_hides_no_module_from_others(tmp_path: Path) -> None:
    """One that is named like a module is meant by these files only; one that is not named by
    none.
    """
    task = "__neighbours__ = ('json',)\nimport json, math\n" + TASK.replace("__neighbours__", "_")
    task = task.replace("import gaits\nfrom gaits import Settings, trot", "").replace(
        "Config = Settings", ""
    )
    task = task.replace(
        "from shapes import SIZE\n        import shapes as again\n        assert again.SIZE =="
        " SIZE",
        "",
    )
    task = task.replace("trot(SIZE) + gaits.LEVEL", "json.LEVEL + math.floor(2.5)")
    pole(tmp_path, "LEVEL = 7.0\n", "json.py")
    pole(tmp_path, "raise RuntimeError\n", "math.py")
    path = pole(tmp_path, task)
    assert rewards(path) == 9.0
    assert sys.modules["json"] is json


def test_a_changed_neighbour_changes_the_digest_and_the_numbers(tmp_path: Path) -> None:
    path = three(tmp_path)
    before = digest(path)
    pole(tmp_path, "raise RuntimeError", "unnamed.py")
    assert digest(path) == before == plugins.file_digest(path)
    elsewhere = three(tmp_path / "elsewhere")
    assert digest(elsewhere) == before, "folders do not count"
    pole(tmp_path, "SIZE = 4.0\n", "shapes.py")
    assert digest(path) != before
    assert rewards(path) == 26.0
    alone = pole(tmp_path / "alone")
    assert digest(alone) == hashlib.sha256(alone.read_bytes()).hexdigest()


def test_another_machine_needs_the_same_neighbours(tmp_path: Path) -> None:
    path = three(tmp_path)
    copy = three(tmp_path / "copy")
    plugin = plugins.find("tasks", f"{path}:Pole")
    spec = spec_of(path, task_config={})
    assert served(spec, (copy,))[0].config.pace == 2.0
    three(tmp_path / "copy", shapes="SIZE = 4.0\n")
    message = (
        r"gaits\.py, shapes\.py beside it differs from the learner's pole\.py: copy the learner's"
        r" files there"
    )
    with pytest.raises(UnservedError, match=message):
        plugins.allowed("tasks", plugin.wire, plugin.digest(), (copy,))
    (copy.parent / "gaits.py").unlink()
    with pytest.raises(
        UnservedError, match=r"gaits\.py, a neighbour that pole\.py names: there is no such file"
    ):
        plugins.allowed("tasks", plugin.wire, plugin.digest(), (copy,))
    assert plugins.file_digest(copy) == ""


def test_files_of_one_name_are_told_apart_by_their_contents(tmp_path: Path) -> None:
    files = (three(tmp_path / "a"), three(tmp_path / "b", shapes="SIZE = 4.0\n"))
    for path in files:
        plugin = plugins.find("tasks", f"{path}:Pole")
        assert plugins.allowed("tasks", plugin.wire, plugin.digest(), files).file == path
    with pytest.raises(UnservedError, match="differs from the learner's"):
        plugins.allowed("tasks", plugin.wire, "0" * 64, files)
    (tmp_path / "a" / "gaits.py").unlink()
    assert plugins.allowed("tasks", plugin.wire, plugin.digest(), files).file == files[1]


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"task": TASK.replace("__neighbours__", "_")},
            r"line 5: ModuleNotFoundError: No module named 'gaits'; to "
            r"import gaits\.py beside it, add the line __neighbours__ = \('gaits',\)$",
        ),
        (
            {"task": TASK.replace('("gaits", "shapes")', "gaits")},
            r"pole\.py, line 2: expected names of modules, such",
        ),
        (
            {"task": TASK.replace('("gaits", "shapes")', '"gaits"')},
            r"pole\.py, line 2: expected names of modules",
        ),
        (
            {"task": TASK.replace('"gaits",', '"gaits.py",')},
            r"line 2: 'gaits\.py' is no other file beside it",
        ),
        (
            {"task": TASK.replace('"gaits",', '"../gaits",')},
            r"line 2: '\.\./gaits' is no other file beside it",
        ),
        (
            {"task": TASK.replace('"gaits",', '"pole",')},
            r"line 2: 'pole' is no other file beside it",
        ),
        (
            {"task": TASK.replace('"gaits",', '"runs",')},
            r"runs\.py, a neighbour that pole\.py names: there is no such",
        ),
        (
            {"gaits": "\n1 / 0\n"},
            r"pole\.py cannot be imported: gaits\.py, line 2: ZeroDivisionError: div",
        ),
        (
            {"shapes": "\n\nsize = = 3\n"},
            r"pole\.py cannot be imported: shapes\.py, line 3: invalid syntax$",
        ),
        (
            {"gaits": "import pole\n"},
            r"gaits\.py, line 1: ModuleNotFoundError: No module named 'pole'",
        ),
        (
            {"gaits": f"SIZE = '''{'x' * 999_900}'''\n"},
            r"pole\.py and its neighbours have \d+ bytes; expected at most",
        ),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, files: dict[str, str], message: str) -> None:
    path = three(tmp_path, **files)
    before = set(sys.modules)
    with pytest.raises(ConfigError, match=message) as error:
        plugins.find("tasks", f"{path}:Pole")
    assert "\n" not in str(error.value)
    assert not [
        name for name in set(sys.modules) - before if name.startswith("rolloutfarm_file")
    ], "none is left"


def test_a_file_is_read_without_running_it() -> None:
    source = b"__neighbours__ = ['gaits', 'gaits']\nraise RuntimeError\n"
    assert neighbours.named(Path("pole.py"), source) == ("gaits",)
    assert neighbours.named(Path("pole.py"), b"x = '__neighbours__'\n") == ()
    assert neighbours.named(Path("pole.py"), b"__neighbours__ = (\n") == (), (
        "importing it says what is wrong"
    )


def test_a_bundle_has_every_byte() -> None:
    others = {"b": b"\xff\n\0", "a": b""}
    bundle = neighbours.packed(b"own\r\n", others)
    assert neighbours.unpacked(bundle) == (b"own\r\n", others)
    assert neighbours.packed(b"own\r\n", dict(reversed(others.items()))) == bundle
    assert neighbours.packed(b"own", {}) == b"own"
    assert neighbours.unpacked(b"own") == (b"own", {})


@pytest.mark.parametrize(
    "head",
    [
        "",
        "{}",
        "[]",
        "[1]",
        '[["", 2]]',
        '[["", 4]]',
        '[["", 1], ["../a", 2]]',
        '[["", 1], ["a", -1], ["b", 3]]',
        '[["", 1], ["", 2]]',
        '[["a", 1], ["b", 2]]',
        '[["", 1], ["a", 1], ["a", 1]]',
        '[["", true], ["a", 2]]',
        '[["", 1.0], ["a", 2]]',
        "[" * 100_000,
        f'[["", 1], ["{"a" * 200}", 2]]',
        "\xff",
        json.dumps([["", 3], *([f"a{i}", 0] for i in range(101))]),
    ],
)
def test_bytes_that_are_no_bundle_are_refused(head: str) -> None:
    with pytest.raises(ValueError, match=r"no bundle|Expecting|decode"):
        neighbours.unpacked(neighbours.MAGIC + head.encode("latin-1") + b"\n" + b"abc")


def test_a_neighbour_of_the_current_folder_is_nobodys(tmp_path: Path) -> None:
    """A command in a folder with a gaits.py of somebody else's takes the one beside the task."""
    path = three(tmp_path / "tasks")
    pole(tmp_path / "here", "raise RuntimeError\n", "gaits.py")
    command = [sys.executable, "-P", "-m", "farm", "check", f"{path}:Pole"]
    process = subprocess.run(
        command,
        cwd=tmp_path / "here",
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "same bits together" in process.stdout, process.stderr
