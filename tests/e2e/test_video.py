"""Videos of replays: which moments are drawn and how long each is shown, pictures side by side, GIF
and MP4.
"""

import ctypes.util
from pathlib import Path

import numpy as np
import pytest
from full import files_of_at_most
from processes import Farm

from farm.errors import RunError
from farm.sim import video
from farm.sim.channels import Channel
from farm.sim.paint import PALETTE
from learner.commands import recordings

needs_drawing = pytest.mark.skipif(
    not any(ctypes.util.find_library(name) for name in ("OSMesa", "EGL")),
    reason="needs OSMesa or EGL (Debian: libosmesa6 or libegl1)",
)


def test_pictures_in_a_grid() -> None:
    assert [video.tiled([np.zeros((3, 4, 3), np.uint8)] * n).shape[:2] for n in (1, 2, 5)] == [
        (3, 4),
        (3, 8),
        (6, 12),
    ]
    assert video.tiled([np.zeros((3, 4, 3), np.uint8)] * 5)[-1, -1].tolist() == [255] * 3


def test_moments_last_as_long_as_they_should() -> None:
    times = np.arange(151) * 0.01
    moments = video.moments(times.tolist(), speed=0.25, rest=1.0)
    assert len(moments) == 1.5 / 0.25 * 30 + 1 + 30
    assert moments[0] == 0
    assert moments[-31:] == [150] * 31
    assert np.all(np.diff(moments) >= 0)
    assert len(video.moments([0.0, 0.1], speed=10.0, rest=0.0)) == 2


def test_a_caption_is_in_the_lower_left_corner_and_fits() -> None:
    blank = np.full((90, 120, 3), 128, np.uint8)
    [short] = video.captioned([blank], "start 3")
    [long] = video.captioned([blank], "mean policy after generation 8\nreturn 1.5, success")
    for drawn in (short, long):
        rows, columns = np.nonzero((drawn != 128).any(axis=-1))
        assert (rows.max(), columns.min()) == (89, 0)
        assert drawn[rows.min() :, : columns.max()].min() < 80, "dark letters"
    assert (short[:, -1] == 128).all(), "no wider than its text"
    assert not (blank != 128).any()
    [same] = video.captioned([blank], "")
    assert same is blank


def test_bars_are_as_long_as_their_values() -> None:
    shown = Channel(
        name="speed",
        kind="scalars",
        shape=(3,),
        labels=("command", "speed", "turn"),
        limits={"turn": (-1.0, 1.0)},
        top=2.0,
        bars=True,
    )
    other = Channel(name="force", kind="scalars", shape=(1,))
    blank = np.full((90, 240, 3), 128, np.uint8)
    values = {"speed": np.array([[0.5, 5.0, -0.5]]), "force": np.ones((1, 1))}
    [drawn] = video.barred([blank], [shown, other], values)
    # From the first to the last column of a bar's widest row
    lengths = [int((drawn == PALETTE[i]).all(axis=2).sum(axis=1).max()) - 1 for i in range(3)]
    full = lengths[1]
    assert full >= 90, "beyond the top it is full"
    assert lengths[0] == pytest.approx(full / 4, abs=1), "a quarter of the top"
    assert lengths[2] == pytest.approx(full / 4, abs=1), "from the middle to the left"
    [same] = video.barred([blank], [other], values)
    assert same is blank
    unknown = {"speed": np.array([[np.nan, np.inf, 0.5]])}
    [without] = video.barred([blank], [shown], unknown)
    assert not (without == PALETTE[0]).all(axis=2).any(), "no bar of a number that is none"


@pytest.mark.parametrize("name", ["film.gif", "film.mp4"])
def test_on_a_full_disk_the_film_before_stays(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (120, 160, 3), dtype=np.uint8) for _ in range(40)]
    path = tmp_path / name
    recordings.write_film(path, noise[:2])
    before = path.read_bytes()
    with files_of_at_most(50_000), pytest.raises(RunError, match=f"cannot write .*{name}: "):
        recordings.write_film(path, noise)
    assert [each.name for each in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == before
    recordings.write_film(path, noise)
    assert path.stat().st_size > 50_000


@needs_drawing
@pytest.mark.slow
def test_a_gif(done: Farm, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "a.gif"
    output = done.call(
        "replay", "runs/a", "--to", str(tmp_path / "a.rrd"), "--speed", "1", "--video", str(path)
    )
    assert f"video: {path}" in output
    assert path.stat().st_size < 1.5e6
    with Image.open(path) as gif:
        assert gif.size == video.SIZE
        pictures = []
        for i in range(gif.n_frames):
            gif.seek(i)
            pictures.append(np.array(gif.convert("RGB"), dtype=int))
            seconds = gif.info["duration"] / 1000
    assert 0.02 <= seconds <= 1.1
    changed = np.abs(pictures[0] - pictures[-1]).max(axis=-1) > 60
    assert 0.005 < changed.mean() < 0.5  # fingers moved, the rest stayed
    orange = (pictures[0][..., 0] > 180) & (pictures[0][..., 2] < 90) & (pictures[0][..., 1] > 90)
    assert 0.01 < orange.mean() < 0.2  # the bar is there, and no more than a part of the picture


@pytest.mark.slow
def test_nothing_to_draw_with(done: Farm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    output = done.call(
        "replay",
        "runs/a",
        "--to",
        str(tmp_path / "a.rrd"),
        "--video",
        str(tmp_path / "a.gif"),
        status=1,
    )
    assert "MuJoCo cannot draw here" in output
    assert len(output.splitlines()) == 1, "before anything is simulated"
    assert not list(tmp_path.iterdir())


@needs_drawing
@pytest.mark.slow
def test_an_mp4(done: Farm, tmp_path: Path) -> None:
    import imageio_ffmpeg

    path = tmp_path / "a.mp4"
    done.call(
        "replay", "runs/a", "--to", str(tmp_path / "a.rrd"), "--speed", "2", "--video", str(path)
    )
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(path)
    assert frames == round(1.5 / 2 * 30) + 1 + 30
    assert seconds == pytest.approx(frames / 30, abs=0.05)
