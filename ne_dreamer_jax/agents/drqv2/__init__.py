"""DrQ-v2 (Yarats et al., *Mastering Visual Continuous Control*, 2021): the model-free baseline.

An actor and two critics on a convolutional encoder, learned from replay with randomly shifted frames. Nothing of the
world model is used; `make_agent` puts it behind the same interface.
"""

from ne_dreamer_jax.agents.drqv2.config import IMAGE_SIZE, SEED_FRAMES, DrQv2Config, for_task
from ne_dreamer_jax.agents.drqv2.learner import build

__all__ = ["IMAGE_SIZE", "SEED_FRAMES", "DrQv2Config", "build", "for_task"]
