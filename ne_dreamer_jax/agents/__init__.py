"""Agents: the world-model agent (`dreamer`) and the model-free baseline (`drqv2`), behind one interface (`base`)."""

from __future__ import annotations

from ne_dreamer_jax.agents import drqv2
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig, make_world_model_agent
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import EnvSpec

__all__ = ["Agent", "AgentConfig", "DrQv2Config", "make_agent", "make_world_model_agent"]


@in_32_bits
def make_agent(config: AgentConfig | DrQv2Config, spec: EnvSpec) -> Agent:
    """The agent of ``config`` for environments of ``spec``: what kind is said by the config's type.

    Raises ValueError where the config and the environment do not fit.
    """
    if isinstance(config, DrQv2Config):
        return Agent(*drqv2.build(config, spec), config, spec)
    return make_world_model_agent(config, spec)
