"""Times the renderer on states of whole episodes: ``python -m benchmarks.render --help``."""

from __future__ import annotations

import contextlib
import functools
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import click

from benchmarks import mujoco_pictures
from ne_dreamer_jax.commands.options import UserPath
from ne_dreamer_jax.system.quiet import quiet

_STORED = pathlib.Path(__file__).parents[1] / "tests" / "render" / "references.npz"


@click.command(context_settings={"max_content_width": 110})
@click.option(
    "--domain", "domains", multiple=True, type=click.Choice(sorted(mujoco_pictures.TASKS)), help="Default: all ten."
)
@click.option("--frames", type=click.IntRange(1), default=16, show_default=True, help="Drawn together.")
@click.option("--rounds", type=click.IntRange(1), default=9, show_default=True)
@click.option(
    "--osmesa",
    is_flag=True,
    help="Also time MuJoCo's own renderer on the same states, in turns with ours, and compare the pictures of "
    "--states states. Needs libosmesa6.",
)
@click.option("--states", type=click.IntRange(1), default=64, show_default=True, help="Compared with --osmesa.")
@click.option("--pictures", type=UserPath(file_okay=False), help="Store a picture of each.")
def main(
    domains: tuple[str, ...],
    frames: int,
    rounds: int,
    osmesa: bool,
    states: int,
    pictures: pathlib.Path | None,
) -> None:
    """Milliseconds to draw frames of 64 x 64 pixels in each domain, and how far they are from MuJoCo's own pictures.

    Without --osmesa the states and pictures are the few that are stored with the tests.
    """
    quiet()
    os.environ.setdefault("MUJOCO_GL", "disable")
    import jax
    import numpy as np

    from benchmarks import common
    from ne_dreamer_jax import render

    domains = domains or tuple(sorted(mujoco_pictures.TASKS))
    with contextlib.ExitStack() as stack:
        path = stack.enter_context(_played(domains, max(states, frames))) if osmesa else _STORED
        ask = stack.enter_context(_osmesa(path)) if osmesa else None
        cases: dict[str, Callable[[], Any]] = {}
        columns: dict[str, dict[str, Any]] = {}
        for domain in domains:
            loaded = mujoco_pictures.load(path, domain)
            draw = jax.jit(mujoco_pictures.drawer(render.build(loaded.model, loaded.camera)))
            inputs = (loaded.data, loaded.sizes)
            chunks = [_take(inputs, np.arange(i, i + frames)) for i in range(0, len(loaded.images), frames)]
            drawn = np.concatenate([draw(*chunk) for chunk in chunks])[: len(loaded.images)]
            columns[domain] = {
                "mae": float(np.abs(drawn.astype(float) - loaded.images).mean()),
                "ssim": float(np.mean([similarity(a, b) for a, b in zip(drawn, loaded.images, strict=True)])),
            }
            cases[domain] = functools.partial(draw, *chunks[0])
            if ask is not None:
                cases[f"{domain} osmesa"] = functools.partial(ask, domain, frames)
            if pictures is not None:
                _store(pictures / f"{domain}.png", drawn, loaded.images)
        measured = common.measure(cases, rounds=rounds)
    for domain in domains:
        columns[domain]["ms"] = measured.cases[domain].median * 1e3
        if osmesa:
            other = f"{domain} osmesa"
            columns[other] = {"ms": measured.cases[other].median * 1e3}
            columns[domain]["speed_up"] = measured.cases[other].median / measured.cases[domain].median
    common.report("render", measured, settings={"frames": frames, "size": mujoco_pictures.SIZE}, columns=columns)


def similarity(image: Any, reference: Any) -> float:
    """Structural similarity of two uint8 images [H, W, C], 1 if equal: the mean over 7 x 7 windows and channels.

    Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural similarity"
    (2004), eq. 13, with uniform windows and sample covariances.
    """
    import numpy as np

    windows = np.lib.stride_tricks.sliding_window_view
    x, y = (windows(np.asarray(a, np.float64), (7, 7), axis=(0, 1)) for a in (image, reference))
    mean_x, mean_y = x.mean((-2, -1)), y.mean((-2, -1))
    cov = 49 / 48
    var_x, var_y = x.var((-2, -1)) * cov, y.var((-2, -1)) * cov
    covariance = ((x * y).mean((-2, -1)) - mean_x * mean_y) * cov
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (var_x + var_y + c2)
    return float((luminance * structure).mean())


def _take(tree: Any, rows: Any) -> Any:
    """Rows of all arrays, again from the first where they are too few."""
    import jax

    return jax.tree.map(lambda a: a[rows % len(a)], tree)


@contextlib.contextmanager
def _played(domains: tuple[str, ...], states: int) -> Iterator[pathlib.Path]:
    """Fresh states and MuJoCo's pictures of them, in a temporary file."""
    with tempfile.TemporaryDirectory() as directory:
        path = pathlib.Path(directory) / "pictures.npz"
        chosen = [option for domain in domains for option in ("--domain", domain)]
        subprocess.run(
            [*_COMMAND, "--states", str(states), "--out", str(path), *chosen],
            env=os.environ | {"MUJOCO_GL": "osmesa"},
            check=True,
        )
        yield path


@contextlib.contextmanager
def _osmesa(path: pathlib.Path) -> Iterator[Callable[[str, int], None]]:
    """A process that draws with OSMesa when asked; OpenGL is never loaded into this one."""
    with subprocess.Popen(
        [*_COMMAND, "--serve", str(path)],
        env=os.environ | {"MUJOCO_GL": "osmesa"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:

        def ask(domain: str, count: int) -> None:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(f"{domain} {count}\n")
            process.stdin.flush()
            if process.stdout.readline() != "drawn\n":
                raise RuntimeError(f"MuJoCo's renderer stopped while drawing {domain}; is libosmesa6 installed?")

        yield ask
        assert process.stdin is not None
        process.stdin.close()


_COMMAND = (sys.executable, "-m", "benchmarks.mujoco_pictures")


def _store(path: pathlib.Path, drawn: Any, reference: Any) -> None:
    """Three states, each ours, MuJoCo's, and their difference four times enlarged, side by side."""
    import numpy as np
    from matplotlib import image

    path.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    for i in np.linspace(0, len(drawn) - 1, 3).astype(int):
        difference = np.abs(drawn[i].astype(int) - reference[i])
        rows.append(np.concatenate([drawn[i], reference[i], np.minimum(4 * difference, 255).astype(np.uint8)], 1))
    picture = np.concatenate(rows).repeat(3, 0).repeat(3, 1)
    image.imsave(path, picture)


if __name__ == "__main__":
    main()
