"""The world-model agent: `world_model` observes, `behavior` imagines, `agent` puts them together."""
