"""Constrained policy optimisation (Achiam et al. 2017, arXiv:1705.10528).

The trust-region problem is solved in a primal, scale-free form: no division by the
constraint's value or by a multiplier, so that costs near zero are harmless.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from autocost_jax.agents.advantages import weighted_mean
from autocost_jax.agents.base import (
    Agent,
    AgentState,
    Batch,
    EnvSizes,
    as_metrics,
    learn_obs,
    make_init,
    make_policy,
    prepare_batch,
    update_critics,
)
from autocost_jax.agents.fisher import mlp_fisher_product
from autocost_jax.agents.networks import (
    entropy,
    kl_divergence,
    log_prob,
    make_networks,
)
from autocost_jax.agents.trust_region import (
    Distribution,
    Product,
    backtrack,
    conjugate_gradient,
    linearise,
)
from autocost_jax.config import AgentConfig
from autocost_jax.precision import full_precision
from autocost_jax.records import Key, Metrics, Slot, Trajectory

_TINY = 1e-12  # norms below it count as zero; floor of what divides
_NO_COST_GRADIENT = 1e-8  # squared norm of b below which a safe policy ignores it


def cpo_step(
    g: jax.Array,
    b: jax.Array,
    c: jax.Array,
    product: Product,
    delta: float,
    solve: Callable[[jax.Array], jax.Array],
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The step x that minimises g.x with c + b.x <= 0 and x.Hx / 2 <= delta.

    The letters of the paper; loss convention, so g is what plain descent goes
    against. With hats for unit norm, v = H^-1 g^, w = H^-1 b^, q = v.Hv, r = w.Hv,
    s = w.Hw, u = v - (r/s) w, A = u.Hu and B = 2 delta - c^2/s:
      4  no usable b (or c < 0 and |b|^2 <= 1e-8): the plain step
      3  c < 0, B < 0, the whole region is safe: the plain step
      2, 1  c < 0, c >= 0 with B >= 0: the plain step if it satisfies the
         constraint, else the step on the constraint's plane
      0  c >= 0, B < 0, no safe step: straight down the cost, ignoring g

    Args:
      g: [n] gradient of the reward loss.
      b: [n] gradient of the cost surrogate, in cost per step.
      c: [] cost per step above the limit.
      product: [2, n] -> [2, n], multiplication by H (damping included).
      delta: bound of the KL, > 0.
      solve: [2, n] -> [2, n], (approximate) division by H of two unit vectors.

    Returns:
      x [n], and scalars in the problem's units: `case` (int32), `lam`, `nu`
      (multipliers of the KL and the cost bound), `q, r, s, A, B`.
    """
    g_norm, b_norm = jnp.sqrt(jnp.sum(g**2)), jnp.sqrt(jnp.sum(b**2))
    has_g, has_b = g_norm >= _TINY, b_norm >= _TINY
    g_scale, b_scale = jnp.where(has_g, g_norm, 1.0), jnp.where(has_b, b_norm, 1.0)
    rhs = jnp.stack(
        [jnp.where(has_g, g / g_scale, 0.0), jnp.where(has_b, b / b_scale, 0.0)]
    )
    c_hat = jnp.where(has_b, c / b_scale, 0.0)
    v, w = vectors = solve(rhs)
    hv, hw = product(vectors)
    q, r = jnp.maximum(jnp.dot(v, hv), _TINY), jnp.dot(w, hv)
    s = jnp.maximum(jnp.dot(w, hw), _TINY)
    u, hu = v - (r / s) * w, hv - (r / s) * hw
    A = jnp.maximum(jnp.dot(u, hu), _TINY)
    B = 2 * delta - c_hat**2 / s

    plain = -jnp.sqrt(2 * delta / q) * v
    on_plane = -(c_hat / s) * w - jnp.sqrt(jnp.maximum(B, 0.0) / A) * u
    recover = -jnp.sqrt(2 * delta / s) * w
    unconstrained = ~has_b | ((b_norm**2 <= _NO_COST_GRADIENT) & (c < 0))
    case = jnp.where(c < 0, jnp.where(B < 0, 3, 2), jnp.where(B < 0, 0, 1))
    case = jnp.where(unconstrained, 4, case).astype(jnp.int32)
    bound = (case == 1) | (case == 2)
    bound &= ~(c_hat - r * jnp.sqrt(2 * delta / q) <= 0)
    x = jnp.where(bound, on_plane, jnp.where(case == 0, recover, plain))

    pull = jnp.sqrt(A / jnp.maximum(B, _TINY))
    lam = jnp.where(bound, pull, jnp.sqrt(q / (2 * delta))) * g_norm
    nu = jnp.where(bound, g_norm / b_scale * (pull * c_hat - r) / s, 0.0)
    lam = jnp.where(case == 0, 0.0, lam)
    nu = jnp.where(case == 0, jnp.sqrt(2 * delta / s) / b_scale, nu)
    info = {"case": case, "lam": lam, "nu": nu, "B": B, "A": A * g_norm**2}
    info |= {"q": q * g_norm**2, "r": r * g_norm * b_norm, "s": s * b_norm**2}
    return x, info


def surrogates(
    distribution: tuple[jax.Array, jax.Array], batch: Batch
) -> tuple[jax.Array, jax.Array]:
    """Reward loss -mean(rho A) and cost surrogate mean(rho A_c), ratio unclipped.

    Args:
      distribution: mean [R, U] and log_std [U] of the new policy.
      batch: rows of the old one.

    Returns:
      Two scalars.
    """
    ratio = jnp.exp(log_prob(batch.action, *distribution) - batch.log_prob_old)
    return (
        -weighted_mean(ratio * batch.advantage, batch.weight),
        weighted_mean(ratio * batch.cost_advantage, batch.weight),
    )


def update_policy(
    config: AgentConfig,
    distribution: Distribution,
    theta: jax.Array,
    batch: Batch,
    c: jax.Array,
    product: Product,
) -> tuple[jax.Array, Metrics]:
    """One trust-region step with backtracking, on the full batch.

    A candidate is accepted if its KL is within `target_kl`, its reward loss has not
    risen (asked in cases 2, 3, 4 only) and its cost surrogate has risen by at most
    max(-c, 0).

    Args:
      config: KL bound, conjugate gradient and backtracking.
      distribution: theta -> (mean [R, U], log_std [U]) on the batch's rows.
      theta: [n] flat policy parameters.
      batch: the epoch's rows.
      c: [] cost per step to remove: how far it lies above the limit, or a multiple.
      product: multiplication by the damped Fisher matrix, [2, n] -> [2, n].

    Returns:
      Parameters [n], theta itself if no candidate is accepted, and the metrics of
      `cpo`.
    """
    lin = linearise(distribution, theta)
    at = (lin.mean, lin.log_std)
    old_loss, old_cost = surrogates(at, batch)
    gradients = jax.jacrev(lambda at: jnp.stack(surrogates(at, batch)))(at)
    g, b = jax.vmap(lin.vjp)(gradients)
    step, info = cpo_step(
        g,
        b,
        c,
        product,
        config.target_kl,
        partial(conjugate_gradient, product, num_iterations=config.cg_iterations),
    )

    def evaluate(theta: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        at = distribution(theta)
        kl = kl_divergence(*at, batch.mean_old, batch.log_std_old)
        kl = weighted_mean(kl, batch.weight)
        loss, cost = surrogates(at, batch)
        ok = (kl <= config.target_kl) & ((loss <= old_loss) | (info["case"] < 2))
        ok &= cost - old_cost <= jnp.maximum(-c, 0.0)
        return ok, {"kl": kl, "policy_loss": loss, "cost_surrogate": cost}

    theta, accepted, fraction, new = backtrack(
        evaluate, theta, step, config.backtrack_ratio, config.backtrack_steps
    )
    old = {"kl": jnp.zeros_like(c), "policy_loss": old_loss, "cost_surrogate": old_cost}
    metrics = {name: jnp.where(accepted, new[name], old[name]) for name in old}
    return theta, {
        **metrics,
        "case": info["case"],
        "accepted": accepted,
        "step_fraction": fraction,
        "policy_steps": accepted,
        "kl_multiplier": info["lam"],
        "multiplier": info["nu"],
        "policy_grad_norm": jnp.sqrt(jnp.sum(g**2)),
        "cost_grad_norm": jnp.sqrt(jnp.sum(b**2)),
    }


def cpo(config: AgentConfig, env: EnvSizes) -> Agent:
    """Constrained policy optimisation: one full-batch trust-region step an epoch.

    Where agents cost more than their limit, the step is made to remove
    `violation_factor` times the excess; 1 is the published algorithm.

    Args:
      config: hyper-parameters; the policy's passes and minibatches are not used.
      env: asked for its sizes only.

    Returns:
      The agent. Metrics of an update: `j_c`, `value_loss`, `cost_value_loss`,
      `critic_grad_norm`, `valid_fraction`, `entropy`, at the new policy `kl`,
      `policy_loss`, `cost_surrogate`; `case` (see `cpo_step`), `accepted`,
      `step_fraction` (0.8^j, or 0 if rejected), `policy_steps` (1 or 0),
      `multiplier` and `kl_multiplier` (of the cost and the KL bound),
      `policy_grad_norm`, `cost_grad_norm`, and `violation` = c, the cost per step
      above the limit. `slot.constrained` has no effect.
    """
    networks = make_networks(config, env.observation_size, env.action_size)

    @full_precision
    def update(
        state: AgentState,
        trajectory: Trajectory,
        total_cost: jax.Array,
        slot: Slot,
        key: Key,
    ) -> tuple[AgentState, Metrics]:
        batch, metrics = prepare_batch(
            config, networks, env.episode_length, state, trajectory, total_cost
        )
        theta, unravel = ravel_pytree(state.policy)
        # J_c - d, never -(d - J_c): a cost of -0.0 would count as feasible.
        c = (metrics["j_c"] - slot.cost.limit) / (env.episode_length + 1e-8)
        to_remove = jnp.where(c > 0, config.violation_factor * c, c)

        def distribution(theta: jax.Array) -> Any:
            return networks.distribution(unravel(theta), batch.obs)

        product = mlp_fisher_product(
            state.policy, batch.obs, batch.weight, config.cg_damping
        )
        theta, policy_metrics = update_policy(
            config, distribution, theta, batch, to_remove, product
        )
        policy = unravel(theta)
        critic, critic_opt, critic_norm = update_critics(
            config, networks, state.critic, state.critic_opt, batch, key
        )
        new_state = state.replace(
            policy=policy,
            critic=critic,
            critic_opt=critic_opt,
            normalizer=learn_obs(state, trajectory),
        )
        metrics = {
            **metrics,
            **policy_metrics,
            "entropy": entropy(policy["log_std"]),
            "critic_grad_norm": critic_norm,
            "violation": c,
        }
        return new_state, as_metrics(metrics)

    init = make_init(config, networks, env)
    return Agent(init, make_policy(networks), update)
