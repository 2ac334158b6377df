"""What a model reads: found by its MJCF, kept to its folder, compiled from nothing else."""

import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from robot import ARM, SCENE, robot, stl

from farm import plugins
from farm.__main__ import main as command
from farm.errors import ConfigError
from farm.runner import build_task
from farm.sim import model_files
from farm.sim.model_files import by_digest, compiled, joined, read, split


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return robot(tmp_path / "mine").parent


NAMES = ["assets/ground.bin", "assets/grey.png", "assets/link.stl", "parts/arm.xml", "scene.xml"]


def same(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Whether all numbers that decide a simulation are the same."""
    names = [n for n in dir(one) if isinstance(getattr(one, n), np.ndarray)]
    unlike = {n for n in names if not np.array_equal(getattr(one, n), getattr(other, n))}
    where = {"_sizes", "mesh_pathadr", "hfield_pathadr", "tex_pathadr"}  # the folders' names are of other lengths
    return len(names) > 200 and unlike <= where


def test_a_model_in_files_is_the_one_that_mujoco_reads_there(folder: Path) -> None:
    files = read(Path("robot/scene.xml"), folder)
    assert next(iter(files)) == "robot/scene.xml", "the model comes first"
    assert sorted(files) == sorted(f"robot/{name}" for name in NAMES)
    model = compiled(SCENE, "Reach", files, "robot/scene.xml")
    assert (model.nmesh, model.ntex, model.nhfield) == (1, 1, 1)
    assert same(model, mujoco.MjModel.from_xml_path(str(folder / "robot/scene.xml")))


def test_it_is_compiled_without_the_folder(folder: Path) -> None:
    files = read(Path("robot/scene.xml"), folder)
    before = compiled(SCENE, "Reach", files, "robot/scene.xml")
    for path in sorted(folder.rglob("*.*")):
        path.unlink()
    texts, assets = split(files)
    assert sorted(texts) == ["robot/parts/arm.xml", "robot/scene.xml"]
    again = joined(texts, assets, by_digest(files))
    assert again == files
    assert same(before, compiled(SCENE, "Reach", again, "robot/scene.xml"))


def test_a_text_and_an_absolute_path_read_files_too(folder: Path) -> None:
    text = '<mujoco><compiler assetdir="robot/assets"/><include file="robot/parts/arm.xml"/></mujoco>'
    beside = read(text, folder)
    assert list(beside) == ["model.xml", "robot/parts/arm.xml", "robot/assets/link.stl"]
    assert compiled(text, "Reach", beside).nmesh == 1
    anywhere = read(folder / "robot/scene.xml", None)
    assert sorted(anywhere) == sorted(NAMES), "its own folder is where its files are"
    assert compiled(SCENE, "Reach", anywhere, "scene.xml").nhfield == 1


def test_a_file_included_from_an_included_one_and_an_attached_model(folder: Path) -> None:
    (folder / "robot/parts/deep").mkdir()
    (folder / "robot/parts/deep/more.xml").write_text('<mujoco><worldbody><body name="b"/></worldbody></mujoco>')
    (folder / "robot/parts/arm.xml").write_text(ARM.replace("<asset>", '<include file="deep/more.xml"/><asset>', 1))
    gripper = folder / "robot/gripper.xml"
    gripper.write_text(
        '<mujoco><compiler meshdir="assets"/><asset><mesh name="claw" file="claw.stl"/></asset><worldbody>'
        '<body name="claw"><geom type="mesh" mesh="claw"/></body></worldbody></mujoco>'
    )
    (folder / "robot/assets/claw.stl").write_bytes(stl(0.1))
    scene = SCENE.replace("<texture name", '<model name="gripper" file="gripper.xml"/><texture name').replace(
        '<body name="ball"', '<body name="on"><attach model="gripper" body="claw" prefix="g-"/></body><body name="ball"'
    )
    (folder / "robot/scene.xml").write_text(scene)
    files = read(Path("robot/scene.xml"), folder)
    assert {"robot/parts/deep/more.xml", "robot/gripper.xml", "robot/assets/claw.stl"} <= set(files)
    model = compiled(scene, "Reach", files, "robot/scene.xml")
    assert same(model, mujoco.MjModel.from_xml_path(str(folder / "robot/scene.xml")))
    assert model.body("g-claw").id > 0


def edited(name: str, old: str, new: str) -> Callable[[Path], object]:
    def edit(folder: Path) -> None:
        path = folder / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    return edit


def linked(name: str, target: str) -> Callable[[Path], object]:
    def link(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).symlink_to(target)

    return link


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing mesh": (
        lambda folder: (folder / "robot/assets/link.stl").unlink(),
        "robot/parts/arm.xml: mesh 'link.stl': there is no file robot/assets/link.stl or robot/parts/assets/link.stl",
    ),
    "missing include": (
        lambda folder: (folder / "robot/parts/arm.xml").unlink(),
        "robot/scene.xml: include 'parts/arm.xml': there is no file robot/parts/arm.xml",
    ),
    "missing model": (lambda folder: (folder / "robot/scene.xml").unlink(), "xml: there is no file {}/robot/scene.xml"),
    "above": (
        edited("robot/parts/arm.xml", 'file="link.stl"', 'file="../../../link.stl"'),
        "robot/parts/arm.xml: mesh '../../../link.stl' leads out of the task's folder: put the file there, and name it "
        "from there",
    ),
    "absolute": (
        edited("robot/scene.xml", "parts/arm.xml", "/etc/hostname"),
        "robot/scene.xml: include '/etc/hostname' leads out of the task's folder: put the file there, and name it from "
        "there",
    ),
    "absolute folder": (
        edited("robot/scene.xml", 'assetdir="assets"', 'assetdir="/etc"'),
        "compiler: '/etc' leads out of the task's folder: give a path inside it, with /",
    ),
    "a link": (
        linked("robot/assets/link.stl", "/etc/hostname"),
        "robot/assets/link.stl is a link that leads out of {}: copy the file there",
    ),
    "a linked folder": (
        lambda folder: ((folder / "robot").rename(folder.parent / "r"), (folder / "robot").symlink_to("../r")),
        "robot/scene.xml is a link that leads out of {}: copy the file there",
    ),
    "no text": (
        lambda folder: (folder / "robot/parts/arm.xml").write_bytes(b"\xff\xfe\0"),
        "robot/parts/arm.xml is not a text in UTF-8, but the model reads it as MJCF",
    ),
    "no XML": (
        edited("robot/parts/arm.xml", "</worldbody>", ""),
        "robot/parts/arm.xml is not well-formed XML: mismatched tag: line 6, column 2",
    ),
    "a document type": (
        edited("robot/parts/arm.xml", "<mujoco>", '<!DOCTYPE m [<!ENTITY a "b/c">]><mujoco>'),
        "robot/parts/arm.xml has a document type, which MJCF does not use: remove it",
    ),
    "a device": (
        edited("robot/parts/arm.xml", "link.stl", "provider:link.stl"),
        "robot/parts/arm.xml: mesh 'provider:link.stl': expected a path in the task's folder, with /",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_read_is_one_line(folder: Path, case: str) -> None:
    spoil, expected = BAD[case]
    spoil(folder)
    with pytest.raises(ConfigError) as error:
        read(Path("robot/scene.xml"), folder)
    assert str(error.value) == expected.format(folder)


def test_a_file_above_the_limits_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (folder / "robot/assets/link.stl").open("ab") as file:
        file.truncate(model_files.FILE_LIMIT + 1)
    with pytest.raises(ConfigError, match=r"^robot/assets/link.stl has 32 MiB; a model's file has at most 32 MiB$"):
        read(Path("robot/scene.xml"), folder)
    (folder / "robot/assets/link.stl").write_bytes(stl())
    monkeypatch.setattr(model_files, "LIMIT", 1500)
    with pytest.raises(ConfigError, match="the model's files have more than 0 MiB together"):
        read(Path("robot/scene.xml"), folder)


@pytest.mark.parametrize("text", [SCENE, SCENE.replace("parts/arm.xml", "/etc/hostname")])
def test_what_was_not_sent_is_not_read_from_this_machine(
    folder: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A learner's text may name any path: a worker's own files stay closed to it."""
    monkeypatch.chdir(folder / "robot")  # where MuJoCo would find them
    with pytest.raises(ConfigError, match=r"there is no file parts/arm.xml|leads out of the task's folder"):
        compiled(text, "Reach", {})


def test_mujocos_own_refusal_names_no_folder_of_ours(folder: Path) -> None:
    (folder / "robot/assets/link.stl").write_bytes(b"no mesh")
    files = read(Path("robot/scene.xml"), folder)
    with pytest.raises(ConfigError, match=r"^Reach: MuJoCo refuses the model: ") as error:
        compiled(SCENE, "Reach", files, "robot/scene.xml")
    assert "rolloutfarm-model" not in str(error.value)


def test_a_task_with_files_is_checked(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    task = build_task(plugins.find("tasks", f"{folder}/reach.py:Reach"), {}, None)
    assert task.main == "robot/scene.xml"
    assert task.model.nmesh == 1
    (folder / "robot/assets/link.stl").unlink()
    assert command(["check", f"{folder}/reach.py:Reach"]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("farm: robot/parts/arm.xml: mesh 'link.stl': there is no file")
    assert errors.count("\n") == 1


def test_no_class_in_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "__main__" in sys.modules
    with pytest.raises(ConfigError, match="its class is in no file: give xml an absolute path"):
        read(Path("robot/scene.xml"), None)
