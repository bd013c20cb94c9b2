"""What a setting is worth: variants of one configuration, several seeds each, and the interval of their difference.

A variant is one or more settings, joined by commas, or ``default``; the first is what the others are compared with. Its
seeds train one after the other, in one compiled program. Results in OUT are found again by their configuration,
however the variant was spelt.

Usage: ``python -m experiments.switches runs/head.jsonl agent.behavior.discount_in_head=true
agent.behavior.discount_in_head=false --task dmc/cartpole_swingup --seeds 8``
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from experiments.common import Common, common
from ne_dreamer_jax.commands.options import Name, Task, UserPath, find_devices, refusing, say
from ne_dreamer_jax.files import write_text
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

if TYPE_CHECKING:
    import numpy as np

    from ne_dreamer_jax.config import Config
    from ne_dreamer_jax.runs.building import Run

SETTING = re.compile(r",(?=[\w.]+=)")
"""What parts a variant's settings: a comma before the next one's name, as values may hold commas, too."""
DEFAULT = "default"
"""The variant that changes nothing."""
SMALL = (
    "agent.rssm.deter=128",
    "agent.rssm.hidden=64",
    "agent.rssm.stoch=8",
    "agent.rssm.classes=8",
    "agent.heads.units=64",
    "agent.encoder.units=64",
)
"""The quickstart's agent made small enough for vectors, with --small."""


@click.command(help=__doc__, context_settings={"show_default": True, "max_content_width": 110})
@click.argument("out", type=UserPath())
@click.argument("variants", nargs=-1, required=True)
@click.option("--task", "tasks", type=Task(), multiple=True, help="May be repeated. Default: the preset's.")
@click.option("--method", type=Name("method", names.METHODS), default=names.METHODS[0])
@common("quickstart")
@click.option("--small", is_flag=True, help="A small agent, for vectors.")
@click.option("--seeds", type=click.IntRange(2, 1000), default=5, help="Seeds 0, 1, ... of each.")
def main(
    out: Path,
    variants: tuple[str, ...],
    tasks: tuple[str, ...],
    method: str,
    small: bool,
    seeds: int,
    **settings: Any,
) -> None:
    """Trains what OUT does not hold yet, keeps a line for each variant and task in it, and prints the comparison."""
    quiet()
    if len(set(variants)) < len(variants):
        raise click.UsageError(f"expected variants that differ, got one twice: {' '.join(variants)}")
    shared = Common(**settings)
    if small:
        shared = shared._replace(assignments=(*SMALL, *shared.assignments))
    if any(
        re.match(r"seed\s*=", setting.strip())
        for text in (*shared.assignments, *variants)
        for setting in _settings(text)
    ):
        raise click.UsageError("seed: each variant has the seeds 0, 1, ..., of which --seeds says how many")
    if strange := [text for text in variants if text != DEFAULT and "=" not in text]:
        raise click.UsageError(f"expected {DEFAULT!r} or PATH=VALUE as a variant, got {strange[0]!r}")
    with refusing(ValueError):
        made = {
            (task, variant): shared.with_settings(_settings(variant)).config(task, method, 0)
            for task in tasks or (None,)
            for variant in variants
        }
        for config in made.values():
            _expect_updates(config)
        with _locked(out):  # what is no such file, or can't be written, is refused before anything trains
            _read(out)
        find_devices()
        compared = [_results(out, config, variant, seeds) for (_, variant), config in made.items()]
    say("")
    for row in table(compared):
        say(row)


def _expect_updates(config: Config) -> None:
    """Raises ValueError for a run that learns nothing."""
    from ne_dreamer_jax.loop.budget import Budget

    agent, loop = config.agent, config.loop
    if not Budget.of(loop, agent.batch_size, agent.batch_length, config.env.action_repeat).updates:
        raise ValueError(
            f"loop.env_steps: expected enough for an update after a loop.prefill of {loop.prefill:,} agent steps, got "
            f"{loop.env_steps:,}"
        )


def _settings(variant: str) -> tuple[str, ...]:
    """The assignments that a variant is made of."""
    return () if variant == DEFAULT else tuple(SETTING.split(variant))


def _results(out: Path, config: Config, variant: str, seeds: int) -> dict[str, Any]:
    """A variant's line with so many seeds; those that the file lacks are trained, and kept one by one.

    Raises ValueError as `_read`.
    """
    is_same = lambda line: line["config"] == plain(config)
    found = max(filter(is_same, _read(out)), key=lambda line: line["seeds"], default=None)
    done = 0 if found is None else found["seeds"]
    if done < seeds:
        say(f"{config.env.task}, {variant}: {seeds} seeds")
        for line in train(config, variant, range(done, seeds), found):
            say(f"  seed {line['seeds'] - 1}: {' '.join(f'{x:.1f}' for x in line['curves'][-1])}")
            found = line
            _keep(out, line, is_same)
    assert found is not None
    return found | {"variant": variant, "seeds": seeds, "curves": found["curves"][:seeds]}


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Makes other commands wait that would write the file, too. Raises ValueError where its folder can't be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        lock = out.with_name(f".{out.name}.lock").open("a")
        fcntl.flock(lock, fcntl.LOCK_EX)
    except OSError as error:
        raise ValueError(f"{out} can't be written: {error.strerror or error}") from error
    with lock:
        yield


def _keep(out: Path, line: dict[str, Any], is_same: Callable[[dict[str, Any]], bool]) -> None:
    """Adds a line to the file in place of the same configuration's with fewer seeds. Other commands may do so, too."""
    with _locked(out):
        lines = _read(out)
        furthest = max([line, *filter(is_same, lines)], key=lambda each: each["seeds"])
        kept = [*itertools.filterfalse(is_same, lines), furthest]
        write_text(out, "".join(json.dumps(each) + "\n" for each in kept))


def train(
    config: Config, variant: str, seeds: Sequence[int], before: Mapping[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """After each seed what is known so far: curves of the returns of the policies' modes.

    Args:
      before: what was known of the seeds before these.

    Raises:
      ValueError: settings that do not fit each other, the environment or the memory.
    """
    from ne_dreamer_jax.runs import building

    began = time.monotonic()
    run = building.build(config)
    say("  Compiling, which takes a minute or more; then a line for each seed.")
    repeat = config.env.action_repeat * config.loop.num_envs
    interval, steps = max(1, (config.loop.eval_every or config.loop.env_steps) // repeat), run.loop.budget.vector_steps
    ends = [*range(interval, steps, interval), steps]
    curves: list[list[float]] = [] if before is None else list(before["curves"])
    minutes = 0.0 if before is None else before["minutes"]
    try:
        for seed in seeds:
            curves.append(_curve(run, seed, ends))
            yield {
                "task": config.env.task,
                "variant": variant,
                "seeds": seed + 1,
                "env_steps": [end * repeat for end in ends],
                "curves": list(curves),
                "minutes": minutes + (time.monotonic() - began) / 60,
                "config": plain(config),
            }
    finally:
        if run.host is not None:
            run.host.close()


def _curve(run: Run, seed: int, ends: Sequence[int]) -> list[float]:
    """The mean returns of a seed's policy after so many vector steps each."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from experiments.probe_learning import EVALUATION

    loop, curve, step, skipped = run.loop, [], 0, 0.0
    state = loop.init(jax.random.key(seed))
    for end in ends:
        state, report = loop.chunk(state, jnp.asarray(end - step, jnp.int32))
        skipped += jax.device_get(report).means().get("skipped_updates", 0.0)
        curve.append(float(np.mean(loop.evaluate(state.train.params, jax.random.key(EVALUATION)).returns)))
        step = end
    if run.release is not None:
        run.release(state.env)
    if skipped:
        say(f"  seed {seed}: {skipped:,.0f} of {loop.budget.updates:,} updates were not finite, and skipped.")
    return curve


def _read(path: Path) -> list[dict[str, Any]]:
    """The file's lines. Raises ValueError where it can't be read, or holds something else."""
    if not path.exists():
        return []
    try:
        texts = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeError) as error:
        raise ValueError(f"{path} can't be read: {error}") from error
    lines = []
    for number, text in enumerate(texts, start=1):
        try:
            line = json.loads(text)
            fits = {"task", "variant", "config", "seeds", "curves", "minutes"} <= line.keys()
        except (ValueError, AttributeError):
            fits = False
        if not fits:
            raise ValueError(
                f"{path}, line {number}: expected results of a variant, as this command writes them, got "
                f"{text[:80]!r}; remove the line, or choose another file"
            )
        lines.append(line)
    return lines


def plain(config: Config) -> dict[str, Any]:
    """A configuration as it is read back from JSON."""
    from ne_dreamer_jax import settings

    return json.loads(json.dumps(settings.to_dict(config)))


def table(lines: Sequence[dict[str, Any]]) -> list[str]:
    """A Markdown table: of each line's returns, and their difference from those of the first line of its task."""
    import numpy as np

    rows = [
        "| task | variant | last return, by seed | mean | whole curve | difference at the end | of the curve |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    first: dict[str, dict[str, Any]] = {}
    for line in lines:
        base = first.setdefault(line["task"], line)
        last, mean = (curves := np.asarray(line["curves"]))[:, -1], curves.mean(axis=1)
        cells = [
            line["task"],
            f"`{line['variant']}`",
            " ".join(f"{x:.0f}" for x in last),
            f"{last.mean():.1f}",
            f"{mean.mean():.1f}",
            "" if line is base else difference(last, np.asarray(base["curves"])[:, -1]),
            "" if line is base else difference(mean, np.mean(base["curves"], axis=1)),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def difference(values: np.ndarray, others: np.ndarray) -> str:
    """Difference of two means with its 95 % interval (Welch), as text. Needs scipy (the extra ``analysis``)."""
    import numpy as np
    from scipy import stats

    apart = values.mean() - others.mean()
    if np.ptp(values) == np.ptp(others) == 0.0:  # seeds that are all alike say nothing of how others would be
        return f"{apart:+.1f} (no spread)"
    low, high = stats.ttest_ind(values, others, equal_var=False).confidence_interval(0.95)
    return f"{apart:+.1f} ({low:+.1f} to {high:+.1f})"


if __name__ == "__main__":
    use_large_pages("experiments.switches")
    main()
