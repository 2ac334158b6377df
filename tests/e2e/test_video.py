"""Videos of replays: which moments are drawn and how long each is shown, pictures side by side, GIF
and MP4.
"""

import ctypes.util
from pathlib import Path

import numpy as np
import pytest
from processes import Farm

from farm.sim import video

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
    assert "MuJoCo cannot draw here" in output.splitlines()[-1]
    assert len(output.splitlines()) == 3  # and what the replay itself gave
    assert not (tmp_path / "a.gif").exists()


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
