"""The table of worlds: this project's own, and Safety Gym's suite."""

import dataclasses

import pytest

from autocost_jax.config import ENVS, SUITE, EnvConfig, env_config

# kind -> number, radius, keepout
EIGHT_HAZARDS, FOUR_HAZARDS = (8, 0.3, 0.4), (4, 0.3, 0.4)
FOUR_PILLARS = (4, 0.2, 0.3)
OWN = {
    ("Goal", "Hazard"): {"hazards": FOUR_HAZARDS},
    ("Goal", "Hazard8"): {"hazards": EIGHT_HAZARDS},
    ("Push", "Hazard"): {"hazards": FOUR_HAZARDS},
    ("Goal", "Pillar"): {"pillars": FOUR_PILLARS},
    ("Push", "Pillar"): {"pillars": FOUR_PILLARS},
}
# size, density, keepout
BOX = {"Point": (0.2, 0.001, 0.425), "Doggo": (0.2, 0.001, 0.425)}
BOX["Car"] = (0.125, 0.0005, 0.27)
SUITE_BOX = {"Point": (0.2, 0.001, 0.2), "Doggo": (0.2, 0.001, 0.2)}
SUITE_BOX["Car"] = (0.125, 0.0005, 0.125)

# extent, goal keepout, objects, constrained kinds
GOAL_HAZARDS, VASES = (0.2, 0.18), (0.1, 0.15)
SUITE_TABLE = {
    ("Goal", 1): (
        1.5,
        0.305,
        {"hazards": (8, *GOAL_HAZARDS), "vases": (1, *VASES)},
        ("hazards",),
    ),
    ("Goal", 2): (
        2.0,
        0.305,
        {"hazards": (10, *GOAL_HAZARDS), "vases": (10, *VASES)},
        ("hazards", "vases"),
    ),
    ("Push", 1): (
        1.5,
        0.4,
        {"hazards": (2, 0.3, 0.4), "pillars": (1, 0.2, 0.3)},
        ("hazards",),
    ),
    ("Push", 2): (
        2.0,
        0.4,
        {"hazards": (4, 0.3, 0.4), "pillars": (4, 0.2, 0.3)},
        ("hazards", "pillars"),
    ),
}


def objects(config: EnvConfig) -> dict[str, tuple]:
    """kind -> number, radius, keepout, of those that there are."""
    return {
        kind: tuple(
            getattr(config, f"{kind}_{what}") for what in ("num", "size", "keepout")
        )
        for kind in ("hazards", "pillars", "vases")
        if getattr(config, f"{kind}_num")
    }


def observed(config: EnvConfig) -> list[str]:
    kinds = ("hazards", "pillars", "vases")
    return [kind for kind in kinds if getattr(config, f"observe_{kind}")]


def box(config: EnvConfig) -> tuple[float, float, float]:
    return config.box_size, config.box_density, config.box_keepout


def assert_shared(config: EnvConfig, extent: float, goal_keepout: float) -> None:
    """What all worlds have in common with Safety Gym's engine."""
    assert config.placements_extents == (-extent, -extent, extent, extent)
    assert config.placements_margin == 0
    assert config.robot_keepout == 0.4
    assert (config.goal_size, config.goal_keepout) == (0.3, goal_keepout)
    assert (config.num_steps, config.frameskip_binom_n) == (1000, 10)
    assert (config.box_null_dist, config.pillars_height) == (0, 0.5)
    assert (config.lidar_exp_gain, config.lidar_alias) == (1, True)
    costs = (config.hazards_cost, config.pillars_cost)
    assert costs == (1, 1)
    assert (config.vases_contact_cost, config.vases_velocity_cost) == (1, 1)
    assert (config.vases_sink, config.vases_velocity_threshold) == (4e-5, 1e-4)
    assert config.vases_density == 0.001
    rewards = ("distance", "box_dist", "box_goal", "goal")
    assert {getattr(config, f"reward_{name}") for name in rewards} == {1}
    assert config.reward_clip == 10
    assert config.physics == "reduced"


def test_the_names_of_our_worlds():
    assert list(ENVS) == [
        "Goal-Hazard-Point",
        "Goal-Hazard-Car",
        "Goal-Hazard-Doggo",
        "Goal-Pillar-Point",
        "Goal-Pillar-Car",
        "Goal-Pillar-Doggo",
        "Push-Hazard-Point",
        "Push-Hazard-Car",
        "Push-Hazard-Doggo",
        "Push-Pillar-Point",
        "Push-Pillar-Car",
        "Push-Pillar-Doggo",
        "Goal-Hazard8-Point",
        "Goal-Hazard8-Car",
        "Goal-Hazard8-Doggo",
    ]
    assert ENVS["Goal-Hazard-Point"] == EnvConfig()


@pytest.mark.parametrize("name", ENVS)
def test_our_worlds(name):
    config = env_config(name)
    task, constraint, robot = name.split("-")
    assert (config.task, config.robot, config.name) == (task, robot, name)
    assert_shared(config, extent=2, goal_keepout=0.4)
    assert objects(config) == OWN[task, constraint]
    kind = f"{constraint.lower().rstrip('8')}s"
    assert list(config.constrained) == observed(config) == [kind]
    if task == "Push":
        assert box(config) == BOX[robot]
    # Dense cost, 8 bins, exponential.
    assert not config.constrain_indicator
    assert (config.lidar_num_bins, config.lidar_max_dist) == (8, None)


def test_the_names_of_the_suite():
    assert set(SUITE) == {
        "PointGoal1",
        "PointGoal2",
        "PointPush1",
        "PointPush2",
        "CarGoal1",
        "CarGoal2",
        "CarPush1",
        "CarPush2",
        "DoggoGoal1",
        "DoggoGoal2",
        "DoggoPush1",
        "DoggoPush2",
    }


@pytest.mark.parametrize("name", SUITE)
def test_the_suite(name):
    config = env_config(name)
    robot, task, level = name[:-5], name[-5:-1], int(name[-1])
    assert (config.task, config.robot) == (task, robot)
    extent, goal_keepout, there, constrained = SUITE_TABLE[task, level]
    assert_shared(config, extent, goal_keepout)
    assert objects(config) == there
    assert config.constrained == constrained
    assert observed(config) == sorted(there)
    if task == "Push":
        assert box(config) == SUITE_BOX[robot]
    assert config.constrain_indicator
    assert (config.lidar_num_bins, config.lidar_max_dist) == (16, 3)


@pytest.mark.parametrize(
    ("name", "keepouts"),
    [
        ("Goal-Hazard-Car", [0.4, 0.4, *4 * [0.4]]),
        ("Push-Pillar-Car", [0.4, 0.4, 0.27, *4 * [0.3]]),
        ("PointGoal1", [0.4, 0.305, *8 * [0.18], 0.15]),
        ("DoggoPush2", [0.4, 0.4, 0.2, *4 * [0.4], *4 * [0.3]]),
    ],
)
def test_objects_are_placed_in_safety_gyms_order(name, keepouts):
    """Robot, goal, box, hazards, vases, pillars."""
    assert list(env_config(name).keepouts) == keepouts


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="unknown environment 'Push-Lava'") as caught:
        env_config("Push-Lava")
    for name in (*ENVS, *SUITE):
        assert name in str(caught.value)


@pytest.mark.parametrize(
    "change", [{"hazards_num": 0}, {"constrain_hazards": False}], ids=str
)
def test_a_world_without_a_constraint_is_refused(change):
    with pytest.raises(ValueError, match=r"^constrain_hazards, .* at least one kind"):
        dataclasses.replace(EnvConfig(), **change)
    with_pillar = dataclasses.replace(
        EnvConfig(), pillars_num=1, constrain_pillars=True, **change
    )
    assert with_pillar.constrained == ("pillars",)
    assert with_pillar.name == "Goal-Pillar1-Point-custom"


@pytest.mark.parametrize("name", [*ENVS, *SUITE])
def test_a_world_keeps_its_name_in_other_lengths_and_models(name):
    short = dataclasses.replace(env_config(name), num_steps=50, physics="full")
    assert short.name == name


def test_a_changed_world_does_not_bear_the_name_of_another():
    changed = dataclasses.replace(EnvConfig(), hazards_num=6)
    assert changed.name == "Goal-Hazard6-Point-custom"
    assert EnvConfig(hazards_size=0.2).name == "Goal-Hazard4-Point-custom"
