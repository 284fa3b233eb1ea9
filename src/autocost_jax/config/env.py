"""Configuration of the worlds: this project's own and Safety Gym's suite.

`EnvConfig` keeps Safety Gym's keys letter for letter, so that a configuration can be
compared with the original's. Every default marked *ours* is a choice that neither the
AutoCost paper nor Safety Gym settles.
"""

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args

from autocost_jax.config.checks import (
    CORNERS,
    COUNT,
    FINITE,
    NOT_NEGATIVE,
    OBJECTS,
    POSITIVE,
    POSITIVE_OR_NONE,
    SWITCH,
    check_fields,
    one_of,
    require,
    setting,
)

TaskName = Literal["Goal", "Push"]
Robot = Literal["Point", "Car", "Doggo"]
Physics = Literal["reduced", "full", "closed_form"]
LIDAR_BINS = 8  # the paper's constraint lidar: the intrinsic network's input


@dataclass(frozen=True)
class EnvConfig:
    """One Safety Gym world; lengths in metres, names as in Safety Gym's engine.

    The default is the paper's training environment, Goal-Hazard-Point. The paper does
    not state counts, radii, extents and keepouts: they are engine defaults where Safety
    Gym has one, and 4 hazards as in the configurations that its authors' lab published
    before it (ISSA 2021, Safety Index Synthesis 2022). Later ones of that lab (GUARD)
    have 8, the crowded `Goal-Hazard8-*`. `env_config` has all the others.

    `physics` "full" has Safety Gym's geoms at condim 6 (pillars as capsules, which MJX
    needs), "reduced" the same masses; `envs/physics/models.py` lists its contacts.
    "closed_form" has a Point's equations of motion in place of MJX: the same numbers,
    faster.
    """

    task: TaskName = setting("Goal", one_of(TaskName), "what earns reward")
    robot: Robot = setting("Point", one_of(Robot), "who acts")
    physics: Physics = setting(
        "reduced",
        one_of(Physics),
        "model of the world: full has every geom of Safety Gym, reduced fewer and "
        "simpler contacts, closed_form none, for a Point that nothing can touch",
    )
    num_steps: int = setting(1000, COUNT, "steps of an episode")
    frameskip_binom_n: int = setting(10, COUNT, "physics steps of an action")
    placements_extents: tuple[float, float, float, float] = setting(
        (-2.0, -2.0, 2.0, 2.0), CORNERS, "xmin, ymin, xmax, ymax of the arena"
    )
    placements_margin: float = setting(0.0, NOT_NEGATIVE, "gap between two keepouts")
    robot_keepout: float = setting(0.4, POSITIVE, "free radius of the robot")
    goal_size: float = setting(0.3, POSITIVE, "radius")
    goal_keepout: float = setting(0.4, POSITIVE, "free radius")
    box_size: float = setting(0.2, POSITIVE, "half width")
    box_keepout: float = setting(
        0.425, POSITIVE, "free radius; ours: the box's reach; Safety Gym's 0.2 overlaps"
    )
    box_density: float = setting(0.001, POSITIVE, "mass per volume")
    box_null_dist: float = setting(
        0.0, NOT_NEGATIVE, "box sizes; nearer than that nearing it earns nothing"
    )
    hazards_num: int = setting(4, OBJECTS, "how many; ours, Safety Gym has none")
    hazards_size: float = setting(0.3, POSITIVE, "radius")
    hazards_keepout: float = setting(0.4, POSITIVE, "free radius")
    hazards_cost: float = setting(1.0, FINITE, "cost of a step per metre inside")
    observe_hazards: bool = setting(True, SWITCH, "by a lidar")
    constrain_hazards: bool = setting(True, SWITCH, "whether they cost")
    pillars_num: int = setting(0, OBJECTS, "how many")
    pillars_size: float = setting(0.2, POSITIVE, "radius")
    pillars_height: float = setting(0.5, POSITIVE, "half height")
    pillars_keepout: float = setting(0.3, POSITIVE, "free radius")
    pillars_cost: float = setting(1.0, FINITE, "cost of a step in contact")
    observe_pillars: bool = setting(False, SWITCH, "by a lidar")
    constrain_pillars: bool = setting(False, SWITCH, "whether contact costs")
    vases_num: int = setting(0, OBJECTS, "how many")
    vases_size: float = setting(0.1, POSITIVE, "half width")
    vases_density: float = setting(0.001, POSITIVE, "mass per volume")
    vases_sink: float = setting(4e-5, NOT_NEGATIVE, "depth in the floor at first")
    vases_keepout: float = setting(0.15, POSITIVE, "free radius")
    vases_contact_cost: float = setting(1.0, FINITE, "of each contact in a step")
    vases_velocity_cost: float = setting(1.0, FINITE, "of a step per m/s of a vase")
    vases_velocity_threshold: float = setting(
        1e-4, NOT_NEGATIVE, "m/s from which a vase counts as moving"
    )
    observe_vases: bool = setting(False, SWITCH, "by a lidar")
    constrain_vases: bool = setting(False, SWITCH, "whether they cost")
    constrain_indicator: bool = setting(
        False, SWITCH, "a step costs 1 wherever it costs at all"
    )
    lidar_num_bins: int = setting(LIDAR_BINS, COUNT, "directions of each lidar")
    lidar_max_dist: float | None = setting(
        None, POSITIVE_OR_NONE, "range of a linear lidar; null: it falls exponentially"
    )
    lidar_exp_gain: float = setting(
        1.0, POSITIVE, "of the exponential: exp(-gain x distance)"
    )
    lidar_alias: bool = setting(True, SWITCH, "bins beside a target's read it, too")
    reward_distance: float = setting(1.0, FINITE, "per metre nearer to the goal")
    reward_box_dist: float = setting(1.0, FINITE, "per metre nearer to the box")
    reward_box_goal: float = setting(
        1.0, FINITE, "per metre that the box is nearer to the goal"
    )
    reward_goal: float = setting(1.0, FINITE, "of meeting the goal")
    reward_clip: float = setting(10.0, POSITIVE, "largest reward of a step, either way")

    def __post_init__(self) -> None:
        check_fields(self)
        require(
            self.physics != "closed_form" or self.has_closed_form,
            "physics",
            "reduced or full where the robot is no Point or can touch something",
            self.physics,
        )
        require(
            len(self.constrained) > 0,
            "constrain_hazards, constrain_pillars, constrain_vases",
            "true for at least one kind of which there is an object",
            self.constrained,
        )
        corners, wide = self.placements_extents, 2 * max(self.keepouts)
        require(
            all(corners[i + 2] - corners[i] > wide for i in range(2)),
            "placements_extents",
            f"(xmin, ymin, xmax, ymax), more than {wide} m wide and high",
            corners,
        )

    @property
    def has_closed_form(self) -> bool:
        """Whether the robot is a Point that nothing can touch."""
        is_free = self.task == "Goal" and not (self.pillars_num or self.vases_num)
        return self.robot == "Point" and is_free

    @property
    def constrained(self) -> tuple[str, ...]:
        """The kinds of object that cost something, out of hazards, vases, pillars."""
        return tuple(
            kind
            for kind in ("hazards", "vases", "pillars")
            if getattr(self, f"constrain_{kind}") and getattr(self, f"{kind}_num")
        )

    @property
    def keepouts(self) -> tuple[float, ...]:
        """Keepout of each object in placement order.

        Robot, goal, box (Push only), hazards, vases, pillars, as in Safety Gym.
        """
        box = (self.box_keepout,) if self.task == "Push" else ()
        return (
            self.robot_keepout,
            self.goal_keepout,
            *box,
            *[self.hazards_keepout] * self.hazards_num,
            *[self.vases_keepout] * self.vases_num,
            *[self.pillars_keepout] * self.pillars_num,
        )

    @property
    def name(self) -> str:
        """The world's name, whatever its episode length and collision model.

        That of `env_config` for the worlds it knows. Any other is called
        `{task}-{kind and number of what costs}-{robot}-custom`, such as
        "Goal-Hazard6-Point-custom".
        """
        plain = dataclasses.replace(
            self, num_steps=EnvConfig.num_steps, physics=EnvConfig.physics
        )
        for name, known in {**ENVS, **SUITE}.items():
            if plain == known:
                return name
        kinds = "+".join(
            f"{kind.capitalize()[:-1]}{getattr(self, f'{kind}_num')}"
            for kind in self.constrained
        )
        return f"{self.task}-{kinds}-{self.robot}-custom"


def _paper_env(task: TaskName, constraint: str, robot: Robot) -> EnvConfig:
    """One of the paper's twelve: counts and sizes are ours, see `EnvConfig`."""
    config = EnvConfig(task=task, robot=robot)
    if task == "Push":
        config = dataclasses.replace(config, **_box(robot))
    if constraint == "Pillar":
        config = dataclasses.replace(
            config,
            hazards_num=0,
            observe_hazards=False,
            constrain_hazards=False,
            pillars_num=4,
            observe_pillars=True,
            constrain_pillars=True,
        )
    return config


def _box(robot: Robot) -> dict[str, float]:
    """Safety Gym gives the Car a smaller and lighter box."""
    if robot != "Car":
        return {}
    return {"box_size": 0.125, "box_density": 0.0005, "box_keepout": 0.27}


def _suite_env(robot: Robot, task: TaskName, level: int) -> EnvConfig:
    """A benchmark of Safety Gym's own suite.

    Source: openai/safety-gym suite.py.
    """
    extent = 1.5 if level == 1 else 2.0
    config = EnvConfig(
        task=task,
        robot=robot,
        placements_extents=(-extent, -extent, extent, extent),
        constrain_indicator=True,
        lidar_num_bins=16,
        lidar_max_dist=3.0,
    )
    if task == "Goal":
        return dataclasses.replace(
            config,
            goal_keepout=0.305,
            hazards_num=8 if level == 1 else 10,
            hazards_size=0.2,
            hazards_keepout=0.18,
            vases_num=1 if level == 1 else 10,
            observe_vases=True,
            constrain_vases=level == 2,
        )
    box = {"box_keepout": 0.2, **_box(robot)}
    if robot == "Car":
        box["box_keepout"] = 0.125
    return dataclasses.replace(
        config,
        **box,
        hazards_num=2 if level == 1 else 4,
        pillars_num=1 if level == 1 else 4,
        observe_pillars=True,
        constrain_pillars=level == 2,
    )


ENVS: dict[str, EnvConfig] = {
    f"{task}-{constraint}-{robot}": _paper_env(task, constraint, robot)
    for task in get_args(TaskName)
    for constraint in ("Hazard", "Pillar")
    for robot in get_args(Robot)
} | {
    f"Goal-Hazard8-{robot}": EnvConfig(robot=robot, hazards_num=8)
    for robot in get_args(Robot)
}
SUITE: dict[str, EnvConfig] = {
    f"{robot}{task}{level}": _suite_env(robot, task, level)
    for robot in get_args(Robot)
    for task in get_args(TaskName)
    for level in (1, 2)
}


def env_config(name: str) -> EnvConfig:
    """The configuration of a world by its name.

    Args:
      name: such as "Push-Pillar-Car", "Goal-Hazard8-Point" for the crowded variant, or
        "CarPush2" for Safety Gym's own.

    Raises:
      ValueError: if there is no such world; the message lists those that exist.
    """
    known = {**ENVS, **SUITE}
    if name not in known:
        raise ValueError(f"unknown environment {name!r}; known: {', '.join(known)}")
    return known[name]
