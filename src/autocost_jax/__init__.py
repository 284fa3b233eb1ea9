"""AutoCost in JAX."""
