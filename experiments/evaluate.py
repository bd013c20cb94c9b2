"""Evaluates the policy of a run: ``python -m experiments.evaluate --help``."""

from ne_dreamer_jax.commands.evaluate import main
from ne_dreamer_jax.system.pages import use_large_pages

__all__ = ["main"]

if __name__ == "__main__":
    use_large_pages("experiments.evaluate")
    main()
