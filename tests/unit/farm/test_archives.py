"""Files of arrays that other people made: damaged or hostile ones are refused in one line, without
filling memory.
"""

import io
import json
import random
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from farm import archives
from farm.errors import ConfigError
from learner.tools.export.command import listed

SOUND = {
    "task": "gait",
    "policy": "linear",
    "generation": 3,
    "control_period": 0.1,
    "mu": np.arange(2000.0),
    "interface": json.dumps(
        {
            "observations": [],
            "actions": [],
            "controls": [],
            "joints": [],
            "normaliser": None,
            "code": {"task": "0" * 64},
        }
    ),
}


def written(path: Path, **changed: Any) -> Path:
    np.savez_compressed(path, **(SOUND | changed))
    return path


def test_a_sound_file_is_read(tmp_path: Path) -> None:
    path = written(tmp_path / "sound.npz")
    assert archives.headers(path, ".npz")["mu"] == archives.Header((2000,), np.dtype("<f8"))
    assert archives.scalars(path, ".npz")["generation"] == 3
    assert archives.arrays(path, ".npz")["mu"].tobytes() == np.arange(2000.0).tobytes()
    assert listed(path)[0] == "linear for gait after generation 3; a control step takes 0.1 s"


def test_wherever_a_file_is_cut_it_is_one_line(tmp_path: Path) -> None:
    content, path = written(tmp_path / "sound.npz").read_bytes(), tmp_path / "cut.npz"
    for size in range(0, len(content), 97):
        path.write_bytes(content[:size])
        with pytest.raises(ConfigError, match=r"cut.npz is no .npz of farm export, or damaged: ."):
            listed(path)


def test_whichever_byte_is_wrong_it_is_one_line_or_not_noticed(tmp_path: Path) -> None:
    content = written(tmp_path / "sound.npz").read_bytes()
    path = tmp_path / "bad.npz"
    rng = random.Random(0)
    refused: list[str] = []
    for _ in range(300):
        at = rng.randrange(len(content))
        path.write_bytes(content[:at] + bytes([rng.randrange(256)]) + content[at + 1 :])
        try:
            listed(path)
            archives.arrays(path, ".npz")
        except ConfigError as error:
            refused.append(str(error))
    assert len(refused) > 100
    assert not [line for line in refused if "\n" in line]


def bomb(path: Path, name: str, header: dict[str, Any], megabytes: int) -> Path:
    """A small file, of which one array has many zeros."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, header)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for each, value in SOUND.items():
            content = io.BytesIO()
            np.save(content, np.asarray(value))
            if each != name:
                file.writestr(f"{each}.npy", content.getvalue())
        with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
            entry.write(head.getvalue())
            for _ in range(megabytes):
                entry.write(bytes(1 << 20))
    return path


def test_a_file_that_unpacks_to_much_more_is_listed_by_its_headers(tmp_path: Path) -> None:
    header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 24,)}
    path = bomb(tmp_path / "bomb.npz", "mu", header, megabytes=128)
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        assert listed(path)[-1] == "arrays: mu (16777216,)"
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    with pytest.raises(ConfigError, match="its arrays have 128 MiB, at most 64 are read"):
        archives.arrays(path, ".npz", most=64 << 20)


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        (
            {"descr": "<U16777216", "fortran_order": False, "shape": ()},
            "interface has 64 MiB, at most 4 are read",
        ),
        ({"descr": "|O", "fortran_order": False, "shape": ()}, "an array of an unknown kind"),
        ({"descr": "<f8", "fortran_order": False, "shape": (-1, 3)}, "an array of an unknown kind"),
        (
            {"descr": "<f8", "fortran_order": False, "shape": (10**30,)},
            "an array of an unknown kind",
        ),
    ],
)
def test_texts_and_headers_that_no_export_writes(
    tmp_path: Path, header: dict[str, Any], reason: str
) -> None:
    path = bomb(
        tmp_path / "bomb.npz", "interface", header, megabytes=64 if "U" in header["descr"] else 1
    )
    with pytest.raises(ConfigError, match=reason):
        listed(path)


def test_very_many_arrays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "_ENTRIES", 5)
    with pytest.raises(ConfigError, match="6 arrays, at most 5 are read"):
        listed(written(tmp_path / "many.npz"))


@pytest.mark.parametrize(
    "interface",
    [
        "",
        "no JSON",
        "[" * 100_000,
        "[]",
        "7",
        "{}",
        '{"observations": 3}',
        '{"observations": [{}]}',
        "null",
        7.5,
    ],
)
def test_an_interface_that_is_none(tmp_path: Path, interface: object) -> None:
    path = written(tmp_path / "bad.npz", interface=interface)
    with pytest.raises(
        ConfigError, match=r"bad.npz is damaged: it does not name its numbers as farm export does"
    ):
        listed(path)


@pytest.mark.parametrize("changed", [{"control_period": "soon"}, {"generation": np.arange(3)}])
def test_other_entries_that_no_export_writes(tmp_path: Path, changed: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="bad.npz"):
        listed(written(tmp_path / "bad.npz", **changed))
