"""Curves and videos are files that programs open, with the data in them."""

import os
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.image import imread

from ne_dreamer_jax.runs import pictures, plots, video


def lines(count):
    values = [{"env_step": 10 * n, "train/return": float(n), "eval/return": 2.0 * n} for n in range(count)]
    return [line | {"agent_step": 0, "update": 0} for line in values]


@pytest.mark.parametrize("count", [0, 1, 3, 200])
def test_a_curve_is_drawn_of_any_number_of_points(tmp_path, count):
    path = tmp_path / "curve.png"
    for random_return in (None, (1.0, 0.5)):
        plots.learning_curve(lines(count), path, title="demo", env_steps=2000, random_return=random_return)
    image = (255 * imread(path)).round().astype(int)
    assert image.shape[:2] == (630, 1080)
    assert [entry.name for entry in tmp_path.iterdir()] == ["curve.png"]

    def has(colour):
        return (np.abs(image[..., :3] - colour).max(-1) < 8).any()

    assert has((0, 114, 178)) == (count > 0)  # training
    assert has((213, 94, 0)) == (count > 0)  # evaluation
    assert not has((255, 0, 0))


def decode(path, height, width):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(path)]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.parametrize(
    ("height", "width", "scale"), [(64, 64, 6), (84, 84, 5), (64, 63, 8), (63, 63, 8), (385, 385, 2), (480, 640, 1)]
)
def test_a_video_holds_every_frame(tmp_path, height, width, scale):
    frames = np.zeros((7, height, width, 3), np.uint8)
    frames[..., 2] = 200
    for time in range(7):
        frames[time, : height // 2] = 30 * time
    video.write(frames, tmp_path / "policy.mp4", fps=12.5)
    read = decode(tmp_path / "policy.mp4", scale * height, scale * width)
    assert len(read) == 7
    np.testing.assert_allclose(read[:, 5, 5, 0], 30 * np.arange(7), atol=6)
    np.testing.assert_allclose(read[:, -5, -5], np.tile([0, 0, 200], (7, 1)), atol=12)
    assert [entry.name for entry in tmp_path.iterdir()] == ["policy.mp4"]


@pytest.mark.parametrize(
    "frames", [np.zeros((3, 8, 8), np.uint8), np.zeros((3, 8, 8, 3)), np.zeros((0, 8, 8, 3), np.uint8)]
)
def test_what_is_no_video_is_refused(tmp_path, frames):
    with pytest.raises(ValueError, match=r"expected uint8 \[T, height, width, C\] with T > 0, got"):
        video.write(frames, tmp_path / "policy.mp4", fps=20)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("channels", [1, 2, 4, 6, 9])
def test_images_of_any_number_of_channels_are_shown(tmp_path, channels):
    """The newest frame of a stack: grey, unless the channels are whole frames in colour."""
    frames = np.zeros((3, 8, 8, channels), np.uint8)
    frames[..., -3:] = np.asarray([200, 40, 120])[-channels:]
    video.write(frames, tmp_path / "policy.mp4", fps=20)
    expected = [200, 40, 120] if channels % 3 == 0 else [120, 120, 120]
    read = decode(tmp_path / "policy.mp4", 384, 384)
    np.testing.assert_allclose(read[:, 100, 100], np.tile(expected, (3, 1)), atol=8)


FFMPEG = {  # what is in its place, and what is said
    None: "No such file",
    "#!/bin/sh\necho \"Unknown encoder 'libx264'\" >&2; exit 1\n": "exit code 1: Unknown encoder 'libx264'",
    "#!/bin/sh\nkill -9 $$\n": "ended by signal 9",
    "#!/bin/sh\ncat > /dev/null\n": "No such file",  # says that all is well, and writes nothing
    "#!/bin/sh\nexec sleep 60\n": "timed out",
    "not a program": "error",
}


@pytest.mark.parametrize("ffmpeg", FFMPEG)
def test_an_ffmpeg_that_fails_costs_the_video_alone(tmp_path, monkeypatch, ffmpeg):
    program, lines = tmp_path / "ffmpeg", []
    if ffmpeg is not None:
        program.write_text(ffmpeg)
        program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    monkeypatch.setattr(video, "PATIENCE", 1.0)
    path = tmp_path / "run" / "policy.mp4"
    path.parent.mkdir()
    draw = lambda: video.write(np.zeros((3, 8, 8, 3), np.uint8), path, fps=20)
    assert not pictures.attempt(draw, path, lines.append)
    assert len(lines) == 1
    assert lines[0].startswith(f"Could not draw {path}: ")
    assert FFMPEG[ffmpeg] in lines[0]
    assert not list(path.parent.iterdir())


def test_a_picture_that_can_not_be_written_leaves_nothing(tmp_path):
    path, drawn = tmp_path / "curve.png", []
    (path / "in the way").mkdir(parents=True)
    assert not pictures.attempt(lambda: plots.learning_curve([], path, title="x", env_steps=9), path, drawn.append)
    assert "Is a directory" in drawn[0]
    assert [entry.name for entry in tmp_path.iterdir()] == ["curve.png"]


@pytest.mark.parametrize("rc", ["", "text.usetex: True\n", "backend: module://nowhere\nnot a setting\n"])
def test_curves_are_drawn_whatever_matplotlib_is_told(tmp_path, rc):
    (tmp_path / "matplotlibrc").write_text(rc)
    code = (
        "import sys, pathlib; from ne_dreamer_jax.runs import plots\n"
        "plots.learning_curve([], pathlib.Path('curve.png'), title='demo', env_steps=9)\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    environment = {**os.environ, "MPLBACKEND": "module://matplotlib_inline.backend_inline", "PYTHONPATH": os.getcwd()}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True, capture_output=True)
    assert imread(tmp_path / "curve.png").shape[:2] == (630, 1080)
