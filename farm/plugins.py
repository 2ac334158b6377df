"""Finds tasks, policies, algorithms, backends, loggers and commands: built in, from installed
packages, or from files.

finger-gait            built in: a line in BUILT_IN
my-task                from an installed package: an entry point of the group `rolloutfarm.tasks`
pendulum.py:Pendulum   a class in a file, named by its path
"""

import ast
import hashlib
import importlib
import importlib.util
import re
import signal
import stat
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, wraps
from importlib.metadata import EntryPoint, entry_points
from itertools import dropwhile
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

from farm import neighbours
from farm.errors import ConfigError, TaskError, UnservedError, described
from farm.near import meant

P = ParamSpec("P")
T = TypeVar("T")

GROUPS: Final[Mapping[str, Mapping[str, str]]] = {
    "learn": {
        "run": "starts a learner and local workers: learns a task and records it",
        "tune": "races policies and algorithms on one task; the best one learns to the end",
        "sweep": "learns settings x seeds on one set of workers; a table and a figure",
        "tasks": "lists tasks, policies, algorithms, backends and loggers, and their settings",
    },
    "a task of your own": {
        "new-task": "writes a task of 31 lines that runs, to start from",
        "check": "checks a task of your own: sizes, same bits in any batch, speed, a picture",
    },
    "look at a run": {
        "view": "opens the recordings of runs in the Rerun viewer",
        "runs": "prints a table of the runs in a folder",
        "replay": "simulates any policy or rollout of a run again, into a recording or a video",
        "play": "plays the learnt policy in MuJoCo's viewer, where the mouse pushes objects",
        "compare": "puts several runs into one recording: curves together, scenes side by side",
    },
    "measure a policy": {
        "evaluate": "tries the learnt mean policy on perturbed starts",
        "stress": "tries it under sensor errors, delays, weak motors, payloads and pushes",
        "chain": "runs learnt policies one after another, and counts the cycles",
        "verify": "repeats a run, and compares its numbers to the last bit",
    },
    "take it elsewhere": {
        "export": "writes the learnt policy to a file, for MuJoCo and numpy or as an ONNX model",
        "dataset": "writes episodes of the learnt policy as a data set, in LeRobot's format",
    },
    "several machines": {
        "learner": "starts only the learner; workers join it from any machine",
        "worker": "starts only workers; they serve every learner they find",
        "status": "shows the runs and workers of a farm, and their state",
        "record": "records a run on any machine, over the network",
        "router": "starts a permanent router that learners and workers connect to",
        "certificates": "makes certificates for a farm of several machines",
    },
}
"""The built-in commands and their purposes, by what they are for."""

COMMANDS: Final = {name: text for group in GROUPS.values() for name, text in group.items()}
"""The built-in commands and their purposes."""

_ELSEWHERE: Final = {
    **{name: f"learner.commands.{name}" for name in ("run", "learner")},
    **{name: f"farm.commands.{name}" for name in ("status", "router", "certificates")},
    "compare": "learner.tools.view.compare",
    "new-task": "learner.tools.tasks.new_task",
    "play": "learner.tools.replay.play",
    "tune": "learner.tools.sweep.tune_command",
    "worker": "workers.command",
}
"""Modules of commands that have no folder of their own in learner/tools/."""

BUILT_IN: Final[Mapping[str, Mapping[str, str]]] = {
    "tasks": {
        "finger-gait": "farm.tasks.finger_gait.task:FingerGait",
        "fragile-bar": "farm.tasks.finger_gait.fragile_bar:FragileBar",
        "turning": "farm.tasks.finger_gait.turning:Turning",
        "gym": "farm.tasks.gymnasium:Environment",
    },
    "policies": {
        "direct": "farm.policies.fourier:Direct",
        "projected": "farm.policies.fourier:Projected",
        "kernel": "farm.policies.fourier:Kernel",
        "cosine": "farm.policies.fourier:Cosine",
        "constant": "farm.policies.networks:Constant",
        "linear": "farm.policies.networks:Linear",
        "mlp": "farm.policies.networks:Mlp",
        "rbf": "farm.policies.radial:Rbf",
        "weighted-kernel": "farm.policies.radial:WeightedKernel",
        "rnn": "farm.policies.recurrent:Rnn",
        "cpg": "farm.policies.recurrent:Cpg",
    },
    "algorithms": {
        "pgpe": "learner.algorithms.pgpe:PGPE",
        "snes": "learner.algorithms.snes:SNES",
        "ars": "learner.algorithms.ars:ARS",
        "es": "learner.algorithms.es:ES",
        "cma-es": "learner.algorithms.cma:CMAES",
        "sep-cma": "learner.algorithms.cma:SepCMA",
    },
    "backends": {
        "cpu": "workers.backends.cpu:CpuBackend",
        "warp": "workers.backends.warp:WarpBackend",
    },
    "loggers": {
        "tensorboard": "learner.loggers.tensorboard:TensorBoard",
        "wandb": "learner.loggers.wandb:WeightsAndBiases",
    },
    "portfolios": {"general": "learner.tools.sweep.portfolio:General"},
    "commands": {
        name: f"{_ELSEWHERE.get(name, f'learner.tools.{name}.command')}:main" for name in COMMANDS
    },
}
"""Kinds of plug-ins, and the built-in ones by name.

Strings, because farm/ must not import learner/ or workers/.
"""

SOURCE_LIMIT: Final = 1_000_000
"""Largest size of a class's file, which may be sent to workers [bytes]."""

FILE_NAME: Final = re.compile(r"\w[\w. -]{0,100}\.py")
"""Names of files that workers accept; such a name cannot lead out of its folder."""

# Most lines of a traceback that is sent to other machines, and characters per line
_LINES, _WIDTH = (40, 250)
_MODULES: Final = "rolloutfarm_file_"  # prefix of the names of modules made from files


@dataclass(frozen=True)
class Plugin:
    """A class, and its origin."""

    kind: str
    """One of BUILT_IN's keys."""
    name: str
    """The name by which it is chosen; for a file PATH:CLASS."""
    target: Any
    """The class; for a command a function."""
    variant: str = ""
    """The part after the colon in a name with variants: `Swimmer-v5` of `gym:Swimmer-v5`."""
    release: str = ""
    """Name and version of its package; empty for built-in classes and for files."""
    file: Path | None = None
    """File of the plug-in, if it comes from a file."""
    source: bytes = field(default=b"", repr=False)
    """That file's bytes as they were when it was imported, with those of its neighbours
    (`farm.neighbours`).
    """

    @property
    def wire(self) -> str:
        """Name of the plug-in on other machines: for a file without its folder."""
        return self.name if self.file is None else f"{self.file.name}:{self.target.__name__}"

    @property
    def origin(self) -> str:
        """Origin of the plug-in, for display."""
        return str(self.file) if self.file else self.release or "built in"

    def digest(self) -> str:
        """SHA-256 of its code: of its file and neighbours, or of its module and its imports from
        the same package.
        """
        return (
            hashlib.sha256(self.source).hexdigest()
            if self.file
            else code_digest(self.target.__module__)
        )


def names(kind: str) -> dict[str, str]:
    """Names of the plug-ins of a kind, and the origin of each; files are not listed."""
    origins = dict.fromkeys(BUILT_IN[kind], "built in")
    for point in _points(kind):
        if point.name not in origins:
            origins[point.name] = _release(point)
    return origins


def find(kind: str, name: str) -> Plugin:
    """The plug-in with this name.

    Raises:
      ConfigError: there is none (the message lists the known ones), or it cannot be imported.
    """
    if not isinstance(name, str):
        raise ConfigError(f"{_one(kind)} {name!r:.60}; expected its name, or FILE.py:CLASS")
    path, _, inside = name.rpartition(":")
    if path.endswith(".py"):
        where = Path(path).resolve()
        return _of_source(kind, where, _bundle(where, f"{_one(kind)} {where}"), inside)
    base, _, variant = name.partition(":")
    if base in BUILT_IN[kind]:
        module, _, attribute = BUILT_IN[kind][base].partition(":")
        try:
            plugin = Plugin(kind, name, getattr(load(module), attribute), variant)
        except ImportError as error:
            # Only optional packages can be missing
            package = (error.name or "").partition(".")[0].replace("_", "-")
            raise ConfigError(
                f"{_one(kind)} {base!r} needs {package}: pip install {package}"
            ) from error
    else:
        plugin = _from_package(kind, base, variant)
    takes = getattr(plugin.target, "takes", "")
    if bool(takes) != bool(variant):
        raise ConfigError(
            f"{_one(kind)} {name[:80]!r}: expected {base}{f':{takes}' if takes else ''}"
        )
    return plugin


def _from_package(kind: str, name: str, variant: str) -> Plugin:
    for point in _points(kind):
        if point.name == name:
            try:
                target = point.load()
            except Exception as error:  # whatever an import may raise
                raise ConfigError(
                    f"{_one(kind)} {name!r} of {_release(point)} cannot be imported:"
                    f" {described(error)}"
                ) from error
            return Plugin(
                kind, f"{name}:{variant}" if variant else name, target, variant, _release(point)
            )
    choices = names(kind)
    near = meant(name, choices)
    unknown = f"unknown {_one(kind)} {name[:80]!r}"
    if kind == "commands":
        raise ConfigError(f"{unknown}{near or '; farm --help lists them'}")
    raise ConfigError(
        f"{unknown}; known are {', '.join(choices)}, or FILE.py:CLASS{near or _beside(name)}"
    )


def _beside(name: str) -> str:
    """A hint if there is a file with this name and classes in it, which is read but not run; else
    nothing.
    """
    path = Path(name if name.endswith(".py") else f"{name}.py")
    try:
        if not path.is_file() or path.stat().st_size > SOURCE_LIMIT:
            return ""
        classes = [
            node.name
            for node in ast.parse(path.read_bytes()).body
            if isinstance(node, ast.ClassDef)
        ]
    except (OSError, SyntaxError, ValueError, RecursionError):
        return ""
    several = " or ".join(f"{path}:{each}" for each in classes[:3])
    return f"; did you mean {several}?" if several else ""


def _read(path: Path, what: str, kind: type[ConfigError] = ConfigError) -> bytes:
    """A class's source; anything but a file of sensible name and size is refused before it is
    opened.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise kind(f"{what}: it is not a file")
        if not FILE_NAME.fullmatch(path.name):
            raise kind(
                f"{what}: its name may have letters, digits, '_', '.', '-' and spaces only;"
                " rename it"
            )
        if status.st_size > SOURCE_LIMIT:
            raise kind(
                f"{what} has {status.st_size} bytes; a class's file travels to workers and has at"
                f" most {SOURCE_LIMIT}: put data into a package"
            )
        return path.read_bytes()
    except FileNotFoundError:
        raise kind(f"{what}: there is no such file") from None
    except OSError as error:
        raise kind(f"{what}: it cannot be read: {error.strerror}") from None


def _bundle(path: Path, what: str, kind: type[ConfigError] = ConfigError) -> bytes:
    """A class's source with that of its neighbours, all of sensible size together."""
    source = _read(path, what, kind)
    others = {}
    for name in neighbours.named(path, source):
        beside = path.with_name(f"{name}.py")
        others[name] = _read(beside, f"{beside}, a neighbour that {path.name} names", kind)
    bundle = neighbours.packed(source, others)
    if len(bundle) > SOURCE_LIMIT:
        raise kind(
            f"{what} and its neighbours have {len(bundle)} bytes; expected at most {SOURCE_LIMIT}"
        )
    return bundle


def file_digest(path: Path) -> str:
    """SHA-256 of a file that may have a class, with its neighbours; empty if it has none or
    cannot be read.
    """
    try:
        return hashlib.sha256(_bundle(path, str(path))).hexdigest()
    except ConfigError:
        return ""


def no_exit(call: Callable[P, T]) -> Callable[P, T]:
    """Let what a plug-in's code raises be an error of this function, also sys.exit and others that
    end programs.
    """

    @wraps(call)
    def guarded(*values: P.args, **keywords: P.kwargs) -> T:
        try:
            return call(*values, **keywords)
        except BaseException as error:
            # Generators change a StopIteration
            usual = isinstance(error, Exception) and not isinstance(error, StopIteration)
            if usual or (isinstance(error, KeyboardInterrupt) and _of_signal(error)):
                raise
            last = author_frames(error)[-1:]
            where = "".join(f" in {Path(each.filename).name}, line {each.lineno}" for each in last)
            what = (
                f"sys.exit({error.code!r})" if isinstance(error, SystemExit) else described(error)
            )
            raise TaskError(f"{what}{where}: raise an error instead") from error

    return guarded


def _of_signal(error: KeyboardInterrupt) -> bool:
    """Whether Ctrl-C has raised it, as far as one can know: not if this process has another handler
    of Ctrl-C.
    """
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        return True
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and Path(frames[-1].filename).name == "signals.py"


def _of_source(kind: str, path: Path, source: bytes, inside: str) -> Plugin:
    module = _file_module(path, source)
    target = getattr(module, inside, None)
    if not isinstance(target, type):
        classes = [(name, value) for name, value in vars(module).items() if isinstance(value, type)]
        here = [name for name, value in classes if value.__module__ == module.__name__]
        raise ConfigError(f"{path} has no class {inside!r}; it has {', '.join(here) or 'none'}")
    return Plugin(kind, f"{path}:{inside}", target, file=path, source=source)


@cache
def _file_module(path: Path, source: bytes) -> Any:  # noqa: ANN401  a module
    """Import a file as it is now.

    Its folder is not on the import path, so it cannot shadow other modules.
    """
    try:
        return neighbours.imported(path, source, _MODULES)
    except BaseException as error:  # whatever the file may raise
        if isinstance(error, KeyboardInterrupt) and _of_signal(error):
            raise
        where = _where(error, neighbours.paths(path, source))
        raise ConfigError(
            f"{path} cannot be imported: {where}{_undeclared(error, path)}"
        ) from error


def _where(error: BaseException, paths: Sequence[Path]) -> str:
    """An error as text, with its line in the last of these files.

    The first is the one that is imported.
    """
    names = {str(each): f"{each.name}, " if each != paths[0] else "" for each in paths}
    if isinstance(error, SyntaxError) and error.lineno:
        return f"{names.get(error.filename or '', '')}line {error.lineno}: {error.msg}"
    frames = [each for each in traceback.extract_tb(error.__traceback__) if each.filename in names]
    return (
        f"{names[frames[-1].filename]}line {frames[-1].lineno}: " if frames else ""
    ) + described(error)


def _undeclared(error: BaseException, path: Path) -> str:
    """A hint if a file beside would be what cannot be imported."""
    name = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    if not name.isidentifier() or not path.with_name(f"{name}.py").is_file():
        return ""
    return f"; to import {name}.py beside it, add the line {neighbours.DECLARED} = ({name!r},)"


def author_frames(error: BaseException) -> traceback.StackSummary:
    """The frames of a traceback that are in plug-in files; `format` gives their texts."""
    files = {
        module.__file__ for name, module in list(sys.modules.items()) if name.startswith(_MODULES)
    }
    frames = traceback.extract_tb(error.__traceback__)
    return traceback.StackSummary.from_list([each for each in frames if each.filename in files])


def root(error: BaseException) -> BaseException:
    """The first cause of an error."""
    for _ in range(_LINES):
        error = error.__cause__ or error
    return error


def author_traceback(error: BaseException) -> tuple[str, ...]:
    """The traceback of an error in plug-in code, without the farm's own frames at its top, as
    printable lines.
    """
    error = root(error)
    ours = tuple(
        f"{Path(__file__).parent.parent / package}/" for package in ("farm", "workers", "learner")
    )
    frames = list(
        dropwhile(
            lambda each: each.filename.startswith(ours), traceback.extract_tb(error.__traceback__)
        )
    )
    if not frames and not isinstance(error, SyntaxError):
        return ()
    # Without carets, which differ between releases
    plain = traceback.format_list([(*each,) for each in frames])
    text = "".join([*plain, *traceback.format_exception_only(error)])
    lines = (
        "".join(letter if letter.isprintable() else "?" for letter in line)
        for line in text.splitlines()
    )
    return tuple(line[:_WIDTH] for line in lines)[-_LINES:]


def named_file(wire: str) -> str:
    """The file of a class NAME.py:CLASS; empty for names of other kinds."""
    name = wire.rpartition(":")[0]
    return name if name.endswith(".py") else ""


def allowed(kind: str, wire: str, digest: str, files: tuple[Path, ...]) -> Plugin:
    """Load the class NAME.py:CLASS, which a learner named, from the permitted file with this name
    and digest.

    Raises:
      UnservedError: no permitted file has this name, or its contents differ from the learner's.
    """
    name, _, inside = wire.rpartition(":")
    sources: dict[Path, bytes] = {}
    unread: list[UnservedError] = []
    for path in [path for path in files if path.name == name]:
        try:
            source = _bundle(path, str(path), UnservedError)
        except UnservedError as error:
            unread.append(error)
            continue
        if hashlib.sha256(source).hexdigest() == digest:
            return _of_source(kind, path.resolve(), source, inside)
        sources[path] = source
    if unread:
        raise unread[0]
    for path, source in sources.items():
        names = [each.name for each in neighbours.paths(path, source)[1:]]
        several = f", or {', '.join(names)} beside it" if names else ""
        copy = f"copy the learner's file{'s' if names else ''} there"
        raise UnservedError(f"{path}{several} differs from the learner's {name}: {copy}")
    raise UnservedError(
        f"{name} is a file on the learner's machine: copy it here, and allow it by --allow-file"
        f" {name}, or start this worker with --accept-code and --tls"
    )


@cache
def code_digest(module: str) -> str:
    """SHA-256 of a module's source and of all modules that it imports from its own top-level
    package.
    """
    sha256 = hashlib.sha256()
    for name, source in sorted(_sources(module).items()):
        sha256.update(name.encode() + b"\0" + source + b"\0")
    return sha256.hexdigest()


def _sources(module: str) -> dict[str, bytes]:
    """Sources of a module and of all modules that it imports, directly or not, from its own
    package.
    """
    sources: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in sources:
            continue
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
            continue
        sources[name] = Path(spec.origin).read_bytes()
        waiting += _imports(sources[name], spec.parent, module.partition(".")[0])
    return sources


@cache  # task, policy and simulation share most of their modules
def _imports(source: bytes, parent: str | None, package: str) -> tuple[str, ...]:
    """Modules of the top-level package that a source imports; relative to its parent."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), parent)
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(name for name in names if name.partition(".")[0] == package and _is_module(name))


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, AttributeError, ValueError):
        return False


@cache
def _points(kind: str) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=f"rolloutfarm.{kind}"))


def _release(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an installed package"


def load(module: str) -> Any:  # noqa: ANN401  a module
    """Import a module of rolloutfarm, even if the working directory has a folder `learner` or
    `workers`.

    Raises:
      ConfigError: a different module with that name has been imported before.
    """
    package = module.partition(".")[0]
    init = Path(__file__).parent.parent / package / "__init__.py"
    package_module = sys.modules.get(package)
    if package_module is None and package != "farm" and init.exists():
        spec = importlib.util.spec_from_file_location(
            package, init, submodule_search_locations=[str(init.parent)]
        )
        assert spec is not None
        assert spec.loader is not None
        sys.modules[package] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[package])
    elif init.exists() and Path(str(getattr(package_module, "__file__", None) or "")) != init:
        raise ConfigError(
            f"a module named {package!r} that is not rolloutfarm's is loaded: import farm before it"
        )
    return importlib.import_module(module)


def _one(kind: str) -> str:
    """A kind's name in the singular."""
    return {"policies": "policy"}.get(kind, kind.rstrip("s"))
