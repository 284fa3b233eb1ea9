"""Every bad value is refused before anything is traced, in one line naming it."""

import dataclasses
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from autocost_jax.config import (
    PRESETS,
    AgentConfig,
    EnvConfig,
    SearchConfig,
    TrainConfig,
    preset,
)
from autocost_jax.config.checks import help_texts

NAN, INF = float("nan"), float("inf")
LOST = (1e39, 1e-46, 10**400)  # infinity and 0 in float32, and no float at all
COUNT = (0, -1, 1.5, NAN, "3", True, None, 2**31, 10**25)
NUMBER = COUNT[1:]
POSITIVE = (0.0, -1.0, NAN, INF, "1", True, (), *LOST)
FINITE = (NAN, INF, -INF, "1", None, *LOST)
NOT_NEGATIVE = (-1e-6, NAN, INF, None, *LOST)

BAD = {
    EnvConfig: {
        "task": ("Fly", "", None, ["Goal"]),
        "robot": ("Submarine",),
        "physics": ("exact",),
        **dict.fromkeys(("num_steps", "frameskip_binom_n", "lidar_num_bins"), COUNT),
        **dict.fromkeys(("hazards_num", "pillars_num", "vases_num"), (*NUMBER, 1001)),
        **dict.fromkeys(
            (
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
                "lidar_max_dist",
                "reward_clip",
            ),
            POSITIVE,
        ),
        **dict.fromkeys(
            (
                "hazards_cost",
                "pillars_cost",
                "vases_contact_cost",
                "vases_velocity_cost",
                "reward_distance",
                "reward_box_dist",
                "reward_box_goal",
                "reward_goal",
            ),
            FINITE,
        ),
        **dict.fromkeys(
            (
                "placements_margin",
                "box_null_dist",
                "vases_sink",
                "vases_velocity_threshold",
            ),
            NOT_NEGATIVE,
        ),
        **dict.fromkeys(
            (
                "observe_hazards",
                "constrain_hazards",
                "observe_pillars",
                "constrain_pillars",
                "observe_vases",
                "constrain_vases",
                "constrain_indicator",
                "lidar_alias",
            ),
            ("no", 1, None),
        ),
        "placements_extents": (
            (0.0, 0.0, 0.1, 4.0),
            (2.0, 2.0, -2.0, -2.0),
            (-2.0, NAN, 2.0, 2.0),
            (-2.0, -2.0, INF, 2.0),
            (-2.0, -2.0, 2.0),
            [-2.0, -2.0, 2.0, 2.0],
            None,
        ),
    },
    AgentConfig: {
        "hidden_sizes": ((0,), (64, -1), (8.0,), [64, 64], 64, None),
        "log_std_init": FINITE,
        "gamma": (0.0, 1.01, NAN),
        "cost_gamma": (-0.5, 2.0, NAN),
        "gae_lambda": (-0.01, 1.01, NAN),
        "cost_gae_lambda": (-1.0, 1.01, NAN),
        "policy_lr": POSITIVE,
        "value_lr": POSITIVE,
        "clip_eps": POSITIVE,
        "target_kl": POSITIVE,
        "kl_stop_factor": POSITIVE,
        "multiplier_init": POSITIVE,
        "multiplier_lr": POSITIVE,
        "cg_damping": POSITIVE,
        "violation_factor": POSITIVE,
        "policy_output_scale": POSITIVE,
        "policy_passes": COUNT,
        "policy_minibatches": COUNT,
        "value_passes": COUNT,
        "value_minibatches": COUNT,
        "critic_precision": ("float16", "", 32),
        "normalize_obs": (1, "yes"),
        "cg_iterations": COUNT,
        "backtrack_steps": COUNT,
        "backtrack_ratio": (0.0, 1.0, -0.5, NAN),
    },
    TrainConfig: {
        "num_worlds": COUNT,
        "segments_per_episode": (*COUNT, 3),  # does not divide 1000 steps
        "num_epochs": COUNT,
        "chunk_epochs": (*COUNT, 2),  # does not divide 333 epochs
        "population_chunk": (-1, 0.5),
    },
    SearchConfig: {
        "seed": (-1, 2**32, 10**25, 0.5, True, "0", None),
        "algorithms": ((), ("ppo",), ("cpo", "cpo"), ["cpo"], ([],), 3, None),
        "cost_limit": FINITE,
        "population_size": COUNT,
        "num_elites": (*COUNT, 51),
        "num_stages": COUNT,
        "fitness_epochs": (*COUNT, 112),  # more than a third of 333 epochs
        "init_std": POSITIVE,
        "mutation_std": POSITIVE,
        "mutation_low": POSITIVE,
        "mutation_high": (0.4, NAN, INF),  # 0.4 is below mutation_low
        "zero_tolerance": NOT_NEGATIVE,
        "selection": ("best", ""),
        "start": ("uniform", ""),
        "network": ("wide", ""),
        "seeds_per_candidate": COUNT,
        "references": (1, "yes"),
        "judge_by": ("best", "", "success"),  # success needs references
        "pool_scores": (1, "yes"),
        "num_finalists": (*NUMBER, 51),
        "final_seeds": COUNT,
        "final_epochs": NUMBER,
    },
}


def test_bad_values_are_refused_by_name():
    for kind, fields in BAD.items():
        for name, values in fields.items():
            for value in values:
                expected = rf"^{name} must be .*, got "
                with pytest.raises(ValueError, match=expected) as caught:
                    kind(**{name: value})
                assert "\n" not in str(caught.value)


def test_a_config_within_another_is_of_its_class():
    nested: Any = (
        (TrainConfig, "env"), (TrainConfig, "agent"), (SearchConfig, "train"),
    )  # fmt: skip
    for kind, name in nested:
        for value in (None, {}, AgentConfig):
            with pytest.raises(ValueError, match=f"^{name} must be of "):
                kind(**{name: value})


@pytest.mark.parametrize("kind", BAD)
def test_every_field_has_a_bad_value_above(kind):
    nested = {"env", "agent", "train"}  # checked by their own classes
    fields = {field.name for field in dataclasses.fields(kind)} - nested
    assert fields == set(BAD[kind])


def test_every_setting_says_in_one_line_what_it_is_for():
    texts = help_texts(SearchConfig)
    nested = {"env", "agent", "train"}
    assert set(texts) == {name for fields in BAD.values() for name in fields} - nested
    assert all(text and "\n" not in text for text in texts.values())


@pytest.mark.parametrize("name", ["policy_minibatches", "value_minibatches"])
def test_minibatches_must_divide_the_rows_of_an_epoch(name):
    agent = dataclasses.replace(AgentConfig(), **{name: 7})
    with pytest.raises(ValueError, match=f"{name} must be a divisor of .* 30000"):
        TrainConfig(agent=agent)
    assert TrainConfig(agent=agent, num_worlds=7).agent is agent


def test_numpy_integers_are_integers():
    assert SearchConfig(population_size=np.int64(20)).population_size == 20  # pyright: ignore


def test_configs_are_frozen_and_hashable():
    assert hash(SearchConfig()) == hash(SearchConfig())
    with pytest.raises(dataclasses.FrozenInstanceError):
        SearchConfig().seed = 1  # pyright: ignore


def test_an_epoch_of_segments_is_a_part_of_an_episode():
    assert TrainConfig().epoch_steps == 1000
    assert TrainConfig(segments_per_episode=4).epoch_steps == 250


def sizes(config: SearchConfig) -> dict[str, object]:
    train, agent = config.train, config.train.agent
    return {
        "candidates": config.population_size,
        "elites": config.num_elites,
        "stages": config.num_stages,
        "init_std": config.init_std,
        "worlds": train.num_worlds,
        "steps": train.env.num_steps,
        "nets": agent.hidden_sizes,
        "policy": (agent.policy_passes, agent.policy_minibatches),
        "value": (agent.value_passes, agent.value_minibatches),
    }


# The table of sizes: what each preset promises.
PROMISED = {
    "laptop": {
        "candidates": 19,
        "elites": 3,
        "stages": 2,
        "init_std": 8.0,
        "worlds": 8,
        "steps": 1000,
        "nets": (32, 32),
        "policy": (4, 8),
        "value": (3, 8),
    },
    "search": {
        "candidates": 50,
        "elites": 5,
        "stages": 4,
        "worlds": 8,
        "steps": 1000,
        "nets": (32, 32),
    },
    "paper": {
        "candidates": 50,
        "elites": 5,
        "stages": 7,
        "init_std": 1.0,
        "worlds": 30,
        "steps": 1000,
        "nets": (256, 256),
        "policy": (80, 1),
        "value": (80, 1),
    },
    "smoke": {
        "candidates": 4,
        "elites": 1,
        "stages": 2,
        "worlds": 2,
        "steps": 50,
        "nets": (16, 16),
    },
}
EPOCHS = {"laptop": 24, "search": 64, "paper": 333, "smoke": 2}
FITNESS_EPOCHS = {"laptop": 8, "search": 16, "paper": 10, "smoke": 1}


@pytest.mark.parametrize("name", PROMISED)
def test_presets_have_the_promised_sizes(name):
    config = preset(name)
    got = sizes(config)
    assert {key: got[key] for key in PROMISED[name]} == PROMISED[name]
    assert config.fitness_epochs == FITNESS_EPOCHS[name]
    assert config.algorithms == ("ppo_lagrangian", "cpo")
    assert config.cost_limit == 0.0
    assert config.train.num_epochs == EPOCHS[name]


def test_the_paper_preset_keeps_the_papers_hyperparameters():
    agent = preset("paper").train.agent
    assert agent == AgentConfig()
    assert (agent.policy_lr, agent.value_lr, agent.clip_eps) == (4e-4, 1e-3, 0.2)
    assert (agent.target_kl, agent.cg_damping, agent.backtrack_steps) == (0.01, 0.1, 10)
    assert (agent.gamma, agent.gae_lambda) == (0.99, 0.97)
    # 7 stages x 50 candidates x 2 algorithms x 333 epochs x 30 000 steps
    assert preset("paper").env_steps == 7 * 50 * 2 * 333 * 30_000


def test_the_paper_preset_has_none_of_our_options():
    config = preset("paper")
    assert config == SearchConfig(
        train=dataclasses.replace(TrainConfig(), chunk_epochs=3)
    )
    assert config.start == "normal"
    assert (config.references, config.pool_scores) == (False, False)
    assert (config.judge_by, config.num_finalists) == ("cost", 0)
    assert config.slots_per_algorithm == config.population_size
    assert config.total_stages == config.num_stages


def test_the_finalists_train_in_the_slots_of_a_stage():
    config = SearchConfig(
        population_size=4, num_elites=1, references=True, num_finalists=2
    )
    assert config.slots_per_algorithm == (2 + 2) * 3  # more than the (4 + 2) of a stage
    more = dataclasses.replace(config, seeds_per_candidate=3)
    assert more.slots_per_algorithm == (4 + 2) * 3
    assert [more.epochs_of(stage) for stage in range(8)] == [333] * 8
    longer = dataclasses.replace(more, final_epochs=400)
    assert [longer.epochs_of(stage) for stage in (6, 7)] == [333, 400]
    assert longer.env_steps == (7 * 333 + 400) * 18 * 2 * 30_000


def test_an_unknown_preset_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="unknown preset 'nope'") as caught:
        preset("nope")
    assert set(PRESETS) == set(PROMISED)
    assert all(name in str(caught.value) for name in PRESETS)


NO_BACKEND = """
from jax._src import xla_bridge
from autocost_jax.runs.sweep import Method, SweepConfig
from autocost_jax.config import PRESETS
from autocost_jax.runs.config_files import from_dict, to_dict
theta = tuple([0.0] * 41)
methods = (Method("a", "cpo", "extrinsic+intrinsic", 0.0, theta),)
table = SweepConfig(train=PRESETS["smoke"].train, methods=methods)
for config in (table, *PRESETS.values()):
    assert from_dict(type(config), to_dict(config)) == config
assert not xla_bridge.backends_are_initialized()
"""


def test_reading_a_config_does_not_start_jax():
    """The processes of one run meet before anything of JAX has run."""
    subprocess.run([sys.executable, "-c", NO_BACKEND], check=True, timeout=120)
