"""Configuration of the worlds: this project's own and Safety Gym's suite.

`EnvConfig` keeps Safety Gym's keys letter for letter, so that a configuration can be
compared with the original's. Every default marked *ours* is a choice that neither the
AutoCost paper nor Safety Gym settles.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, get_args

from autocost_jax.config.checks import (
    is_finite,
    is_integer,
    require,
    require_counts,
    require_finite,
    require_positive,
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

    `physics` chooses the model: "full" has Safety Gym's geoms at condim 6 (pillars as
    capsules, which MJX needs), "reduced" fewer and simpler contacts with the same
    masses; `envs/physics/models.py` lists them. "closed_form" is for a Point that
    nothing can touch, with its equations of motion in place of MJX: the same numbers,
    faster.
    """

    task: TaskName = "Goal"
    robot: Robot = "Point"
    physics: Physics = "reduced"
    num_steps: int = 1000
    frameskip_binom_n: int = 10
    placements_extents: tuple[float, float, float, float] = (-2.0, -2.0, 2.0, 2.0)
    placements_margin: float = 0.0
    robot_keepout: float = 0.4
    goal_size: float = 0.3
    goal_keepout: float = 0.4
    box_size: float = 0.2
    box_keepout: float = 0.425  # ours: the box's reach; Safety Gym's 0.2 overlaps
    box_density: float = 0.001
    box_null_dist: float = 0.0
    hazards_num: int = 4
    hazards_size: float = 0.3
    hazards_keepout: float = 0.4
    hazards_cost: float = 1.0
    observe_hazards: bool = True
    constrain_hazards: bool = True
    pillars_num: int = 0
    pillars_size: float = 0.2
    pillars_height: float = 0.5
    pillars_keepout: float = 0.3
    pillars_cost: float = 1.0
    observe_pillars: bool = False
    constrain_pillars: bool = False
    vases_num: int = 0
    vases_size: float = 0.1
    vases_density: float = 0.001
    vases_sink: float = 4e-5
    vases_keepout: float = 0.15
    vases_contact_cost: float = 1.0
    vases_velocity_cost: float = 1.0
    vases_velocity_threshold: float = 1e-4
    observe_vases: bool = False
    constrain_vases: bool = False
    constrain_indicator: bool = False
    lidar_num_bins: int = LIDAR_BINS
    lidar_max_dist: float | None = None
    lidar_exp_gain: float = 1.0
    lidar_alias: bool = True
    reward_distance: float = 1.0
    reward_box_dist: float = 1.0
    reward_box_goal: float = 1.0
    reward_goal: float = 1.0
    reward_clip: float = 10.0

    def __post_init__(self) -> None:
        for name, kind in (("task", TaskName), ("robot", Robot), ("physics", Physics)):
            value, allowed = getattr(self, name), get_args(kind)
            require(value in allowed, name, f"one of {', '.join(allowed)}", value)
        require_counts(self, "num_steps", "frameskip_binom_n", "lidar_num_bins")
        require(
            self.physics != "closed_form" or self.has_closed_form,
            "physics",
            "reduced or full where the robot is no Point or can touch something",
            self.physics,
        )
        for name in _NUMBERS:
            value = getattr(self, name)
            require(is_integer(value) and value >= 0, name, "an integer >= 0", value)
        for name in _SWITCHES:
            value = getattr(self, name)
            require(isinstance(value, bool), name, "true or false", value)
        require_finite(self, *_FINITE)
        for name in _NOT_NEGATIVE:
            value = getattr(self, name)
            require(is_finite(value) and value >= 0, name, "finite and >= 0", value)
        require_positive(self, *_POSITIVE)
        if self.lidar_max_dist is not None:
            require_positive(self, "lidar_max_dist")
        require(
            len(self.constrained) > 0,
            "constrain_hazards, constrain_pillars, constrain_vases",
            "true for at least one kind of which there is an object",
            self.constrained,
        )
        corners, wide = self.placements_extents, 2 * max(self.keepouts)
        require(
            len(corners) == 4
            and all(wide < corners[i + 2] - corners[i] < math.inf for i in range(2)),
            "placements_extents",
            f"(xmin, ymin, xmax, ymax), finite, more than {wide} m wide and high",
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


_NUMBERS = ("hazards_num", "pillars_num", "vases_num")
_SWITCHES = (
    "observe_hazards",
    "constrain_hazards",
    "observe_pillars",
    "constrain_pillars",
    "observe_vases",
    "constrain_vases",
    "constrain_indicator",
    "lidar_alias",
)
_FINITE = (
    "hazards_cost",
    "pillars_cost",
    "vases_contact_cost",
    "vases_velocity_cost",
    "reward_distance",
    "reward_box_dist",
    "reward_box_goal",
    "reward_goal",
)
_NOT_NEGATIVE = (
    "placements_margin",
    "box_null_dist",
    "vases_sink",
    "vases_velocity_threshold",
)
_POSITIVE = (
    "goal_size",
    "goal_keepout",
    "robot_keepout",
    "box_size",
    "box_keepout",
    "box_density",
    "hazards_size",
    "hazards_keepout",
    "pillars_size",
    "pillars_height",
    "pillars_keepout",
    "vases_size",
    "vases_density",
    "vases_keepout",
    "lidar_exp_gain",
    "reward_clip",
)


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
