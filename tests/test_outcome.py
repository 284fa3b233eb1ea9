"""Whether a search succeeded, and how that is said."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autocost_jax.config import preset
from autocost_jax.runs.outcome import (
    Scores,
    compared,
    conclusion,
    finalist_rows,
    last_scores,
    pick,
    row_of,
    succeeded,
    summary_rows,
    table_lines,
)

CONFIG = dataclasses.replace(preset("laptop"), num_finalists=3)


def finalists(ep_return, violations):
    """Of three finalists and two references, [A, C] -> two seeds around it."""
    spread = np.array([-0.1, 0.1])
    ep_return = np.asarray(ep_return, float)[..., None] + spread
    return ep_return, np.repeat(np.asarray(violations, float)[..., None], 2, axis=-1)


def make_rows(ep_return: Any, violations: Any, outside: float = 0.0):
    """The summary of the best cost and two references, [A, 3]."""
    ep_return, rate = finalists(ep_return, violations)
    scores = Scores(
        ep_return, 2 * rate, rate, np.full(rate.shape, outside), recordings=[]
    )
    return summary_rows(CONFIG, scores, 100)


PLAIN = [[10.0, 2.0], [20.0, 5.0]], [[0.6, 0.0], [0.7, 0.2]]  # the references


def beside(ep_return, violations) -> Any:
    """One cost's scores [A] in front of the references."""
    return [
        [[one, *plain] for one, plain in zip(ones, plains, strict=True)]
        for ones, plains in zip((ep_return, violations), PLAIN, strict=True)
    ]


GOOD = make_rows(*beside([5.0, 7.0], [0.02, 0.1]))


def test_the_pick_is_the_one_closest_to_success():
    """The first keeps a tenth of the return with PPO-Lagrangian: it is of no use.

    The third violates in 20 % of the episodes with it, a third of the reference's.
    """
    scores = finalists(
        [[1.0, 5.0, 6.0, 10.0, 2.0], [8.0, 7.0, 9.0, 20.0, 5.0]],
        [[0.0, 0.02, 0.2, 0.6, 0.0], [0.0, 0.1, 0.1, 0.7, 0.2]],
    )
    assert pick(CONFIG, *scores) == 1


def test_finalists_are_judged_by_the_last_epochs_of_their_training():
    config = dataclasses.replace(CONFIG, final_seeds=2, population_size=16)
    slots = config.slots_per_algorithm
    after = config.epochs_of(config.num_stages)
    values = np.zeros((after + 5, 2, slots))  # rows behind the end are another stage's
    values[after - config.fitness_epochs : after] = np.arange(slots)
    values[after:] = 99.0
    history: Any = {"ep_return": values, "violating_worlds": -values}
    frozen = np.zeros((2, slots), bool)
    frozen[1, 9] = True  # the second seed of a reference
    learners: Any = [SimpleNamespace(frozen=group) for group in frozen]
    ep_return, violations = last_scores(config, history, learners)
    np.testing.assert_array_equal(ep_return[1, 4], [8, np.nan])
    np.testing.assert_array_equal(ep_return[1, :3], [[0, 1], [2, 3], [4, 5]])
    np.testing.assert_array_equal(violations[0, 3], [-6, -7])
    rows = finalist_rows(config, np.array([16, 2, 31]), ep_return, violations)
    assert [(row["stage"], row["index"]) for row in rows] == [(1, 0), (0, 2), (1, 15)]
    assert rows[1]["cpo"]["return"] == [2, 3]


def test_of_several_that_reach_the_aims_the_safest_is_picked():
    scores = finalists(
        [[9.0, 5.0, 6.0, 10.0, 2.0], [15.0, 8.5, 9.0, 20.0, 5.0]],
        [[0.07, 0.02, 0.05, 0.6, 0.0], [0.08, 0.08, 0.08, 0.7, 0.2]],
    )
    assert pick(CONFIG, *scores) == 1


def test_without_a_success_the_shortfalls_add_up():
    """An agent that flees is far off, however safe it is."""
    scores = finalists(
        [[-9.0, 2.5, 2.0, 10.0, 2.0], [9.0, 9.0, 9.0, 20.0, 5.0]],
        [[0.0, 0.2, 0.2, 0.6, 0.0], [0.0, 0.2, 0.2, 0.7, 0.2]],
    )
    assert pick(CONFIG, *scores) == 1


def test_a_reference_with_a_frozen_seed_still_sets_the_bars():
    ep_return, violations = finalists(
        [[1.0, 5.0, 6.0, 10.0, 2.0], [8.0, 7.0, 9.0, 20.0, 5.0]],
        [[0.0, 0.02, 0.2, 0.6, 0.0], [0.0, 0.1, 0.1, 0.7, 0.2]],
    )
    ep_return[:, 3, 0] = violations[:, 3, 0] = np.nan
    assert pick(CONFIG, ep_return, violations) == 1


def test_of_equally_safe_ones_the_most_useful_is_picked():
    scores = finalists(
        [[5.0, 6.0, 5.0, 10.0, 2.0], [8.5, 9.0, 8.5, 20.0, 5.0]],
        [[0.02, 0.02, 0.02, 0.6, 0.0], [0.08, 0.08, 0.08, 0.7, 0.2]],
    )
    assert pick(CONFIG, *scores) == 1


def test_a_finalist_with_a_frozen_agent_is_never_picked():
    scores = finalists(
        [[np.nan, 5.0, 6.0, 10.0, 2.0], [8.0, 7.0, 9.0, 20.0, 5.0]],
        [[np.nan, 0.5, 0.6, 0.6, 0.0], [0.0, 0.5, 0.6, 0.7, 0.2]],
    )
    assert pick(CONFIG, *scores) == 1


def test_the_rows_of_the_summary():
    assert [(row["algorithm"], row["cost"]) for row in GOOD] == [
        (name, cost)
        for name in ("ppo_lagrangian", "cpo")
        for cost in ("extrinsic", "safety_margin_3x", "best")
    ]
    best = row_of(GOOD, "cpo", "best")
    assert (best["return"], best["violation_rate"]) == (7.0, 0.1)
    assert (best["ep_cost"], best["seeds"], best["episodes"]) == (0.2, 2, 100)
    assert best["by_seed"]["return"] == pytest.approx([6.9, 7.1])
    assert row_of(GOOD, "ppo_lagrangian", "safety_margin_3x")["return"] == 2.0


USELESS = make_rows(*beside([1.0, 8.0], [0.0, 0.0]))
UNSAFE = make_rows(*beside([6.0, 9.0], [0.2, 0.1]))


def test_success_needs_both_algorithms():
    assert succeeded(GOOD)
    assert not succeeded(USELESS)
    assert not succeeded(UNSAFE)


def test_the_conclusion_says_at_which_price():
    text = conclusion(GOOD, 1000)
    assert text.startswith("The search succeeded: with PPO-Lagrangian 2% of the")
    assert "in place of 60%, at a return of 5.0 in place of 10.0" in text
    failed = conclusion(UNSAFE, 1000)
    assert failed.startswith("The search did not succeed")
    assert "flee" not in failed


def test_agents_that_flee_are_called_so():
    rows = make_rows(*beside([-19.0, -15.0], [0.45, 0.4]), outside=0.9)
    text = conclusion(rows, 1000)
    assert "did not succeed" in text
    assert "these agents flee the arena" in text


def test_short_episodes_judge_nothing():
    rows = make_rows(np.full((2, 3), 1.0), np.zeros((2, 3)))
    assert not succeeded(rows)  # though nothing violates at the full return
    text = conclusion(rows, 50)
    assert "50 steps" in text
    assert "too short to judge safety" in text


def test_without_references_success_is_not_judged():
    config = dataclasses.replace(preset("paper"), num_finalists=0)
    assert compared(config) == {"best": 0}
    scores = Scores(*[np.ones((2, 1, 1))] * 4, recordings=[])
    rows = summary_rows(config, scores, 100)
    assert [row["cost"] for row in rows] == ["best", "best"]
    assert "not judged" in conclusion(rows, 1000)
    assert len(table_lines(rows)) == 1


def test_the_table_for_people():
    lines = table_lines(GOOD)
    assert [line.split("  ")[0] for line in lines] == [
        "extrinsic cost alone",
        "3x margin by hand",
        "best cost found",
    ]
    assert "PPO-Lagrangian return  10.0  violating  60%" in lines[0]
    assert "CPO            return   7.0  violating  10%" in lines[2]
    assert lines[-1].endswith("(2 fresh seeds x 100 episodes)")
