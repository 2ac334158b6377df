"""The files of a recording: parts that a run left behind, merged, repaired and compacted.

Rerun overwrites the file it is given, and a file truncated by a crash cannot be read until `rerun
rrd optimize` has repaired it. So a run that continues repairs existing files that cannot be read,
and starts a new part.
"""

import importlib.util
import json
import logging
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from farm.errors import ConfigError, check_addresses

if TYPE_CHECKING:
    from rerun.chunk import RrdReader

log = logging.getLogger(__name__)

COMPACTING: Final = 600.0
"""How long merging may take [s]; 30 MiB take about one."""

_EACH_GENERATION: Final = "/learning/return"  # an entity with one row per generation

_ENDS_WITH_PARENT: Final = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(sys.argv[1]):  # it ended before that
        sys.exit(1)
os.execvp(sys.argv[2], sys.argv[2:])
"""
"""Runs the program in its arguments, which ends when its parent, given first, is killed."""


def check_rerun() -> None:
    """Check that rerun-sdk, an extra that workers do not need, is installed and can run; else a
    ConfigError.
    """
    check_addresses(4 << 30, "recording", ", and --no-record needs 2 GiB")
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError(
            "recording needs rerun-sdk: pip install 'rerun-sdk<0.42', or record nothing:"
            " --no-record"
        )


def parts(path: Path) -> list[Path]:
    """The existing files of a recording: run.rrd, run.part2.rrd, ...; open them together."""
    further = [f for f in path.parent.glob(f"{path.stem}.part*{path.suffix}") if _number(path, f)]
    further.sort(key=lambda f: _number(path, f))
    return [path, *further] if path.exists() else further


def set_aside(path: Path) -> None:
    """Rename the files of a recording to undone.rrd, undone.part2.rrd, ..., in place of older ones
    of these names.
    """
    if files := parts(path):
        aside = path.with_name(f"undone{path.suffix}")
        for each in parts(aside):
            each.unlink()
        for each in files:
            each.rename(each.with_name(aside.stem + each.name.removeprefix(path.stem)))


def last_generation(path: Path) -> int:
    """The last generation in a recording's files, 0 if there are none; truncated files are
    repaired.

    Raises:
      ConfigError: they cannot be read.
    """
    try:
        return _last_generation(path)
    except Exception:  # Rerun's reader raises many types
        compact(path)
    try:
        return _last_generation(path)
    except Exception as error:
        raise ConfigError(
            f"cannot read {path}: {error}; move it away, or choose a different --out"
        ) from None


def _reader(path: Path) -> "RrdReader":
    """A reader of a recording, also of one that a killed run left without an end, of which Rerun
    warns.
    """
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return RrdReader(path)


def _last_generation(path: Path) -> int:
    for part in reversed(parts(path)):  # later generations are in later parts
        chunks = (
            chunk for chunk in _reader(part).stream() if chunk.entity_path == _EACH_GENERATION
        )
        batches = [chunk.to_record_batch() for chunk in chunks]
        columns = [
            batch.column("generation") for batch in batches if "generation" in batch.schema.names
        ]
        if last := max(
            (number for column in columns for number in column.cast("int64").to_pylist()), default=0
        ):
            return last
    return 0


def program() -> str:
    """Path of Rerun's program itself: `python -m rerun` would only be its parent, and end without
    it.
    """
    import rerun_cli  # an extra

    return os.environ.get("RERUN_CLI_PATH") or str(Path(rerun_cli.__file__).with_name("rerun"))


def compact(path: Path) -> bool:
    """Merge a recording's parts into one compact file, repairing one truncated by a crash.

    Returns:
      whether it worked; if not, every part is unchanged.
    """
    files = parts(path)
    try:
        tidy(path)
        _replace(path, "optimize", *files)
        for old in files:
            if old != path:
                old.unlink()
    except (OSError, subprocess.SubprocessError) as error:
        log.warning("the recording %s stays as it is, not merged or compacted: %s", path, error)
        return False
    finally:
        tidy(path)
    return True


def with_layout(path: Path, layout: Callable[[Path], None]) -> None:
    """Give a compacted recording one layout, which `layout` writes to a file.

    It may have kept several in any order.

    Raises:
      OSError: the disk is full, or Rerun's command fails; the file is as it was.
    """
    _, home = _left_behind(path)
    try:
        home.mkdir()
        bare, layouts = home / "bare.rrd", home / "layout.rbl"
        reader = _reader(path)
        [store] = reader.recordings()
        reader.stream(store=store).write_rrd(
            bare, application_id=store.application_id, recording_id=store.recording_id
        )
        layout(layouts)
        _replace(path, "merge", bare, layouts)
    except (RuntimeError, ValueError, subprocess.SubprocessError) as error:
        raise OSError(f"no layout in {path}: {error}") from error
    finally:
        tidy(path)


def _replace(path: Path, action: str, *files: Path) -> None:
    """Replace a recording by what Rerun's command makes of files.

    The command ends with this process.
    """
    merged, home = _left_behind(path)
    command = [program(), "rrd", action, *map(str, files), "-o", str(merged)]
    bound = [sys.executable, "-ISc", _ENDS_WITH_PARENT, str(os.getpid()), *command]
    subprocess.run(
        bound, env=quiet(home.absolute()), check=True, capture_output=True, timeout=COMPACTING
    )
    merged.replace(path)


def tidy(path: Path) -> None:
    """Remove temporary files of a process that was killed while compacting this recording."""
    merged, home = _left_behind(path)
    with suppress(OSError):
        merged.unlink(missing_ok=True)
    shutil.rmtree(home, ignore_errors=True)


def _left_behind(path: Path) -> tuple[Path, Path]:
    """The file that a recording is merged into, and the folder that Rerun's command takes for a
    home.
    """
    return path.with_name(f"{path.stem}.merging{path.suffix}"), path.with_name(
        f"{path.stem}.merging"
    )


def next_part(path: Path) -> Path:
    """The file in which a run continues to record; merging is left to its end, as it may take
    minutes.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    tidy(path)
    if not parts(path):
        return path
    last = max(_number(path, parts(path)[-1]), 1)
    return path.with_name(f"{path.stem}.part{last + 1}{path.suffix}")


def _number(path: Path, part: Path) -> int:
    """Number of a part, 0 if the file is not one."""
    digits = part.name.removeprefix(f"{path.stem}.part").removesuffix(path.suffix)
    return int(digits) if digits.isdecimal() else 0


def quiet(home: Path) -> dict[str, str]:
    """An environment in which Rerun's command sends no usage data and writes no settings."""
    settings = home / "rerun" / "analytics.json"
    settings.parent.mkdir(parents=True)
    # Rerun ignores the file if a field is missing
    values = {"analytics_enabled": False, "analytics_id": "none", "metadata": {}}
    places = {"config_file_path": str(settings), "data_dir_path": str(home / "data")}
    settings.write_text(json.dumps(values | places), encoding="utf-8")
    return {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home), "RUST_LOG": "warn"}
