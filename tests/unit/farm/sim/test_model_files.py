"""What a model reads: found by its MJCF, kept to its folder, compiled from nothing else."""

import struct
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
from farm.sim import compiling, model_files
from farm.sim.model_files import by_digest, compiled, joined, read, split


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return robot(tmp_path / "mine").parent


NAMES = ["assets/ground.bin", "assets/grey.png", "assets/link.stl", "parts/arm.xml", "scene.xml"]


def same(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Whether all numbers that decide a simulation are the same."""
    names = [n for n in dir(one) if isinstance(getattr(one, n), np.ndarray)]
    unlike = {n for n in names if not np.array_equal(getattr(one, n), getattr(other, n))}
    # The folders' names are of other lengths
    where = {"_sizes", "mesh_pathadr", "hfield_pathadr", "tex_pathadr"}
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


def test_large_compiled_models_are_forgotten_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    small = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    large = small.replace("<geom", "<body><freejoint/><geom size='1'/></body><geom")
    compilations: list[str] = []
    compile_model = model_files.compile_model

    def counted(main: str, get: compiling.Get) -> compiling.Compiled:
        compilations.append(main)
        return compile_model(main, get)

    monkeypatch.setattr(model_files, "compile_model", counted)
    sizes = [
        len(model_files.compile_model("m", {"m": text.encode()}.get).binary)
        for text in (small, large)
    ]
    monkeypatch.setattr(model_files, "_SMALL", sizes[0])
    compilations.clear()
    for text in (small, large):
        compiled(text, "it")
    model_files.keep_small()
    for text in (small, large):
        compiled(text, "it")
    assert len(compilations) == 3, "the small one is compiled once"


def test_a_text_and_an_absolute_path_read_files_too(folder: Path) -> None:
    text = (
        '<mujoco><compiler assetdir="robot/assets"/><include file="robot/parts/arm.xml"/></mujoco>'
    )
    beside = read(text, folder)
    assert list(beside) == ["model.xml", "robot/parts/arm.xml", "robot/assets/link.stl"]
    assert compiled(text, "Reach", beside).nmesh == 1
    anywhere = read(folder / "robot/scene.xml", None)
    assert sorted(anywhere) == sorted(NAMES), "its own folder is where its files are"
    assert compiled(SCENE, "Reach", anywhere, "scene.xml").nhfield == 1


def test_a_file_included_from_an_included_one_and_an_attached_model(folder: Path) -> None:
    (folder / "robot/parts/deep").mkdir()
    (folder / "robot/parts/deep/more.xml").write_text(
        '<mujoco><worldbody><body name="b"/></worldbody></mujoco>'
    )
    (folder / "robot/parts/arm.xml").write_text(
        ARM.replace("<asset>", '<include file="deep/more.xml"/><asset>', 1)
    )
    gripper = folder / "robot/gripper.xml"
    gripper.write_text(
        '<mujoco><compiler meshdir="assets"/><asset><mesh name="claw"'
        ' file="claw.stl"/></asset><worldbody><body name="claw"><geom type="mesh"'
        ' mesh="claw"/></body></worldbody></mujoco>'
    )
    (folder / "robot/assets/claw.stl").write_bytes(stl(0.1))
    scene = SCENE.replace(
        "<texture name", '<model name="gripper" file="gripper.xml"/><texture name'
    ).replace(
        '<body name="ball"',
        '<body name="on"><attach model="gripper" body="claw" prefix="g-"/></body><body name="ball"',
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
        "robot/scene.xml: there is no file robot/assets/link.stl or robot/parts/link.stl",
    ),
    "missing include": (
        lambda folder: (folder / "robot/parts/arm.xml").unlink(),
        "robot/scene.xml: there is no file robot/parts/arm.xml",
    ),
    "missing model": (
        lambda folder: (folder / "robot/scene.xml").unlink(),
        "xml: there is no file {}/robot/scene.xml",
    ),
    "above": (
        edited("robot/scene.xml", "parts/arm.xml", "../../arm.xml"),
        (
            "robot/scene.xml: ../arm.xml lies outside of the task's folder {}: put the task's file"
            " into {parent} and name the model from there, or give the class that folder: root ="
            " Path(...)"
        ),
    ),
    "far above": (
        edited("robot/parts/arm.xml", 'file="link.stl"', 'file="../../../link.stl"'),
        (
            "robot/scene.xml: ../link.stl lies outside of the task's folder {}: put the task's file"
            " into {parent} and name the model from there, or give the class that folder: root ="
            " Path(...)"
        ),
    ),
    "absolute": (
        edited("robot/scene.xml", "parts/arm.xml", "/etc/hostname"),
        (
            "robot/scene.xml: /etc/hostname lies outside of {}: put the file there, and name it"
            " from there"
        ),
    ),
    "absolute folder": (
        edited("robot/scene.xml", 'assetdir="assets"', 'assetdir="/etc"'),
        (
            "robot/scene.xml: /etc/link.stl lies outside of {}: put the file there, and name it"
            " from there"
        ),
    ),
    "a link": (
        linked("robot/assets/link.stl", "/etc/hostname"),
        "robot/assets/link.stl is a link that leads out of {}: copy the file there",
    ),
    "a linked folder": (
        lambda folder: (
            (folder / "robot").rename(folder.parent / "r"),
            (folder / "robot").symlink_to("../r"),
        ),
        "robot/scene.xml is a link that leads out of {}: copy the file there",
    ),
    "no text": (
        lambda folder: (folder / "robot/parts/arm.xml").write_bytes(b"\xff\xfe\0"),
        "robot/scene.xml: MuJoCo refuses the model: XML Error: Include error: 'XML parse error",
    ),
    "no XML": (
        edited("robot/parts/arm.xml", "</worldbody>", ""),
        "robot/scene.xml: MuJoCo refuses the model: XML Error: Include error: 'XML parse error",
    ),
    "a device": (
        edited("robot/parts/arm.xml", "link.stl", "provider:link.stl"),
        (
            "robot/scene.xml: there is no file robot/assets/provider:link.stl or"
            " robot/parts/provider:link.stl"
        ),
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_read_is_one_line(folder: Path, case: str) -> None:
    spoil, expected = BAD[case]
    spoil(folder)
    with pytest.raises(ConfigError) as error:
        read(Path("robot/scene.xml"), folder)
    assert str(error.value).startswith(expected.format(folder, parent=folder.parent))
    assert "\n" not in str(error.value)


def test_a_file_above_the_limits_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (folder / "robot/assets/link.stl").open("ab") as file:
        file.truncate(model_files.FILE_LIMIT + 1)
    with pytest.raises(
        ConfigError, match=r"^robot/assets/link.stl has 32 MiB; a model's file has at most 32 MiB$"
    ):
        read(Path("robot/scene.xml"), folder)
    (folder / "robot/assets/link.stl").write_bytes(stl())
    monkeypatch.setattr(model_files, "LIMIT", 1500)
    with pytest.raises(ConfigError, match="the model's files have more than 0 MiB together"):
        read(Path("robot/scene.xml"), folder)


BODY = """<asset><mesh name="m" file="m.stl"/></asset><worldbody><body><joint name="j"/>
  <geom type="mesh" mesh="m"/></body></worldbody>"""

LENIENT: dict[str, str] = {
    "a comment with --": f"<mujoco><!-- ---- legs ---- -->{BODY}</mujoco>",
    "a comment that ends in --->": f"<mujoco><!-- legs --->{BODY}</mujoco>",
    "no space between attributes": f"<mujoco>{BODY}</mujoco>".replace(
        'name="j"', 'name="j"type="hinge"'
    ),
    "an end tag too many": f"<mujoco>{BODY}</mujoco></mujoco>",
    "two roots": f"<mujoco>{BODY}</mujoco><mujoco/>",
    "a line before the declaration": f'\n<?xml version="1.0"?><mujoco>{BODY}</mujoco>',
    "a bare &": f'<mujoco model="arm & hand">{BODY}</mujoco>',
    "Latin-1": f"<mujoco><!-- pi\xe8ce -->{BODY}</mujoco>",
    "a namespace": f"<mujoco xmlns='x'>{BODY}</mujoco>",
    "a document type": f"<!DOCTYPE mujoco><mujoco>{BODY}</mujoco>",
}


@pytest.mark.parametrize("case", LENIENT)
def test_what_mujoco_loads_is_read(tmp_path: Path, case: str) -> None:
    (tmp_path / "m.stl").write_bytes(stl())
    scene = tmp_path / "scene.xml"
    scene.write_bytes(LENIENT[case].encode("latin-1"))
    files = read(scene, None)
    assert list(files) == ["scene.xml", "m.stl"]
    assert same(
        compiled(str(files["scene.xml"]), "m", files, "scene.xml"),
        mujoco.MjModel.from_xml_path(str(scene)),
    )


URDF = """<robot name="r"><link name="base"/><link name="l"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><geometry><mesh filename="m.stl"/></geometry></visual>
  <collision><geometry><mesh filename="m.stl"/></geometry></collision></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="l"/>
      <axis xyz="0 1 0"/></joint></robot>"""


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("arm.mjcf", f"<mujoco>{BODY}</mujoco>"),
        ("arm.urdf", URDF),
        ("ARM.XML", f"<mujoco>{BODY}</mujoco>"),
    ],
)
@pytest.mark.parametrize("kind", [str, Path])
def test_a_model_has_one_of_several_suffixes_and_its_path_may_be_a_text(
    tmp_path: Path, name: str, text: str, kind: type[str] | type[Path]
) -> None:
    (tmp_path / "m.stl").write_bytes(stl())
    (tmp_path / name).write_text(text)
    (tmp_path / "arm.py").write_text(
        "from pathlib import Path\nfrom farm import Task\n\n\nclass Arm(Task):\n    xml ="
        f" {kind(name)!r}\n".replace("PosixPath", "Path")
    )
    task = build_task(plugins.find("tasks", f"{tmp_path}/arm.py:Arm"), {}, None)
    assert task.main == name
    assert task.model.joint("j").id == 0
    assert (task.model.nmesh, sorted(task.sources)) == (1, sorted([name, "m.stl"]))


def test_another_suffix_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"^xml: arm\.txt: expected a model, with a name that ends in \.xml, \.mjcf, ",
    ):
        read("arm.txt", tmp_path)


@pytest.mark.parametrize(
    "form", ['meshdir="{}/robot/assets"', "assetdir='{}/robot/assets/'", "meshdir='{}'"]
)
def test_an_absolute_folder_inside_the_tasks_travels(tmp_path: Path, form: str) -> None:
    folder = tmp_path / "mine"
    assets = folder / "robot/assets"
    assets.mkdir(parents=True)
    name = "m.stl" if "assets" in form else "robot/assets/m.stl"
    (assets / "m.stl").write_bytes(stl())
    text = f"<mujoco><compiler {form.format(folder)}/>{BODY}</mujoco>".replace("m.stl", name)
    (folder / "robot/scene.xml").write_text(text)
    files = read(Path("robot/scene.xml"), folder)
    assert list(files) == ["robot/scene.xml", "robot/assets/m.stl"]
    (assets / "m.stl").unlink()
    assert str(folder) not in str(files["robot/scene.xml"])
    assert compiled(str(files["robot/scene.xml"]), "m", files, "robot/scene.xml").nmesh == 1


def test_a_task_names_the_folder_of_its_files(folder: Path) -> None:
    """Meshes beside the folder of the task and of the model, as in many packages of robots."""
    (folder / "tasks").mkdir()
    (folder / "robot/assets").rename(folder / "assets")
    (folder / "robot/scene.xml").write_text(SCENE.replace('"assets"', '"../assets"'))
    source = (folder / "reach.py").read_text()
    (folder / "tasks/reach.py").write_text(source.replace("robot/scene.xml", "../robot/scene.xml"))
    with pytest.raises(
        ConfigError,
        match=rf"lies outside of the task's folder {folder}/tasks: put the .* into {folder} ",
    ):
        build_task(plugins.find("tasks", f"{folder}/tasks/reach.py:Reach"), {}, None)
    (folder / "tasks/reached.py").write_text(
        source.replace("    xml =", '    root = ".."\n    xml =')
    )
    task = build_task(plugins.find("tasks", f"{folder}/tasks/reached.py:Reach"), {}, None)
    assert sorted(task.sources) == sorted([*NAMES[:3], "robot/parts/arm.xml", "robot/scene.xml"])
    assert task.model.nmesh == 1


@pytest.mark.parametrize("text", [SCENE, SCENE.replace("parts/arm.xml", "/etc/hostname")])
def test_what_was_not_sent_is_not_read_from_this_machine(
    folder: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A learner's text may name any path: a worker's own files stay closed to it."""
    monkeypatch.chdir(folder / "robot")  # where MuJoCo would find them
    with pytest.raises(ConfigError, match="Error opening file '(parts/arm.xml|/etc/hostname)'"):
        compiled(text, "Reach", {})


HEIGHTS = """<asset><hfield name='h' file='{}h.bin' size='1 1 1 1'/></asset>
  <worldbody><body name='b'><geom type='hfield' hfield='h'/></body></worldbody>"""

PROBES: dict[str, tuple[str, dict[str, str]]] = {
    "a folder": (
        "<mujoco xmlns='x'><compiler meshdir='{0}'/>" + HEIGHTS.format("") + "</mujoco>",
        {},
    ),
    "a folder of all": (
        "<mujoco><compiler assetdir='{0}'/>" + HEIGHTS.format("") + "</mujoco>",
        {},
    ),
    "a path": ("<mujoco>" + HEIGHTS.format("{0}/") + "</mujoco>", {}),
    "an include": ("<mujoco xmlns='x'><include file='{0}/o.xml'/></mujoco>", {}),
    "an include in an included file": (
        "<mujoco xmlns='x'><include file='a.xml'/></mujoco>",
        {"a.xml": "<mujoco><include file='{0}/o.xml'/></mujoco>"},
    ),
    "an attached model": ("<mujoco><asset><model name='o' file='{0}/o.xml'/></asset></mujoco>", {}),
    "an attached model's folder": (
        (
            "<mujoco><asset><model name='o' file='a.xml'/></asset><worldbody><body><attach"
            " model='o' body='b' prefix='p'/></body></worldbody></mujoco>"
        ),
        {"a.xml": "<mujoco><compiler meshdir='{0}'/>" + HEIGHTS.format("") + "</mujoco>"},
    ),
    "a robot's mesh": (
        (
            "<robot name='r'><mujoco><compiler strippath='false'/></mujoco><link"
            " name='l'><collision><geometry><mesh"
            " filename='{0}/m.stl'/></geometry></collision></link></robot>"
        ),
        {},
    ),
    "an entity": ("<!DOCTYPE m [<!ENTITY a SYSTEM '{0}/o.xml'>]><mujoco>&a;</mujoco>", {}),
    "a flexible body": (
        "<mujoco><worldbody><flexcomp name='f' type='mesh' file='{0}/m.stl'/></worldbody></mujoco>",
        {},
    ),
}


@pytest.mark.parametrize("case", PROBES)
@pytest.mark.parametrize(
    "way",
    [
        "{}",
        "/{}",
        "/.{}",
        "/nowhere/..{}",
        "/proc/self/root{}",
        "../../../../../../../../../../../..{}",
        "file://{}",
    ],
)
def test_a_model_cannot_find_out_what_is_on_this_machine(
    tmp_path: Path, case: str, way: str
) -> None:
    """A model that names a file here is answered as one that names a file that exists nowhere."""
    secret = tmp_path / "home"
    secret.mkdir()
    (secret / "h.bin").write_bytes(struct.pack("<ii4f", 2, 2, 0.0, 0.25, 0.5, 1.0))
    (secret / "o.xml").write_text(
        "<mujoco><custom><numeric name='pin' data='4711'/></custom></mujoco>"
    )
    (secret / "m.stl").write_bytes(stl())
    text, files = PROBES[case]
    answers = []
    for folder in (secret, tmp_path / "none"):
        path = way.format(folder)
        sent = {name: content.replace("{0}", path) for name, content in files.items()}
        try:
            model = compiled(text.replace("{0}", path), "m", sent)
            assert (model.nhfielddata, model.nnumeric, model.nmesh) == (0, 0, 0)
            answers.append("compiled")
        except ConfigError as error:
            answers.append(str(error).replace(str(folder), "FOLDER"))
    assert answers[0] == answers[1]


ENDLESS = """<mujoco><worldbody><replicate count="1000000000"><body>
    <geom size="1"/></body></replicate>
  </worldbody></mujoco>"""
TOO_LARGE = "a model may take 4 GiB"
GREEDY = {
    "a state": (
        '<mujoco><size memory="200G"/></mujoco>',
        f"Could not allocate memory; {TOO_LARGE}",
    ),
    "a texture": (
        (
            '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="60000"'
            ' height="60000"/></asset></mujoco>'
        ),
        TOO_LARGE,
    ),
    "a terrain": (
        (
            '<mujoco><asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1'
            ' 1"/></asset></mujoco>'
        ),
        TOO_LARGE,
    ),
    "time": (ENDLESS, "it takes more than 1 s to compile"),
}


@pytest.mark.parametrize("case", GREEDY)
def test_a_model_compiles_within_limits(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "SECONDS", 1)
    text, expected = GREEDY[case]
    with pytest.raises(ConfigError, match=rf"^m: MuJoCo refuses the model: .*{expected}") as error:
        compiled(text, "m")
    assert "\n" not in str(error.value)


def test_mujocos_own_refusal_names_no_folder_of_ours(folder: Path) -> None:
    (folder / "robot/assets/link.stl").write_bytes(b"no mesh")
    with pytest.raises(
        ConfigError, match=r"^robot/scene.xml: MuJoCo refuses the model: .*'robot/assets/link.stl'"
    ):
        read(Path("robot/scene.xml"), folder)


def test_a_task_with_files_is_checked(
    folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    task = build_task(plugins.find("tasks", f"{folder}/reach.py:Reach"), {}, None)
    assert task.main == "robot/scene.xml"
    assert task.model.nmesh == 1
    (folder / "robot/assets/link.stl").unlink()
    assert command(["check", f"{folder}/reach.py:Reach"]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("farm: robot/scene.xml: there is no file robot/assets/link.stl or ")
    assert errors.count("\n") == 1


def test_no_class_in_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "__main__" in sys.modules
    with pytest.raises(ConfigError, match="its class is in no file: give xml an absolute path"):
        read(Path("robot/scene.xml"), None)
