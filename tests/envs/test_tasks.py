import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_data import float32_bound, load

from autocost_jax.config import EnvConfig
from autocost_jax.envs.constraints import (
    distances_to,
    make_constraint,
    vase_constraint,
)
from autocost_jax.envs.sensors import lidar
from autocost_jax.envs.tasks import goal_height, goal_task, push_task
from autocost_jax.records import Bodies, Layout

FLOAT32 = 1e-5  # float32 against the engine's float64


def bodies(robot=(0, 0, 0), box=(0, 0, 0), **known) -> Bodies:
    """Bodies that touch nothing; only what is given matters."""
    fields = {
        "robot": jnp.asarray(robot, jnp.float32),
        "rotation": jnp.eye(3),
        "box": jnp.asarray(box, jnp.float32),
        "box_yaw": jnp.zeros(()),
        "pillar_contacts": jnp.zeros((), jnp.int32),
        "vase_contacts": jnp.zeros((), jnp.int32),
    }
    return Bodies(**(fields | known))


@pytest.fixture(scope="module")
def recorded():
    return load("reward_cost_goal")


@pytest.fixture(scope="module")
def layouts(recorded):
    """The 400 scripted poses as layouts, fields [400, ...]."""
    num = len(recorded["xy"])

    def repeat(value):
        value = jnp.asarray(value, jnp.float32)
        return jnp.broadcast_to(value, (num, *value.shape))

    return Layout(
        robot_xy=jnp.asarray(recorded["xy"], jnp.float32),
        robot_yaw=jnp.asarray(recorded["yaw"], jnp.float32),
        goal_xy=repeat(recorded["goal"]),
        hazards=repeat(recorded["hazards"]),
        pillars=repeat(np.zeros((0, 2))),
        box_xy=repeat(np.zeros(2)),
        box_yaw=repeat(0.0),
    )


def test_reward_matches_safety_gym(recorded, layouts):
    task = goal_task(EnvConfig(goal_size=float(recorded["goal_size"])))
    distances = jax.vmap(lambda layout: task.distances(layout, bodies()))(layouts)
    np.testing.assert_allclose(distances[:, 0], recorded["dist_goal"], atol=FLOAT32)
    start = jnp.full((1, 1), recorded["dist_goal0"], jnp.float32)
    previous = jnp.concatenate([start, distances[:-1]])
    reward = jax.vmap(task.reward)(previous, distances)
    np.testing.assert_allclose(reward, recorded["reward"], atol=FLOAT32)
    is_met = jax.vmap(task.is_met)(distances)
    np.testing.assert_array_equal(is_met, recorded["goal_met"])
    total = reward + recorded["reward_goal"] * is_met
    np.testing.assert_allclose(total, recorded["reward_total"], atol=FLOAT32)


def test_dense_reward_is_clipped():
    task = goal_task(EnvConfig(reward_distance=100.0))
    assert float(task.reward(jnp.array([1.0]), jnp.array([0.5]))) == 10.0
    assert float(task.reward(jnp.array([0.5]), jnp.array([1.0]))) == -10.0


@pytest.mark.parametrize(
    ("indicator", "expected"),
    [(False, "cost_hazards_dense"), (True, "cost_hazards_indicator")],
)
def test_hazard_cost_matches_safety_gym(recorded, layouts, indicator, expected):
    size = float(recorded["hazards_size"])
    config = EnvConfig(hazards_size=size, constrain_indicator=indicator)
    constraint = make_constraint(config)
    distances = jax.vmap(lambda layout: distances_to(constraint, layout))(layouts)
    np.testing.assert_allclose(distances, recorded["hazard_dist"], atol=FLOAT32)
    cost = jax.vmap(lambda near: constraint.cost(near, bodies()))(distances)
    assert recorded[expected].max() > 0
    np.testing.assert_allclose(cost, recorded[expected], atol=FLOAT32)


def test_dense_cost_is_the_papers_where_hazards_do_not_overlap(recorded):
    size = float(recorded["hazards_size"])
    near = np.sort(recorded["hazard_dist"], axis=-1)
    alone = near[:, 1] >= size  # the scripted hazards partly overlap
    assert (near[alone, 0] < size).any()
    cost = make_constraint(EnvConfig(hazards_size=size)).cost
    distances = jnp.asarray(recorded["hazard_dist"][alone], jnp.float32)
    got = jax.vmap(lambda near: cost(near, bodies()))(distances)
    closest = np.maximum(0, size - near[alone, 0])
    np.testing.assert_allclose(got, closest, atol=FLOAT32)


@pytest.mark.parametrize("name", ["goal_lidar", "hazards_lidar"])
def test_lidars_match_safety_gym(recorded, layouts, name):
    task, constraint = goal_task(EnvConfig()), make_constraint(EnvConfig())

    def read(layout):
        cos, sin, zero = jnp.cos(layout.robot_yaw), jnp.sin(layout.robot_yaw), 0.0
        rotation = jnp.array([[cos, -sin, zero], [sin, cos, zero], [zero, zero, 1.0]])
        sees = {**task.lidars, "hazards_lidar": constraint.objects}[name]
        position = jnp.append(layout.robot_xy, 0.1)
        return lidar(sees(layout), position, rotation, num_bins=16, max_dist=3.0)

    got = jax.jit(jax.vmap(read))(layouts)
    distances = {
        "goal_lidar": recorded["dist_goal"],
        "hazards_lidar": recorded["hazard_dist"].min(-1),
    }
    bound = float32_bound(distances[name])[:, None]
    assert (np.abs(got - recorded[name]) <= bound).all()


@pytest.mark.parametrize("null_dist", [0, 2])
def test_push_reward_matches_safety_gym(null_dist):
    recorded = load("reward_push")
    config = EnvConfig(
        task="Push",
        goal_size=float(recorded["goal_size"]),
        box_size=float(recorded["box_size"]),
        box_null_dist=null_dist,
    )
    assert goal_height(config) == pytest.approx(float(recorded["goal_z"]))
    task = push_task(config)

    def distances(robot_xy, box_xy):
        standing = bodies(
            jnp.append(robot_xy, recorded["robot_z"]),
            jnp.append(box_xy, recorded["box_z"]),
        )
        goal = jnp.asarray(recorded["goal"], jnp.float32)
        layout = Layout(robot_xy, robot_xy[0], goal, goal, goal, box_xy, box_xy[0])
        return task.distances(layout, standing)

    robot = jnp.asarray(recorded["robot_xy"], jnp.float32)
    box = jnp.asarray(recorded["box_xy"], jnp.float32)
    got = jax.vmap(distances)(robot, box)
    np.testing.assert_allclose(got, recorded["dist_box_boxgoal"], atol=FLOAT32)
    first = jnp.asarray(recorded["init_dist_box_boxgoal"], jnp.float32)[None]
    reward = jax.vmap(task.reward)(jnp.concatenate([first, got[:-1]]), got)
    expected = recorded[f"reward_null{null_dist}"]
    is_met = np.asarray(jax.vmap(task.is_met)(got))
    np.testing.assert_array_equal(is_met, recorded["goal_met"])
    np.testing.assert_allclose(reward, expected, atol=2 * FLOAT32)


def test_vases_cost_contacts_and_speed_above_the_threshold():
    config = EnvConfig(vases_num=2, constrain_vases=True, observe_vases=True)
    cost = vase_constraint(config).cost
    still = jnp.array([0.5e-4, 0.0])
    assert float(cost(jnp.ones(2), bodies(vases_speed=still))) == 0.0
    moving = bodies(vases_speed=jnp.array([0.25, 0.5e-4]), vase_contacts=jnp.array(3))
    assert float(cost(jnp.ones(2), moving)) == 3.25


def test_a_pillar_costs_one_however_many_contacts():
    config = EnvConfig(hazards_num=0, pillars_num=2, constrain_pillars=True)
    cost = make_constraint(config).cost
    for contacts, expected in ((0, 0.0), (1, 1.0), (4, 1.0)):
        touching = bodies(pillar_contacts=jnp.array(contacts))
        assert float(cost(jnp.ones(2), touching)) == expected
