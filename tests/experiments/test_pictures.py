"""Curves and videos are files that programs open, with the data in them."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.image import imread

from experiments import plots, video


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
    with pytest.raises(ValueError, match=r"expected uint8 \[T, height, width, 3\] with T > 0, got"):
        video.write(frames, tmp_path / "policy.mp4", fps=20)
    assert not list(tmp_path.iterdir())
