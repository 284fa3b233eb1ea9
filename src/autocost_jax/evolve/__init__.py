"""The search: `evolve` step by step, `search` as one function, `python -m` to run it.

The package of the root imports this one before it binds the function of the same name,
so `autocost_jax.evolve` is always the function.
"""

from autocost_jax.search.evolution import evolve, search

__all__ = ["evolve", "search"]
