"""The paper's ablations on one task: ``python -m experiments.ablations --help``."""

from experiments.compare import command
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages

main = command(
    [name for name in names.METHODS if name.split("/")[0] == "ne_dreamer"],
    """Train NE-Dreamer and its ablations on one task with a few seeds each, and draw them together.

    They are without the transformer (a perceptron on each step), without the shift (the target is the embedding of the
    same step) and without the projector. Options and directory are those of experiments.compare.
    """,
)

if __name__ == "__main__":
    use_large_pages("experiments.ablations")
    main()
