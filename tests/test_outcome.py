"""Whether a search succeeded, and how that is said."""

import dataclasses

import numpy as np
import pytest

from autocost_jax.outcome import (
    Scores,
    conclusion,
    pick,
    reference_places,
    row_of,
    succeeded,
    summary_rows,
    table_lines,
)
from autocost_jax.presets import preset

CONFIG = dataclasses.replace(preset("laptop"), num_finalists=3)


def make_scores(ep_return, violations, outside=0.0):
    """Of three finalists and two references, [A, C] -> two seeds around it."""
    spread = np.array([-0.1, 0.1])
    ep_return = np.asarray(ep_return, float)[..., None] + spread
    rate = np.repeat(np.asarray(violations, float)[..., None], 2, axis=-1)
    return Scores(
        ep_return=ep_return,
        ep_cost=2 * rate,
        violation_rate=rate,
        outside_share=np.full(rate.shape, outside),
        recordings=[],
    )


GOOD = make_scores(
    [[1.0, 5.0, 6.0, 10.0, 2.0], [8.0, 7.0, 9.0, 20.0, 5.0]],
    [[0.0, 0.02, 0.2, 0.6, 0.0], [0.0, 0.1, 0.1, 0.7, 0.2]],
)


def test_the_pick_is_the_one_closest_to_success():
    """The first keeps a tenth of the return with PPO-Lagrangian: it is of no use.

    The third violates in 20 % of the episodes with it, a third of the reference's.
    """
    assert pick(CONFIG, GOOD) == 1


def test_of_several_that_succeed_the_safest_is_picked():
    scores = make_scores(
        [[9.0, 5.0, 6.0, 10.0, 2.0], [15.0, 7.0, 9.0, 20.0, 5.0]],
        [[0.1, 0.02, 0.05, 0.6, 0.0], [0.1, 0.1, 0.1, 0.7, 0.2]],
    )
    assert pick(CONFIG, scores) == 1


def test_without_a_success_the_shortfalls_add_up():
    """An agent that flees is far off, however safe it is."""
    scores = make_scores(
        [[-9.0, 2.5, 2.0, 10.0, 2.0], [9.0, 9.0, 9.0, 20.0, 5.0]],
        [[0.0, 0.2, 0.2, 0.6, 0.0], [0.0, 0.2, 0.2, 0.7, 0.2]],
    )
    assert pick(CONFIG, scores) == 1


def test_a_finalist_without_a_valid_episode_is_never_picked():
    scores = make_scores(
        [[np.nan, 5.0, 6.0, 10.0, 2.0], [8.0, 7.0, 9.0, 20.0, 5.0]],
        [[np.nan, 0.5, 0.6, 0.6, 0.0], [0.0, 0.5, 0.6, 0.7, 0.2]],
    )
    assert pick(CONFIG, scores) == 1


def test_the_rows_of_the_summary():
    rows = summary_rows(CONFIG, GOOD, 1, 100)
    assert [(row["algorithm"], row["cost"]) for row in rows] == [
        (name, cost)
        for name in ("ppo_lagrangian", "cpo")
        for cost in ("extrinsic", "safety_margin_3x", "best")
    ]
    best = row_of(rows, "cpo", "best")
    assert (best["return"], best["violation_rate"]) == (7.0, 0.1)
    assert (best["ep_cost"], best["seeds"], best["episodes"]) == (0.2, 2, 100)
    assert best["by_seed"]["return"] == pytest.approx([6.9, 7.1])
    assert row_of(rows, "ppo_lagrangian", "safety_margin_3x")["return"] == 2.0


def test_success_needs_both_algorithms():
    assert succeeded(summary_rows(CONFIG, GOOD, 1, 100))
    assert not succeeded(summary_rows(CONFIG, GOOD, 0, 100))  # of no use with one
    assert not succeeded(summary_rows(CONFIG, GOOD, 2, 100))  # unsafe with one


def test_the_conclusion_says_at_which_price():
    text = conclusion(summary_rows(CONFIG, GOOD, 1, 100), 1000)
    assert text.startswith("The search succeeded: with PPO-Lagrangian 2% of the")
    assert "in place of 60%, at a return of 5.0 in place of 10.0" in text
    failed = conclusion(summary_rows(CONFIG, GOOD, 2, 100), 1000)
    assert failed.startswith("The search did not succeed")
    assert "flee" not in failed


def test_agents_that_flee_are_called_so():
    scores = make_scores(
        [[-19.0, 0, 0, 10.0, 2.0], [-15.0, 0, 0, 20.0, 5.0]],
        [[0.45, 1, 1, 0.6, 0.0], [0.4, 1, 1, 0.7, 0.2]],
        outside=0.9,
    )
    text = conclusion(summary_rows(CONFIG, scores, 0, 100), 1000)
    assert "did not succeed" in text
    assert "these agents flee the arena" in text


def test_short_episodes_judge_nothing():
    safe = make_scores(np.full((2, 5), 1.0), np.zeros((2, 5)))
    rows = summary_rows(CONFIG, safe, 0, 100)
    assert not succeeded(rows)  # though nothing violates at the full return
    text = conclusion(rows, 50)
    assert "50 steps" in text
    assert "too short to judge safety" in text


def test_without_references_success_is_not_judged():
    config = dataclasses.replace(preset("paper"), num_finalists=0)
    assert reference_places(config) == {}
    scores = Scores(*[np.ones((2, 1, 1))] * 4, recordings=[])
    assert pick(config, scores) == 0
    rows = summary_rows(config, scores, 0, 100)
    assert [row["cost"] for row in rows] == ["best", "best"]
    assert "not judged" in conclusion(rows, 1000)
    assert len(table_lines(rows)) == 1


def test_the_table_for_people():
    lines = table_lines(summary_rows(CONFIG, GOOD, 1, 100))
    assert [line.split("  ")[0] for line in lines] == [
        "extrinsic cost alone",
        "3x margin by hand",
        "best cost found",
    ]
    assert "PPO-Lagrangian return  10.0  violating  60%" in lines[0]
    assert "CPO            return   7.0  violating  10%" in lines[2]
    assert lines[-1].endswith("(2 fresh seeds x 100 episodes)")
