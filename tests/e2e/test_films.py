"""A page's film is what its command makes today: made again, it resembles the one that the page
shows.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from processes import Farm

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs/pictures"
STEP = 10  # [ms], the unit in which a gif counts time

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def film(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pictures of a film (F, height, width, 3), and which of them is shown in each hundredth of a
    second (T,).
    """
    pictures, shown = [], []
    with Image.open(path) as image:
        for at, frame in enumerate(ImageSequence.Iterator(image)):
            pictures.append(np.asarray(frame.convert("RGB"), dtype=int))
            shown += [at] * (frame.info["duration"] // STEP)
    return np.stack(pictures), np.array(shown)


def difference(made: Path, page: Path) -> float:
    """Share of pixels that differ clearly, in the moment in which most do."""
    (one, when), (other, then) = film(made), film(page)
    assert one.shape[1:] == other.shape[1:], "of the same size"
    assert abs(len(when) - len(then)) <= 0.02 * len(then), "and as long"
    pairs = {(when[at], then[at]) for at in range(min(len(when), len(then)))}
    return max(float((np.abs(one[a] - other[b]).max(axis=-1) > 60).mean()) for a, b in pairs)


def drawable() -> None:
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "osmesa")}
    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)"
    if subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, check=False
    ).returncode:
        pytest.skip("MuJoCo cannot draw here: apt-get install libosmesa6")


def test_the_pendulum_of_the_readme(tmp_path: Path) -> None:
    drawable()
    commands = [
        line.strip().partition("  #")[0].split()
        for line in (ROOT / "README.md").read_text("utf-8").splitlines()
        if line.startswith(
            ("    farm run --task pendulum.py", "    farm replay runs/swing --video")
        )
    ]
    assert [words[1] for words in commands] == ["run", "replay"]
    farm = Farm(tmp_path)
    try:
        farm.call("new-task", "pendulum")
        for words in commands:
            farm.call(*words[1:])
    finally:
        farm.close()
    assert difference(tmp_path / "pendulum.gif", PICTURES / "pendulum.gif") < 0.005


@pytest.mark.parametrize("name", ["pendulum", "grips"])
def test_the_gallery(name: str, tmp_path: Path) -> None:
    """Two that learn within seconds; the program makes all of them alike."""
    drawable()
    table = "results/tables/gallery.jsonl"
    (tmp_path / table).parent.mkdir(parents=True)
    shutil.copy(ROOT / "docs" / table, tmp_path / table)
    words = ["--only", name, "--docs", str(tmp_path), "--runs", str(tmp_path / "runs")]
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "osmesa")}
    subprocess.run(
        [sys.executable, ROOT / "benchmarks/gallery.py", *words], check=True, env=environment
    )
    film = f"pictures/gallery/{name}.gif"
    assert difference(tmp_path / film, ROOT / "docs" / film) < 0.005


def test_another_film_is_told_apart(tmp_path: Path) -> None:
    pictures = [Image.fromarray(np.full((40, 40, 3), 240, dtype=np.uint8)) for _ in range(4)]
    for at, picture in enumerate(pictures):
        picture.paste((0, 0, 0), (8 * at, 8, 8 * at + 8, 16))
    first, *rest = pictures
    first.save(tmp_path / "one.gif", save_all=True, append_images=rest, duration=50)
    first.save(tmp_path / "other.gif", save_all=True, append_images=rest[::-1], duration=50)
    assert difference(tmp_path / "one.gif", tmp_path / "one.gif") == 0.0
    assert difference(tmp_path / "one.gif", tmp_path / "other.gif") > 0.02
