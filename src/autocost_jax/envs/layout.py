"""Random layouts and goal moves: rejection sampling without a loop that waits.

Every draw of Safety Gym's sampler is replaced by `NUM_CANDIDATES` draws made at once,
of which the first valid one is taken: the same distribution, a fixed shape. One
placement rule serves the resets and goal moves on the device and the check of a
configuration on the host, which runs it with NumPy.
"""

import functools
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.records import Key, Layout

NUM_CANDIDATES = 128  # draws for one object; Safety Gym makes up to 100
NUM_RESTARTS = 4  # whole layouts tried side by side; one fails 0.3-0.8 % of the time
HOST_LAYOUTS = 256
MAX_HOST_FAILURES = 0.05
ROBOT, GOAL = 0, 1  # their rows in placement order


class Arena(NamedTuple):
    """Where objects may stand, in placement order.

    Robot, goal, box (Push only), hazards, vases, pillars: Safety Gym's order.

    Attributes:
      keepout: [M] radius each object keeps free around itself.
      low: [M, 2] lower corner of the extents shrunk by the object's own keepout.
      size: [M, 2] width and height of the shrunk extents.
      margin: extra gap between two keepouts.
      box: row of the box, as a slice that is empty where there is none.
      hazards: rows of the hazards.
      vases: rows of the vases.
      pillars: rows of the pillars.
    """

    keepout: np.ndarray
    low: np.ndarray
    size: np.ndarray
    margin: float
    box: slice
    hazards: slice
    vases: slice
    pillars: slice


def make_arena(config: EnvConfig) -> Arena:
    """The placement rule of a configuration.

    Raises:
      ValueError: if more than 5 % of 256 trial layouts cannot be placed.
    """
    keepout = np.array(config.keepouts)
    corners = np.asarray(config.placements_extents)
    low = corners[None, :2] + keepout[:, None]
    size = corners[None, 2:] - keepout[:, None] - low
    nums = (config.task == "Push", config.hazards_num, config.vases_num)
    ends = [int(end) for end in 2 + np.cumsum((*nums, config.pillars_num))]
    rows = map(slice, [2, *ends], ends)
    arena = Arena(keepout, low, size, config.placements_margin, *rows)
    share = host_failure_share(arena)
    if share > MAX_HOST_FAILURES:
        raise ValueError(
            f"the objects of {config.name} do not fit: {share:.0%} of {HOST_LAYOUTS} "
            f"trial layouts failed, at most {MAX_HOST_FAILURES:.0%} may; enlarge "
            "placements_extents or lower the numbers or keepouts of the objects"
        )
    return arena


def place_one(
    xp: ModuleType, placed: Any, keepout: Any, draws: Any, low: Any, size: Any, gap: Any
) -> tuple[Any, Any]:
    """The first of K candidates that keeps clear of everything placed so far.

        clearance_k = min over m of |candidate_k - placed_m| - (keepout_m + gap)

    Args:
      xp: `numpy` or `jax.numpy`.
      placed: [..., M, 2] positions; +inf where nothing stands yet, metres.
      keepout: [M] keepouts of the placed objects.
      draws: [..., 2, K] uniform in [0, 1): K candidates, coordinate by coordinate.
      low: [2] lower corner of the candidates' rectangle.
      size: [2] width and height of that rectangle.
      gap: [] own keepout plus margin.

    Returns:
      position [..., 2] and whether it is valid [...]; where no candidate is, the one
      with the largest clearance.

    Source: openai/safety-gym engine.py, sample_layout and placement_is_valid.
    Differs: all candidates at once.
    """
    x = low[0] + draws[..., 0, :] * size[0]
    y = low[1] + draws[..., 1, :] * size[1]
    # Candidates stay on the last axis, which vectorises; [..., K, M] would not.
    dx = x[..., None, :] - placed[..., 0, None]
    dy = y[..., None, :] - placed[..., 1, None]
    needed = (keepout + gap)[..., None]
    clearance = (xp.sqrt(dx * dx + dy * dy) - needed).min(-2)
    # One score for both rules, and plain reductions in place of two slow argmaxes: a
    # valid candidate scores by its rank, an invalid one by its negative clearance.
    num = draws.shape[-1]
    rank = xp.arange(num)
    score = xp.where(clearance >= 0, (num - rank).astype(x.dtype), clearance)
    best = score.max(-1, keepdims=True)
    index = xp.where(score == best, rank, num - 1).min(-1, keepdims=True)
    position = [xp.take_along_axis(part, index, axis=-1) for part in (x, y)]
    return xp.concatenate(position, axis=-1), best[..., 0] > 0


def draw_points(key: Key, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """Points uniform in the unit square, on a grid of 65536 x 65536.

    Both coordinates come from one 32-bit word: random bits are the largest part of a
    goal move, and 16 bits resolve 0.05 mm of a 3 m arena.

    Args:
      key: consumed.
      shape: leading axes and, last, the number of points K.
      dtype: floating type of the points.

    Returns:
      [..., 2, K] in (0, 1).
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    halves = jnp.stack([bits >> 16, bits & 0xFFFF], axis=-2)
    return (halves.astype(dtype) + 0.5) / 65536


def place_on_host(arena: Arena, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One placement attempt for many layouts, with NumPy.

    Args:
      arena: the placement rule.
      draws: [L, M + 1, 2, K] uniform in [0, 1); the last row redraws the goal.

    Returns:
      positions [L, M, 2] and success [L].
    """
    placed = np.full((len(draws), len(arena.keepout), 2), np.inf)
    success = np.ones(len(draws), bool)
    for row, index in enumerate([*range(len(arena.keepout)), GOAL]):
        placed[:, index] = np.inf  # the second goal draw forgets the first goal
        gap = arena.keepout[index] + arena.margin
        place = functools.partial(place_one, np, placed, arena.keepout)
        xy, valid = place(draws[:, row], arena.low[index], arena.size[index], gap)
        placed[:, index] = xy
        success &= valid
    return placed, success


def is_too_full(arena: Arena) -> bool:
    """Whether the keepouts, which must not overlap, are larger than the arena."""
    keepout, gap = arena.keepout, arena.margin
    corner = (arena.low - keepout[:, None]).min(0)
    far = (arena.low + arena.size + keepout[:, None]).max(0)
    needed = np.pi * np.sum((keepout + gap / 2) ** 2)
    return bool(needed > np.prod(far - corner + gap))


def host_failure_share(arena: Arena) -> float:
    """Share of `HOST_LAYOUTS` layouts that fail in all `NUM_RESTARTS` attempts."""
    if is_too_full(arena):
        return 1.0
    rng = np.random.default_rng(0)
    open_layouts = HOST_LAYOUTS
    for _ in range(NUM_RESTARTS):
        shape = (open_layouts, len(arena.keepout) + 1, 2, NUM_CANDIDATES)
        _, success = place_on_host(arena, rng.random(shape))
        open_layouts -= int(success.sum())
    return open_layouts / HOST_LAYOUTS


def place_all(arena: Arena, draws: jax.Array) -> tuple[jax.Array, jax.Array]:
    """One placement attempt: every object in turn, then the goal once more.

    Args:
      arena: the placement rule.
      draws: [M + 1, 2, K] uniform in [0, 1); the last row redraws the goal.

    Returns:
      positions [M, 2] and whether all of them are valid [].

    Source: openai/safety-gym engine.py, sample_layout, build_goal_position.
    """
    dtype = draws.dtype
    keepout = jnp.asarray(arena.keepout, dtype)
    low, size = jnp.asarray(arena.low, dtype), jnp.asarray(arena.size, dtype)

    def place_next(carry, inputs):
        placed, success = carry
        index, draw = inputs
        placed = placed.at[index].set(jnp.inf)
        gap = keepout[index] + arena.margin
        xy, valid = place_one(jnp, placed, keepout, draw, low[index], size[index], gap)
        return (placed.at[index].set(xy), success & valid), None

    order = jnp.append(jnp.arange(len(arena.keepout)), GOAL)
    empty = jnp.full((len(arena.keepout), 2), jnp.inf, dtype)
    (placed, success), _ = jax.lax.scan(
        place_next, (empty, jnp.array(True)), (order, draws)
    )
    return placed, success


def sample_layout(arena: Arena, key: Key, dtype: Any) -> tuple[Layout, jax.Array]:
    """A fresh random layout.

    Args:
      arena: the placement rule.
      key: consumed.
      dtype: floating type of the layout.

    Returns:
      the layout, and `failed` []: True if every one of four attempts failed (the
      layout then breaks a keepout).
    """
    key_draws, key_yaw, key_yaws = jax.random.split(key, 3)
    shape = (NUM_RESTARTS, len(arena.keepout) + 1, NUM_CANDIDATES)
    draws = draw_points(key_draws, shape, dtype)
    placed, success = jax.vmap(functools.partial(place_all, arena))(draws)
    xy = placed[jnp.argmax(success)]
    num_vases = arena.vases.stop - arena.vases.start
    yaws = jax.random.uniform(key_yaws, (1 + num_vases,), dtype, 0.0, 2 * np.pi)
    has_box = arena.box.stop > arena.box.start
    layout = Layout(
        robot_xy=xy[ROBOT],
        robot_yaw=jax.random.uniform(key_yaw, (), dtype, 0.0, 2 * np.pi),
        goal_xy=xy[GOAL],
        hazards=xy[arena.hazards],
        pillars=xy[arena.pillars],
        box_xy=xy[arena.box][0] if has_box else jnp.zeros(2, dtype),
        box_yaw=yaws[0] if has_box else jnp.zeros((), dtype),
        vases=xy[arena.vases] if num_vases else None,
        vases_yaw=yaws[1:] if num_vases else None,
    )
    return layout, ~success.any()


def move_goal(arena: Arena, layout: Layout, key: Key) -> tuple[jax.Array, jax.Array]:
    """A new goal position, clear of the robot and of everything else.

    Args:
      arena: the placement rule.
      layout: where things stand now; its goal is ignored.
      key: consumed.

    Returns:
      position [2] and whether it is valid []; if no candidate was, the position is
      the candidate with the largest clearance.

    Source: openai/safety-gym engine.py, sample_goal_position.
    Differs: 128 candidates at once instead of up to 10000 in turn, and the best one
    instead of the end of the episode.
    """
    dtype = layout.goal_xy.dtype
    box = layout.box_xy[None][: arena.box.stop - arena.box.start]
    robot = layout.robot_xy[None]
    others = (robot, box, layout.hazards, layout.vases, layout.pillars)
    others = jnp.concatenate([x for x in others if x is not None and x.size])
    keepout = jnp.asarray(np.delete(arena.keepout, GOAL), dtype)
    draws = draw_points(key, (NUM_CANDIDATES,), dtype)
    low, size = (jnp.asarray(part[GOAL], dtype) for part in (arena.low, arena.size))
    gap = jnp.asarray(arena.keepout[GOAL] + arena.margin, dtype)
    return place_one(jnp, others, keepout, draws, low, size, gap)
