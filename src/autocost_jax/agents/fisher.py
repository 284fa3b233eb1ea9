"""Fisher products of the tanh policy, from its factored Jacobian.

The generic product of `trust_region` pushes every direction forward and backward
through the network: four matrix products a layer. Here the derivative of each
output with respect to each layer's input is formed once, which leaves two.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from autocost_jax.agents.blocks import num_row_blocks
from autocost_jax.agents.networks import Params
from autocost_jax.agents.trust_region import Product


def _jacobian_factors(
    layers: list[dict[str, jax.Array]], obs: jax.Array
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Inputs [R, I] of every layer and d mean / d (pre-activation) [U, R, H]."""
    inputs = [obs]
    for layer in layers[:-1]:
        bias = layer["bias"][None]
        inputs.append(jnp.tanh(inputs[-1] @ layer["kernel"] + bias))
    derivatives = []
    signal = layers[-1]["kernel"].T[:, None]
    for layer, output in zip(layers[-2::-1], inputs[:0:-1], strict=True):
        derivatives.insert(0, (1 - output**2)[None] * signal)
        signal = derivatives[0] @ layer["kernel"].T
    return inputs, derivatives


def mlp_fisher_product(
    params: Params, obs: jax.Array, weight: jax.Array, damping: float
) -> Product:
    """Products (F + damping I) z for the policy of `networks`, at its parameters.

        d mean_i = sum_l D_li . (Z_l^T h_l + z_l),
        (F z)_l = sum_r h_l (sum_i w_r / std_i^2 * d mean_i * D_li)^T

    with h_l [R, I] the input of layer l and D_li [R, H] the derivative of output i
    with respect to what that layer adds up; 2 z for the log std.

    Args:
      params: policy parameters, `{"mean": {"Dense_l": ...}, "log_std": [U]}`.
      obs: [R, O].
      weight: [R] 0.0 or 1.0, normalised here.
      damping: added to every eigenvalue.

    Returns:
      A function of a few directions [K, n] -> [K, n], in the order of
      `ravel_pytree(params)`.
    """
    names = [f"Dense_{index}" for index in range(len(params["mean"]))]
    _, unravel = ravel_pytree(params)
    layers = [params["mean"][name] for name in names]
    num_blocks = num_row_blocks(obs.shape[0])

    def split(x: jax.Array) -> jax.Array:
        return x.reshape(num_blocks, -1, *x.shape[1:])

    factors = jax.lax.map(lambda obs: _jacobian_factors(layers, obs), split(obs))
    inputs, derivatives = factors
    # Formed once: left to itself XLA would transpose the other factor every time.
    transposed = jax.lax.optimization_barrier([x.swapaxes(1, 2) for x in inputs])
    share = weight / jnp.maximum(jnp.sum(weight), 1.0)
    scale = split(share[:, None] * jnp.exp(-2.0 * params["log_std"])[None])
    rows = (inputs, transposed, derivatives, scale)
    zero = [{name: jnp.zeros_like(leaf) for name, leaf in x.items()} for x in layers]

    def of_block(layers: Any, rows: Any) -> Any:
        """What one block of rows adds to the image of one direction."""
        inputs, transposed, derivatives, scale = rows
        pushed = [
            x @ layer["kernel"] + layer["bias"]
            for x, layer in zip(inputs, layers, strict=True)
        ]
        # Everything over the few outputs is written out: it fuses, a reduction over
        # them or a product with an axis of them does not.
        mean = []
        for i in range(scale.shape[-1]):
            pairs = zip(pushed, derivatives, strict=False)
            hidden = [jnp.sum(y * d[i], axis=-1) for y, d in pairs]
            mean.append(scale[:, i] * sum(hidden, pushed[-1][:, i]))
        pulled: list[Any] = [
            sum(m[:, None] * d[i] for i, m in enumerate(mean)) for d in derivatives
        ]
        pulled.append(jnp.stack(mean, axis=-1))
        return [
            {"kernel": x @ p, "bias": jnp.sum(p, axis=0)}
            for x, p in zip(transposed, pulled, strict=True)
        ]

    def product(direction: jax.Array) -> jax.Array:
        parts = [unravel(z) for z in direction]
        stacks = [[part["mean"][name] for name in names] for part in parts]

        def add_block(totals: Any, rows: Any) -> tuple[Any, None]:
            new = [of_block(layers, rows) for layers in stacks]
            return jax.tree.map(jnp.add, totals, new), None

        totals, _ = jax.lax.scan(add_block, [zero] * len(stacks), rows)
        images = [
            {
                "mean": dict(zip(names, total, strict=True)),
                "log_std": 2.0 * part["log_std"],
            }
            for part, total in zip(parts, totals, strict=True)
        ]
        flat = jnp.stack([ravel_pytree(image)[0] for image in images])
        return flat + damping * direction

    return product
