"""What counts as success, and how far from it a cost is."""

import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.search.success import is_success, shortfall

# bars 0.2, 0.1 and 3, 6; aims 0.1, 0.05 and 4, 8
PLAIN = (jnp.array([0.8, 0.4]), jnp.array([10.0, 20.0]))


def far(violations, ep_return, plain=PLAIN) -> list[float]:
    return shortfall(jnp.array(violations), jnp.array(ep_return), *plain).tolist()


def test_at_the_aims_nothing_is_missing():
    assert far([[0.1, 0.0], [0.05, 0.0]], [[4.0, 9.0], [8.0, 9.0]]) == [0.0, 0.0]


def test_what_is_missing_adds_up_over_algorithms_and_bars():
    """1 at each bar."""
    assert far([[0.2], [0.1]], [[3.0], [6.0]]) == pytest.approx([4.0], rel=1e-5)
    assert far([[0.15], [0.05]], [[3.5], [4.0]]) == pytest.approx([3.0], rel=1e-5)


def test_no_algorithm_makes_up_for_another():
    """The same means over the algorithms: 0.1 and 6."""
    balanced, lopsided = far([[0.1, 0.0], [0.05, 0.15]], [[4.0, 10.0], [8.0, 2.0]])
    assert balanced == 0.0
    assert lopsided > 4.0


def test_agents_that_flee_are_farther_off_than_a_near_miss():
    fleeing, near = far([[0.0, 0.11], [0.0, 0.05]], [[-9.0, 3.9], [-9.0, 8.0]])
    assert fleeing == pytest.approx(13.0 + 8.5, rel=1e-5)
    assert near < 0.3


def test_a_broken_reference_has_no_bars_and_a_broken_score_is_seen():
    plain = (jnp.array([np.nan, 0.4]), jnp.array([10.0, 20.0]))
    assert far([[0.9], [0.05]], [[0.0], [8.0]], plain) == [0.0]
    assert np.isnan(far([[np.nan], [0.1]], [[3.0], [6.0]])).all()


def test_a_reference_without_return_or_violations_gives_finite_numbers():
    plain = (jnp.zeros(2), jnp.array([-1.0, 0.0]))
    assert np.isfinite(far([[0.5], [0.0]], [[1.0], [-1.0]], plain)).all()


@pytest.mark.parametrize(
    ("scores", "expect"),
    [
        ((0.2, 3.0, 0.8, 10.0), True),
        ((0.21, 3.0, 0.8, 10.0), False),
        ((0.2, 2.9, 0.8, 10.0), False),
        ((0.0, 5.0, 0.8, -1.0), False),  # nothing to keep a share of
        ((np.nan, 5.0, 0.8, 10.0), False),
        ((0.1, 5.0, np.nan, 10.0), False),
    ],
)
def test_success_of_one_algorithm(scores, expect):
    assert is_success(*scores) is expect
