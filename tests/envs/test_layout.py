import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.config import EnvConfig
from autocost_jax.envs import layout as layouts
from autocost_jax.envs.env import make_env
from autocost_jax.records import Layout

ROUNDING = 1e-6  # float32 distances of a few metres
TIGHT = EnvConfig(hazards_num=30)  # 30 keepouts of 0.4 m need more than 4 m x 4 m
NUM_MOVES = 10_000


@pytest.fixture(scope="module")
def arena():
    return layouts.make_arena(EnvConfig())


@pytest.fixture(scope="module")
def tight():
    """An arena that does not fit, made without its check."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layouts, "MAX_HOST_FAILURES", 1.0)
        return layouts.make_arena(TIGHT)


def sampler(arena):
    sample = functools.partial(layouts.sample_layout, arena, dtype=jnp.float32)
    return jax.jit(jax.vmap(sample))


@pytest.fixture(scope="module")
def sampled(arena):
    """1000 random layouts; fields [1000, ...]."""
    layout, failed = sampler(arena)(jax.random.split(jax.random.key(0), 1000))
    assert not failed.any()
    return layout


def positions(layout: Layout) -> np.ndarray:
    """[..., M, 2] robot, goal, hazards."""
    first = (layout.robot_xy[..., None, :], layout.goal_xy[..., None, :])
    return np.concatenate([*first, layout.hazards], axis=-2)


def test_keepouts_and_extents_hold(arena, sampled):
    xy = positions(sampled)
    distance = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)
    needed = arena.keepout[:, None] + arena.keepout
    np.fill_diagonal(needed, 0.0)
    assert (distance >= needed - ROUNDING).all()
    assert (np.abs(xy) <= 2 - arena.keepout[:, None]).all()
    assert np.ptp(np.asarray(sampled.robot_yaw)) > 6
    assert float(sampled.robot_yaw.min()) >= 0
    assert float(sampled.robot_yaw.max()) <= 2 * np.pi


def test_robots_are_uniform(sampled):
    """The robot is placed first; a mean is within 4 sigma of 0, a variance too."""
    width, num = 2 * 1.6, len(sampled.robot_xy)
    sigma = width / np.sqrt(12)
    assert (np.abs(sampled.robot_xy.mean(0)) < 4 * sigma / np.sqrt(num)).all()
    # Relative error of the variance of a uniform: sqrt(4 / 5 / num).
    ratio = np.asarray(sampled.robot_xy.var(0)) / sigma**2
    assert (np.abs(ratio - 1) < 4 * np.sqrt(0.8 / num)).all()


def test_margin_widens_the_gaps():
    config = EnvConfig(placements_margin=0.1, hazards_num=4)
    arena = layouts.make_arena(config)
    layout, failed = sampler(arena)(jax.random.split(jax.random.key(0), 100))
    xy = positions(layout)
    distance = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)
    distance += 9 * np.eye(len(arena.keepout))
    assert not failed.any()
    assert distance.min() >= 0.9 - ROUNDING


def test_impossible_layouts_are_flagged(tight):
    layout, failed = sampler(tight)(jax.random.split(jax.random.key(0), 20))
    assert failed.all()
    assert np.isfinite(positions(layout)).all()
    assert layouts.host_failure_share(tight) == 1.0


def test_impossible_configuration_is_refused():
    with pytest.raises(ValueError, match=r"100% of 256 .* placements_extents"):
        make_env(TIGHT)


def test_keepouts_larger_than_the_arena_are_refused_at_once():
    """Trial layouts of 1000 objects would take many minutes."""
    with pytest.raises(ValueError, match="100% of 256"):
        make_env(EnvConfig(hazards_num=1000))
    few = layouts.make_arena(EnvConfig())
    assert not layouts.is_too_full(few)
    # 6 keepouts of 0.4 m cover 3.0 of 16 square metres, with gaps of 1 m 15 of 25.
    assert not layouts.is_too_full(few._replace(margin=1.0))
    assert layouts.is_too_full(few._replace(margin=3.0))


def test_default_configuration_is_far_from_refused(arena):
    assert layouts.host_failure_share(arena) == 0.0


def test_one_attempt_fails_rarely(arena):
    """0.34 % expected with 128 candidates: 4000 attempts, within 4 sigma."""
    num = 4000

    @jax.jit
    @jax.vmap
    def attempt(key):
        shape = (len(arena.keepout) + 1, layouts.NUM_CANDIDATES)
        draws = layouts.draw_points(key, shape, jnp.float32)
        return layouts.place_all(arena, draws)[1]

    share = 1 - attempt(jax.random.split(jax.random.key(0), num)).mean()
    assert abs(float(share) - 0.0034) < 4 * np.sqrt(0.0034 / num)


@pytest.mark.slow
def test_four_attempts_never_fail(arena):
    sample = sampler(arena)
    for part in range(50):
        keys = jax.random.split(jax.random.key(part), 2000)
        assert not sample(keys)[1].any()


def test_host_and_device_place_alike(arena):
    draws = np.random.default_rng(0).random((200, len(arena.keepout) + 1, 2, 128))
    host_xy, host_success = layouts.place_on_host(arena, draws)
    place = jax.vmap(functools.partial(layouts.place_all, arena))
    device_xy, success = place(jnp.asarray(draws, jnp.float32))
    # A candidate may lie on a keepout to within float32 rounding.
    same = np.abs(device_xy - host_xy).max((1, 2)) < ROUNDING
    assert same.mean() > 0.98
    np.testing.assert_array_equal(success[same], host_success[same])


def test_first_valid_candidate_wins():
    """Candidate 0 is too close, 2 and 3 are valid: 2 is taken."""
    draws = np.array([[0.5, 0.55, 0.9, 0.1], [0.5, 0.5, 0.9, 0.1]])
    placed, keepout = np.array([[0.5, 0.5], [np.inf, np.inf]]), np.array([0.2, 0.2])
    unit = (np.zeros(2), np.ones(2))
    xy, valid = layouts.place_one(np, placed, keepout, draws, *unit, 0.1)
    assert valid
    np.testing.assert_allclose(xy, (0.9, 0.9))
    # None is valid: the one with the largest clearance is taken, and said so.
    xy, valid = layouts.place_one(np, placed, keepout, draws, *unit, 5.0)
    assert not valid
    np.testing.assert_allclose(xy, (0.9, 0.9))


def test_goal_is_drawn_a_second_time(arena):
    """Hazards avoid the first goal; the final goal comes from the last draws alone."""
    rng = np.random.default_rng(1)
    draws = rng.random((1, len(arena.keepout) + 1, 2, 128))
    once, _ = layouts.place_on_host(arena, draws)
    draws[:, -1] = rng.random((2, 128))
    again, _ = layouts.place_on_host(arena, draws)
    others = np.delete(np.arange(len(arena.keepout)), layouts.GOAL)
    np.testing.assert_array_equal(once[:, others], again[:, others])
    assert np.abs(once[:, layouts.GOAL] - again[:, layouts.GOAL]).max() > 0.01
    candidates = arena.low[layouts.GOAL][:, None] + (
        draws[0, -1] * arena.size[layouts.GOAL][:, None]
    )
    gap = np.abs(candidates - again[0, layouts.GOAL][:, None]).max(0)
    assert gap.min() < ROUNDING


def test_drawn_points_are_uniform():
    """Both halves of a word: means within 4 sigma, and uncorrelated."""
    num = 100_000
    x, y = np.asarray(layouts.draw_points(jax.random.key(0), (num,), jnp.float32))
    sigma = 1 / np.sqrt(12 * num)
    assert abs(x.mean() - 0.5) < 4 * sigma
    assert abs(y.mean() - 0.5) < 4 * sigma
    assert abs(np.corrcoef(x, y)[0, 1]) < 4 / np.sqrt(num)
    assert 0 < min(x.min(), y.min()) < max(x.max(), y.max()) < 1


@pytest.fixture(scope="module")
def moves(arena, sampled):
    """A layout whose robot stands on its goal, and 10 000 moves of that goal."""
    layout = jax.tree.map(lambda leaf: leaf[0], sampled)
    layout = layout.replace(robot_xy=layout.goal_xy)
    keys = jax.random.split(jax.random.key(1), NUM_MOVES)
    move = jax.jit(jax.vmap(lambda key: layouts.move_goal(arena, layout, key)))
    goal, valid = move(keys)
    assert valid.all()
    return layout, np.asarray(goal)


def clearance(arena, layout, points):
    """[K] smallest gap between a goal at each point and the robot or a hazard."""
    others = np.concatenate([layout.robot_xy[None], layout.hazards])
    keepout = np.delete(arena.keepout, layouts.GOAL) + arena.keepout[layouts.GOAL]
    distance = np.linalg.norm(points[:, None] - others, axis=-1)
    return (distance - keepout).min(-1)


def test_moved_goals_keep_clear(arena, moves):
    layout, goal = moves
    assert clearance(arena, layout, goal).min() >= -ROUNDING
    assert (np.abs(goal) <= 2 - arena.keepout[layouts.GOAL]).all()


def test_moved_goals_are_uniform_over_the_free_area(arena, moves):
    """Chi-square over a 12 x 12 grid, within 5 sigma of its mean."""
    layout, goal = moves
    num_cells, fine = 12, 40
    side = (np.arange(num_cells * fine) + 0.5) / (num_cells * fine) * 3.2 - 1.6
    points = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    free = clearance(arena, layout, points) >= 0

    def count(xy, weights=None):
        edges = np.linspace(-1.6, 1.6, num_cells + 1)
        return np.histogram2d(*xy.T, bins=[edges, edges], weights=weights)[0]

    expected = count(points, free) / free.sum() * NUM_MOVES
    got = count(goal)
    assert got[expected == 0].sum() < 5  # slivers that the fine grid misses
    used = expected > 20
    chi_square = ((got - expected)[used] ** 2 / expected[used]).sum()
    degrees = used.sum() - 1
    assert degrees > 10
    assert abs(chi_square - degrees) < 5 * np.sqrt(2 * degrees)


def test_goal_move_without_room_is_reported(tight):
    layout, _ = sampler(tight)(jax.random.split(jax.random.key(0), 8))
    # Hazards on a 1 m grid leave no point 0.8 m away from all of them.
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-2, 2, 5)]), -1).reshape(-1, 2)
    hazards = np.resize(grid, (8, 30, 2)).astype(np.float32)
    layout = layout.replace(hazards=jnp.asarray(hazards))
    move = jax.vmap(functools.partial(layouts.move_goal, tight))
    goal, valid = move(layout, jax.random.split(jax.random.key(2), 8))
    assert not valid.any()
    assert (np.abs(goal) <= 1.6).all()
