"""Fisher products of the tanh policy, from its factored Jacobian.

The generic product of `trust_region` pushes every direction forward and backward
through the network: four matrix products a layer. Here the derivative of each
output with respect to each layer's input is formed once, which leaves two.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from autocost_jax.agents.networks import Params
from autocost_jax.agents.trust_region import Product

_CPU_BLOCK = 1000  # rows whose intermediate arrays stay in a core's cache


def num_row_blocks(num_rows: int) -> int:
    """Blocks in which a CPU walks through the rows, a divisor; 1 on accelerators."""
    if jax.default_backend() != "cpu":
        return 1
    most = max(1, num_rows // _CPU_BLOCK)
    return next(count for count in range(most, 0, -1) if num_rows % count == 0)


def _jacobian_factors(
    layers: list[dict[str, jax.Array]], obs: jax.Array
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Inputs [R, I] of every layer and d mean / d (pre-activation) [R, U, H]."""
    inputs = [obs]
    for layer in layers[:-1]:
        bias = layer["bias"][None]
        inputs.append(jnp.tanh(inputs[-1] @ layer["kernel"] + bias))
    derivatives = []
    signal = layers[-1]["kernel"].T[None]
    for layer, output in zip(layers[-2::-1], inputs[:0:-1], strict=True):
        derivatives.insert(0, (1 - output**2)[:, None] * signal)
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
      A function of a stack of directions [K, n] -> [K, n], in the order of
      `ravel_pytree(params)`; equal to `trust_region.fisher_product` to rounding.
    """
    names = [f"Dense_{index}" for index in range(len(params["mean"]))]
    _, unravel = ravel_pytree(params)
    layers = [params["mean"][name] for name in names]
    num_blocks = num_row_blocks(obs.shape[0])

    def block(x: jax.Array) -> jax.Array:
        return x.reshape(num_blocks, -1, *x.shape[1:])

    inputs, derivatives = jax.tree.map(block, _jacobian_factors(layers, obs))
    # Formed once: left to itself XLA would transpose the other factor every time.
    transposed = jax.lax.optimization_barrier([x.swapaxes(1, 2) for x in inputs])
    share = weight / jnp.maximum(jnp.sum(weight), 1.0)
    scale = share[:, None] * jnp.exp(-2.0 * params["log_std"])[None]
    rows = (inputs, transposed, derivatives, block(scale))

    def product(direction: jax.Array) -> jax.Array:
        count = direction.shape[0]
        parts: Any = jax.vmap(unravel)(direction)
        # All K directions side by side: [I, K * H] and [K * H].
        kernels = [
            parts["mean"][name]["kernel"].swapaxes(0, 1).reshape(x.shape[-1], -1)
            for name, x in zip(names, inputs, strict=True)
        ]
        biases = [parts["mean"][name]["bias"].reshape(-1) for name in names]

        def add_block(total: Any, rows: Any) -> tuple[Any, None]:
            inputs, transposed, derivatives, scale = rows
            pushed = [
                (x @ kernel + bias[None]).reshape(x.shape[0], count, -1)
                for x, kernel, bias in zip(inputs, kernels, biases, strict=True)
            ]
            hidden = [
                jnp.sum(y[:, :, None] * d[:, None], axis=-1)
                for y, d in zip(pushed, derivatives, strict=False)
            ]
            mean = scale[:, None] * sum(hidden, pushed[-1])  # [r, K, U]
            # Sums over the few outputs written out: they fuse, a reduction does not.
            pulled: list[Any] = [
                sum(mean[:, :, i, None] * d[:, None, i] for i in range(d.shape[1]))
                for d in derivatives
            ]
            pulled = [p.reshape(p.shape[0], -1) for p in (*pulled, mean)]
            new = [
                (x @ p, jnp.sum(p, axis=0))
                for x, p in zip(transposed, pulled, strict=True)
            ]
            return jax.tree.map(jnp.add, total, new), None

        zero = jax.tree.map(jnp.zeros_like, list(zip(kernels, biases, strict=True)))
        total, _ = jax.lax.scan(add_block, zero, rows)
        mean = {
            name: {
                "kernel": kernel.reshape(kernel.shape[0], count, -1).swapaxes(0, 1),
                "bias": bias.reshape(count, -1),
            }
            for name, (kernel, bias) in zip(names, total, strict=True)
        }
        image = {"mean": mean, "log_std": 2.0 * parts["log_std"]}
        flat = jax.vmap(lambda tree: ravel_pytree(tree)[0])(image)
        return flat + damping * direction

    return product
