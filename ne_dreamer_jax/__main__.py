"""The commands that an installation has: ``python -m ne_dreamer_jax train --help``."""

import click

from ne_dreamer_jax.commands import evaluate, train
from ne_dreamer_jax.system.pages import use_large_pages


@click.group(context_settings={"max_content_width": 110})
def main() -> None:
    """NE-Dreamer in JAX: train an agent, and evaluate it."""


main.add_command(train.main, "train")
main.add_command(evaluate.main, "evaluate")

if __name__ == "__main__":
    use_large_pages("ne_dreamer_jax")
    main(prog_name="python -m ne_dreamer_jax")
