"""Frames to mp4, by the ffmpeg that imageio-ffmpeg brings along."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np

WIDTH = 384  # pixels that a video has at least, in whole multiples of the frames' own


def write(frames: np.ndarray, path: Path, *, fps: float) -> None:
    """Writes an episode as H.264, which browsers play, each pixel drawn as a square so that the agent's view is seen.

    Args:
      frames: uint8 ``[T, height, width, 3]``.
      path: of the mp4, replaced whole.
      fps: frames a second.

    Raises:
      ValueError: frames of another shape or dtype, or none.
      RuntimeError: ffmpeg failed; the message is its own.
    """
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not frames.size:
        raise ValueError(f"expected uint8 [T, height, width, 3] with T > 0, got {frames.dtype} {list(frames.shape)}")
    _, height, width, _ = frames.shape
    scale = max(1, -(-WIDTH // width))
    if height * scale % 2 or width * scale % 2:
        scale += 1  # even sides: H.264 shares colour among 2 x 2 pixels
    beside = path.with_name("partial-" + path.name)  # ffmpeg goes by the suffix
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    command += ["-vf", f"scale={width * scale}:{height * scale}:flags=neighbor", "-pix_fmt", "yuv420p"]
    command += ["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart", str(beside)]
    done = subprocess.run(command, input=frames.tobytes(), capture_output=True, check=False)
    if done.returncode:
        beside.unlink(missing_ok=True)
        raise RuntimeError(f"ffmpeg could not write {path}: {done.stderr.decode(errors='replace').strip()}")
    os.replace(beside, path)
