"""Layouts of all worlds: boxes, pillars and vases keep clear too, and they all fit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.config import ENVS, SUITE, env_config
from autocost_jax.envs import layout as layouts

ROUNDING = 1e-6  # float32 distances of a few metres
NUM = 1000
BATCH = 500  # layouts placed at once on the host: bounds its memory

# Share of single attempts that fail: an upper bound from the fact sheet, which measured
# 20 000 layouts with 100 draws an object where we make 128. 0 means below 5e-5.
ONE_ATTEMPT = {
    "Goal-Hazard-Point": 0.0,
    "Goal-Hazard8-Point": 0.008,
    "Goal-Pillar-Point": 0.0,
    "Push-Hazard-Point": 0.0,
    "Push-Hazard-Car": 0.0,
    "Push-Pillar-Point": 0.0,
    "Push-Pillar-Car": 0.0,
    "PointGoal1": 0.0,
    "PointGoal2": 0.0,
    "PointPush1": 1e-4,
    "CarPush1": 1e-4,
    "PointPush2": 0.0,
    "CarPush2": 0.0,
}
UNSEEN = 5e-5  # what the fact sheet's 0 may hide


def space(name: str) -> tuple:
    """All that the layouts of a world depend on."""
    config = env_config(name)
    return (config.keepouts, config.placements_extents, config.placements_margin)


def failure_shares(name: str, num: int) -> tuple[float, float]:
    """Share of layouts that fail in one attempt, and in all of four."""
    arena = layouts.make_arena(env_config(name))
    rng = np.random.default_rng(0)
    shape = (len(arena.keepout) + 1, 2, layouts.NUM_CANDIDATES)
    once = fourfold = 0
    for start in range(0, num, BATCH):
        first = failing = min(BATCH, num - start)
        for attempt in range(layouts.NUM_RESTARTS):
            _, success = layouts.place_on_host(arena, rng.random((failing, *shape)))
            failing -= int(success.sum())
            if attempt == 0:
                first = failing
        once, fourfold = once + first, fourfold + failing
    return once / num, fourfold / num


def test_the_table_has_every_space():
    """Robots share their spaces, but for the Car's box."""
    assert {space(name) for name in ONE_ATTEMPT} == {
        space(name) for name in (*ENVS, *SUITE)
    }


@pytest.mark.parametrize("name", ONE_ATTEMPT)
def test_layouts_rarely_fail(name):
    once, fourfold = failure_shares(name, NUM)
    expected = max(ONE_ATTEMPT[name], UNSEEN)
    assert once < expected + 4 * np.sqrt(expected / NUM)
    assert fourfold == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ONE_ATTEMPT)
def test_measured_failures(name, record_property):
    """20 000 layouts; what is measured stands in tests/results/slow.json."""
    num = 20_000
    once, fourfold = failure_shares(name, num)
    shared = [other for other in (*ENVS, *SUITE) if space(other) == space(name)]
    record_property("worlds", shared)
    record_property("one attempt", once)
    record_property("four attempts", fourfold)
    expected = max(ONE_ATTEMPT[name], UNSEEN)
    assert once < expected + 4 * np.sqrt(expected / num)
    assert fourfold == 0.0


# --- on the device ----------------------------------------------------------


@pytest.fixture(scope="module", params=["Push-Pillar-Car", "PointGoal2", "DoggoPush2"])
def placed(request):
    """The arena of a world, and `NUM` of its layouts."""
    arena = layouts.make_arena(env_config(request.param))
    sample = functools.partial(layouts.sample_layout, arena, dtype=jnp.float32)
    layout, failed = jax.jit(jax.vmap(sample))(jax.random.split(jax.random.key(0), NUM))
    assert not failed.any()
    return arena, layout


def positions(arena, layout) -> np.ndarray:
    """[N, M, 2] everything there is, in placement order."""
    box = layout.box_xy[:, None][:, : arena.box.stop - arena.box.start]
    first = (layout.robot_xy[:, None], layout.goal_xy[:, None], box)
    vases = () if layout.vases is None else (layout.vases,)
    return np.concatenate([*first, layout.hazards, *vases, layout.pillars], axis=1)


def test_all_objects_keep_clear(placed):
    arena, layout = placed
    xy = positions(arena, layout)
    assert xy.shape == (NUM, len(arena.keepout), 2)
    distance = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)
    needed = arena.keepout[:, None] + arena.keepout
    np.fill_diagonal(needed, 0.0)
    assert (distance >= needed - ROUNDING).all()
    inside = (xy >= arena.low) & (xy <= arena.low + arena.size)
    assert inside.all()


def test_headings_are_uniform_and_independent(placed):
    """Of robot, box and vases; zero where there is no box."""
    _, layout = placed
    yaws = [layout.robot_yaw]
    if layout.vases_yaw is not None:
        yaws += list(np.moveaxis(np.asarray(layout.vases_yaw), 1, 0))
    if np.asarray(layout.box_xy).any():
        yaws.append(layout.box_yaw)
    else:
        assert not np.asarray(layout.box_yaw).any()
    assert len(yaws) > 1
    yaws = np.stack(yaws)
    assert (yaws >= 0).all()
    assert (yaws <= 2 * np.pi).all()
    sigma = 2 * np.pi / np.sqrt(12 * NUM)
    np.testing.assert_allclose(yaws.mean(1), np.pi, atol=4 * sigma)
    related = np.corrcoef(yaws) - np.eye(len(yaws))
    assert np.abs(related).max() < 5 / np.sqrt(NUM)


def test_moved_goals_keep_clear_of_every_kind(placed):
    """The goal met where it was: the robot stands there, with the box in Push."""
    arena, layout = placed
    layout = layout.replace(robot_xy=layout.goal_xy)
    keys = jax.random.split(jax.random.key(1), NUM)
    goal, valid = jax.jit(jax.vmap(functools.partial(layouts.move_goal, arena)))(
        layout, keys
    )
    # The fact sheet has at most 4e-4 for the worlds at hand, with 128 candidates.
    assert valid.mean() >= 1 - 4e-4 - 4 * np.sqrt(4e-4 / NUM)
    xy = positions(arena, layout.replace(goal_xy=goal))[np.asarray(valid)]
    moved = xy[:, layouts.GOAL]
    distance = np.linalg.norm(xy - moved[:, None], axis=-1)
    needed = arena.keepout + arena.keepout[layouts.GOAL]
    needed[layouts.GOAL] = 0.0
    assert (distance >= needed - ROUNDING).all()
    # Drawn anew: farther from the old goal, where the robot is, than the two keepouts.
    assert (np.abs(moved) <= arena.low[layouts.GOAL] + arena.size[layouts.GOAL]).all()
