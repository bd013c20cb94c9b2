"""Golden runs: what the first updates of every method came to, on a replay that never changes."""
