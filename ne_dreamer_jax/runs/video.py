"""Frames to mp4, by the ffmpeg that imageio-ffmpeg brings along."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np

from ne_dreamer_jax.files import replacing

WIDTH = 384  # pixels that a video has at least, in whole multiples of the frames' own
PATIENCE = 600.0  # seconds that ffmpeg may take


def frame_rate(step_seconds: float | None) -> float:
    """Frames a second at which an environment is seen as fast as it is; 30 for one without a clock of its own."""
    return 30.0 if step_seconds is None else min(max(1.0 / step_seconds, 1.0), 60.0)


def write(frames: np.ndarray | None, path: Path, *, fps: float) -> None:
    """Writes an episode as H.264, which browsers play, each pixel drawn as a square so that the agent's view is seen.

    Args:
      frames: uint8 ``[T, height, width, C]``, or None where there are none; see `colours` for what is shown of C
        channels.
      path: of the mp4, replaced whole.
      fps: frames a second.

    Raises:
      ValueError: frames of another shape or dtype, or none.
      ImportError, OSError, RuntimeError, subprocess.TimeoutExpired: there is no ffmpeg, it can't be run, failed or
        does not end, or the file can't be written; the message says which.
    """
    if frames is None:
        raise ValueError("expected the frames of an episode, got none")
    if frames.ndim != 4 or frames.dtype != np.uint8 or not frames.size:
        raise ValueError(f"expected uint8 [T, height, width, C] with T > 0, got {frames.dtype} {list(frames.shape)}")
    import imageio_ffmpeg  # where it is missing, videos are all that is

    frames = colours(frames)
    _, height, width, _ = frames.shape
    scale = max(1, -(-WIDTH // width))
    if height * scale % 2 or width * scale % 2:
        scale += 1  # even sides: H.264 shares colour among 2 x 2 pixels
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    command += ["-vf", f"scale={width * scale}:{height * scale}:flags=neighbor", "-pix_fmt", "yuv420p"]
    command += ["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart"]
    with replacing(path) as beside:
        whole = [*command, os.path.abspath(beside)]
        done = subprocess.run(whole, input=frames.tobytes(), capture_output=True, check=False, timeout=PATIENCE)
        if done.returncode:
            how = f"exit code {done.returncode}" if done.returncode > 0 else f"ended by signal {-done.returncode}"
            raise RuntimeError(f"ffmpeg failed, {how}: {done.stderr.decode(errors='replace').strip()}")


def colours(frames: np.ndarray) -> np.ndarray:
    """What is shown of images ``[..., C]`` of any number of channels, ``[..., 3]``.

    The last three of 3, 6, 9, ... channels: of stacked frames in colour, whose newest comes last, the newest. Else the
    last channel in grey: a grey image, or the newest of stacked ones.
    """
    channels = frames.shape[-1]
    return frames[..., -3:] if channels % 3 == 0 else np.repeat(frames[..., -1:], 3, axis=-1)
