"""Sources of tasks, policies and commands: built in, installed packages, files; and their
errors.
"""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import farm
from farm import plugins
from farm.errors import ConfigError, UnservedError
from farm.plugins import allowed, author_traceback, code_digest, find, names
from farm.tasks.finger_gait.task import FingerGait

# ---------------------------------------------------------------- built in


def test_built_in() -> None:
    plugin = find("tasks", "finger-gait")
    assert (plugin.target, plugin.wire, plugin.origin, plugin.release, plugin.file) == (
        FingerGait,
        "finger-gait",
        "built in",
        "",
        None,
    )
    assert len(plugin.digest()) == 64
    assert names("policies") == dict.fromkeys(
        (
            "direct",
            "projected",
            "kernel",
            "cosine",
            "constant",
            "linear",
            "mlp",
            "rbf",
            "weighted-kernel",
            "rnn",
            "cpg",
        ),
        "built in",
    )


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in plugins.BUILT_IN for name in plugins.BUILT_IN[kind]]
)
def test_every_built_in_one_is_there(kind: str, name: str) -> None:
    choice = f"{name}:Swimmer-v5" if name == "gym" else name
    if name == "warp":
        pytest.importorskip("mujoco_warp")
    assert callable(find(kind, choice).target)


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        (
            "tasks",
            "juggling",
            (
                r"unknown task 'juggling'; known are finger-gait, fragile-bar, turning, gym, or"
                r" FILE\.py:CLASS"
            ),
        ),
        ("policies", "pid", r"unknown policy 'pid'; known are direct, .*, or FILE\.py:CLASS"),
        ("backends", "gpu", r"unknown backend 'gpu'; known are cpu, warp, or FILE"),
        ("commands", "fly", r"^unknown command 'fly'; farm --help lists them$"),
        ("commands", "rnu", "^unknown command 'rnu'; did you mean run\\?$"),
        (
            "tasks",
            "finger-giat",
            "unknown task 'finger-giat'; .*CLASS; did you mean finger-gait\\?$",
        ),
        ("tasks", "gym", "task 'gym': expected gym:NAME"),
        ("tasks", "gym:", "task 'gym:': expected gym:NAME"),
        ("tasks", "finger-gait:bar", "task 'finger-gait:bar': expected finger-gait$"),
        ("tasks", "", "unknown task ''"),
    ],
)
def test_unknown_names_say_what_there_is(kind: str, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        find(kind, name)


def test_a_file_with_the_unknown_name_is_suggested_and_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pendulum.py").write_text("class Pendulum: pass\nraise SystemExit('it was run')\n")
    Path("two.py").write_text("class A: pass\nclass B: pass\n")
    for name, content in (("empty.py", b""), ("broken.py", b"class ("), ("binary.py", b"\0\xff")):
        Path(name).write_bytes(content)
    for name in ("pendulum", "pendulum.py", "pendulum:Pendulum"):
        with pytest.raises(
            ConfigError, match=r"or FILE\.py:CLASS; did you mean pendulum\.py:Pendulum\?$"
        ):
            find("tasks", name)
    with pytest.raises(ConfigError, match=r"; did you mean two\.py:A or two\.py:B\?$"):
        find("policies", "two")
    for name in ("empty", "broken", "binary", "x" * 5000, "a\0b"):
        with pytest.raises(ConfigError, match=r"or FILE\.py:CLASS$"):
            find("tasks", name)


def test_a_variant_is_what_stands_behind_the_colon() -> None:
    plugin = find("tasks", "gym:Some-v5")
    assert (plugin.variant, plugin.wire, plugin.name) == ("Some-v5", "gym:Some-v5", "gym:Some-v5")


# ---------------------------------------------------------------- files

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str, name: str = "mine.py") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


def test_a_class_in_a_file(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write("class Mine:\n    number = 7\nclass Other: pass\n")
    plugin = find("tasks", f"{path}:Mine")
    assert (plugin.target.number, plugin.wire, plugin.origin, plugin.file) == (
        7,
        "mine.py:Mine",
        str(path),
        path,
    )
    assert plugin.digest() == hashlib.sha256(path.read_bytes()).hexdigest()
    assert find("policies", f"{path}:Other").target.__module__ == plugin.target.__module__, (
        "it is imported once"
    )
    monkeypatch.chdir(path.parent)
    assert find("tasks", "mine.py:Mine").target is plugin.target
    assert str(path.parent) not in sys.path
    assert not (path.parent / "__pycache__").exists()


def test_a_file_that_changed_is_another_one(write: Write) -> None:
    path = write("class Mine: number = 7\n")
    before = find("tasks", f"{path}:Mine")
    digest = before.digest()
    path.write_text("class Mine: number = 8\n")
    after = find("tasks", f"{path}:Mine")
    assert (before.target.number, after.target.number) == (7, 8)
    assert before.digest() == digest != after.digest(), "a digest is of the code that was imported"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\nclass Mine\n", r"mine\.py cannot be imported: line 2: expected ':'"),
        (
            "x = 1\n\nx = 1 / 0\n",
            r"mine\.py cannot be imported: line 3: ZeroDivisionError: division by zero",
        ),
        ("def f():\n    raise OSError('no')\n\nf()\n", r"cannot be imported: line 2: OSError: no"),
        ("import sys\nsys.exit(3)\n", r"cannot be imported: line 2: SystemExit: 3"),
        (
            "import nowhere_to_be_found\n",
            "line 1: ModuleNotFoundError: No module named 'nowhere_to_be_found'",
        ),
        ("import json\njson.loads('{')\n", "line 2: JSONDecodeError"),
        (
            "class Yours: pass\nfrom pathlib import Path\n",
            "mine.py has no class 'Mine'; it has Yours$",
        ),
        ("Mine = 3\n", "has no class 'Mine'; it has none"),
        ("x = '\0'\n", "cannot be imported: "),
    ],
    ids=range(9),
)
def test_a_file_that_is_of_no_use_is_one_line(write: Write, text: str, words: str) -> None:
    path = write(text)
    for _ in range(2):
        with pytest.raises(ConfigError, match=words) as caught:
            find("tasks", f"{path}:Mine")
        assert len(str(caught.value).splitlines()) == 1


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"policy .*none\.py: there is no such file"):
        find("policies", f"{tmp_path}/none.py:Mine")


@pytest.mark.timeout(20)
def test_what_is_no_file_of_a_class_is_not_opened(tmp_path: Path) -> None:
    (tmp_path / "zeros.py").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.py")
    (tmp_path / "folder.py").mkdir()
    for name in ("zeros.py", "pipe.py", "folder.py"):
        with pytest.raises(ConfigError, match=r"^task .*: it is not a file$"):
            find("tasks", f"{tmp_path / name}:Mine")
    with (tmp_path / "large.py").open("wb") as file:
        file.truncate(100_000_000)
    words = (
        "has 100000000 bytes; a class's file travels to workers and has at most 1000000: put data"
        " into a package"
    )
    with pytest.raises(ConfigError, match=words):
        find("tasks", f"{tmp_path / 'large.py'}:Mine")


def test_a_name_that_workers_refuse_is_refused_at_the_start(tmp_path: Path) -> None:
    for name, fine in (("a b (1).py", False), ("-a.py", False), ("a b-1.py", True)):
        (tmp_path / name).write_text("class Mine: pass\n")
        if fine:
            assert find("tasks", f"{tmp_path / name}:Mine").wire == f"{name}:Mine"
        else:
            with pytest.raises(ConfigError, match="its name may have letters, .* only; rename it"):
                find("tasks", f"{tmp_path / name}:Mine")


def test_a_file_of_somebody_elses(write: Write, tmp_path: Path) -> None:
    path = write("class Mine: pass\n")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    plugin = allowed("tasks", "mine.py:Mine", digest, (tmp_path / "other.py", path))
    assert plugin.file == path
    for wire, claim, files, words in (
        ("mine.py:Mine", digest, (), r"copy it here, and allow it by --allow-file mine\.py"),
        ("../mine.py:Mine", digest, (path,), "allow it by --allow-file"),
        ("mine.py:Mine", "", (path,), r"differs from the learner's mine\.py"),
        ("mine.py:Mine", digest, (tmp_path / "gone" / "mine.py",), "there is no such file"),
    ):
        with pytest.raises(UnservedError, match=words):
            allowed("tasks", wire, claim, files)


def test_the_author_is_told_where_it_happened(write: Write) -> None:
    path = write("def f():\n    raise OSError('no\\x1b[2J')\n\nf()\n")
    with pytest.raises(ConfigError) as caught:
        find("tasks", f"{path}:Mine")
    assert author_traceback(caught.value) == (
        f'  File "{path}", line 4, in <module>',
        "    f()",
        f'  File "{path}", line 2, in f',
        "    raise OSError('no\\x1b[2J')",
        "OSError: no?[2J",
    )
    path.write_text("x = 1\nclass Mine\n")
    with pytest.raises(ConfigError) as caught:
        find("tasks", f"{path}:Mine")
    assert author_traceback(caught.value)[-1] == "SyntaxError: expected ':'"
    assert author_traceback(ConfigError("nothing of the author's")) == ()


def test_a_long_traceback_is_cut(write: Write) -> None:
    path = write(
        "def f(n):\n    return f(n - 1) if n else 1 / 0 + "
        + "1 + " * 100
        + "1\ndef g(n):\n    f(n)\n"
        + "".join(f"def h{n}(): h{n - 1}()\n" for n in range(1, 60))
        + "def h0(): g(1)\nh59()\n"
    )
    with pytest.raises(ConfigError) as caught:
        find("tasks", f"{path}:Mine")
    lines = author_traceback(caught.value)
    assert len(lines) == 40
    assert max(map(len, lines)) == 250
    assert lines[-1] == "ZeroDivisionError: division by zero"


# ---------------------------------------------------------------- installed packages


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An installed distribution with a task, a broken one, and one that would take a built-in's
    name.
    """
    (tmp_path / "theirs_1.py").write_text("import theirs_2\nclass Walk:\n    steps = 5\n")
    (tmp_path / "theirs_2.py").write_text("")
    (tmp_path / "theirs_broken.py").write_text("raise RuntimeError('no licence')\n")
    info = tmp_path / "theirs-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(
        "[rolloutfarm.tasks]\nwalk = theirs_1:Walk\nbroken = theirs_broken:Task\nlost ="
        " theirs_1:Run\nfinger-gait = theirs_1:Walk\n[rolloutfarm.commands]\nhike = theirs_1:Walk\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    plugins._points.cache_clear()
    yield tmp_path
    plugins._points.cache_clear()
    for name in ("theirs_1", "theirs_2", "theirs_broken"):
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("package")
def test_a_class_of_an_installed_package() -> None:
    plugin = find("tasks", "walk")
    assert (plugin.target.steps, plugin.wire, plugin.release, plugin.origin) == (
        5,
        "walk",
        "theirs 1.2",
        "theirs 1.2",
    )
    assert names("tasks") == {
        **dict.fromkeys(("finger-gait", "fragile-bar", "turning", "gym"), "built in"),
        **dict.fromkeys(("walk", "broken", "lost"), "theirs 1.2"),
    }
    assert find("tasks", "finger-gait").target is FingerGait, "a built-in's name cannot be taken"
    assert find("commands", "hike").target.steps == 5
    with pytest.raises(
        ConfigError,
        match=(
            r"unknown task 'juggling'; known are finger-gait, fragile-bar, turning, gym, walk,"
            r" broken, lost"
        ),
    ):
        find("tasks", "juggling")


@pytest.mark.usefixtures("package")
def test_a_package_that_is_broken_says_so() -> None:
    with pytest.raises(
        ConfigError,
        match=r"task 'broken' of theirs 1\.2 cannot be imported: RuntimeError: no licence",
    ):
        find("tasks", "broken")
    with pytest.raises(
        ConfigError, match=r"task 'lost' of theirs 1\.2 cannot be imported: AttributeError: .*'Run'"
    ):
        find("tasks", "lost")


# ---------------------------------------------------------------- digests


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of five modules, of which `mine.a` imports all but one."""
    folder = tmp_path / "mine"
    (folder / "deep").mkdir(parents=True)
    for name, text in {
        "__init__": "",
        "a": (
            "import json\nfrom mine import b\nfrom . import deep\ndef late():\n    from .c"
            " import x\n"
        ),
        "b": "",
        "c": "x = 1\n",
        "unused": "",
        "deep/__init__": "from .e import y\n",
        "deep/e": "y = 2\n",
    }.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        del sys.modules[name]
    code_digest.cache_clear()


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("a", True),
        ("b", True),
        ("c", True),
        ("deep/__init__", True),
        ("deep/e", True),
        ("unused", False),
    ],
)
def test_a_digest_is_of_a_module_and_all_it_imports_of_its_package(
    source: Path, name: str, counts: bool
) -> None:
    code_digest.cache_clear()
    before = code_digest("mine.a")
    path = source / f"{name}.py"
    path.write_text(path.read_text() + "# changed\n")
    assert code_digest("mine.a") == before, "what was imported is not imported anew"
    code_digest.cache_clear()
    assert (code_digest("mine.a") != before) == counts


# ---------------------------------------------------------------- the public names


@pytest.mark.parametrize("name", farm.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(farm, name) is not None
    assert name in dir(farm)


def test_no_other_name_is_there() -> None:
    with pytest.raises(AttributeError, match="module 'farm' has no attribute 'lean'"):
        _ = farm.lean


def test_farm_alone_imports_nothing_heavy() -> None:
    code = (
        "import sys, farm; farm.Task; print(*sorted({'mujoco', 'zenoh', 'rerun', 'tyro'} &"
        " set(sys.modules)))"
    )
    output = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert output.strip() == "", "a task is declared without simulator or network"


def test_a_backend_whose_simulator_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    monkeypatch.delitem(sys.modules, "workers.backends.warp", raising=False)
    with pytest.raises(
        ConfigError, match="^backend 'warp' needs mujoco-warp: pip install mujoco-warp$"
    ):
        plugins.find("backends", "warp")
