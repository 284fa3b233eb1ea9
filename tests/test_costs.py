"""The network of 41 parameters, the bank of terms, and costs in files."""

import json
import math
import os
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.costs import (
    BANK,
    CostTerm,
    cost_card,
    intrinsic_cost,
    list_costs,
    load_cost,
    save_cost,
    total_cost,
    training_cost,
)
from autocost_jax.records import CostInputs

GOLDEN = 1e-6  # the goldens are printed with 7 digits, float32 carries as many
ROUNDING = 1e-6  # float32 against float64 NumPy, values of order 1

THETA = np.array([0.6 * ((7 * i + 3) % 11 - 5) for i in range(41)])
LIDAR = np.array([0, 0.2, 0.9, 0.4, 0, 0, 0, 0.1])


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def reference(theta, lidar):
    """The formula of the paper in NumPy float64, one lidar at a time."""
    w1 = theta[:32].reshape(8, 4)
    hidden = sigmoid(lidar @ w1 + theta[32:36])
    return sigmoid(hidden @ theta[36:40] + theta[40])


@pytest.mark.parametrize(
    ("lidar", "expected"),
    [
        (np.zeros(8), 0.3595359),
        (LIDAR, 0.2230037),
        (np.eye(8)[2], 0.4558284),  # e_3, counted from 1
        (np.ones(8), 0.3534252),
    ],
)
def test_goldens_of_the_network(lidar, expected):
    got = intrinsic_cost(jnp.asarray(THETA), jnp.asarray(lidar))
    assert float(got) == pytest.approx(expected, abs=GOLDEN)


def test_the_first_layer_is_read_as_8_by_4():
    transposed = THETA.copy()
    transposed[:32] = THETA[:32].reshape(4, 8).T.ravel()
    got = intrinsic_cost(jnp.asarray(transposed), jnp.asarray(LIDAR))
    assert float(got) == pytest.approx(0.2282308, abs=GOLDEN)


def test_the_network_against_numpy(key):
    key_theta, key_lidar = jax.random.split(key)
    theta = 3.0 * jax.random.normal(key_theta, (41,))
    lidar = jax.random.uniform(key_lidar, (5, 7, 8))
    got = intrinsic_cost(theta, lidar)
    expected = reference(np.asarray(theta, np.float64), np.asarray(lidar, np.float64))
    assert got.shape == (5, 7)
    assert float(got.min()) > 0.0
    assert float(got.max()) < 1.0
    np.testing.assert_allclose(got, expected, atol=ROUNDING)


def test_the_nearest_network_sees_the_highest_reading_alone(key):
    """It is the dense one with that reading in one bin and no weight elsewhere."""
    key_theta, key_lidar = jax.random.split(key)
    theta = 3.0 * jax.random.normal(key_theta, (13,))
    lidar = jax.random.uniform(key_lidar, (5, 7, 8))
    got = intrinsic_cost(theta, lidar)
    dense = np.concatenate([theta[:4], np.zeros(28), theta[4:]])
    highest = np.asarray(lidar.max(-1, keepdims=True), np.float64)
    expected = reference(dense, np.concatenate([highest, lidar[..., 1:]], -1))
    np.testing.assert_allclose(got, expected, atol=ROUNDING)


def make_inputs():
    """Three states of a hazard of radius 0.5: far, closing in, standing still."""
    return CostInputs(
        cost=jnp.array([0.0, 0.3, 0.2]),
        constraint_lidar=jnp.asarray(np.stack([np.zeros(8), LIDAR, np.ones(8)])),
        distance=jnp.array([2.0, 0.2, 0.75]),
        previous_distance=jnp.array([1.5, 0.6, 0.75]),
        radius=jnp.full(3, 0.5),
    )


TERMS = {
    "extrinsic": [0.0, 0.3, 0.2],
    "intrinsic": [0.3595359, 0.2230037, 0.3534252],
    "distance_decrease": [0.0, 0.4, 0.0],
    "distance_change": [-0.5, 0.4, 0.0],
    "distance_change_indicator": [0.0, 1.0, 1.0],  # standing still counts
    "safety_margin_1x": [0.0, 0.3, 0.0],
    "safety_margin_2x": [0.0, 0.8, 0.25],
    "safety_margin_3x": [0.0, 1.3, 0.75],
}


@pytest.mark.parametrize(("size", "bins"), [(41, 16), (40, 8), (13, 1), (77, 16)])
def test_the_network_reads_eight_bins_and_no_others(size, bins):
    """Of sixteen it would read those ahead and to one side alone."""
    with pytest.raises(ValueError, match=f"{size} parameters and {bins} bins"):
        jax.eval_shape(intrinsic_cost, jnp.zeros(size), jnp.zeros((5, bins)))


def test_the_bank_has_these_terms():
    assert [term.name for term in BANK] == list(TERMS)


@pytest.mark.parametrize("name", TERMS)
def test_terms_by_hand(name):
    cost = training_cost(name, THETA)
    np.testing.assert_allclose(
        total_cost(cost, make_inputs()), TERMS[name], atol=ROUNDING
    )


def test_a_method_is_a_weighted_sum():
    cost = training_cost("extrinsic+0.1*safety_margin_2x + -2*distance_change")
    expected = np.array(TERMS["extrinsic"]) + 0.1 * np.array(TERMS["safety_margin_2x"])
    expected -= 2.0 * np.array(TERMS["distance_change"])
    np.testing.assert_allclose(total_cost(cost, make_inputs()), expected, atol=ROUNDING)


def test_a_term_named_twice_counts_twice():
    cost = training_cost("extrinsic+0.5*extrinsic")
    assert float(cost.weights[0]) == 1.5


@pytest.mark.parametrize("poison", [jnp.nan, jnp.inf, -jnp.inf])
def test_an_unused_term_poisons_nothing(poison):
    inputs = make_inputs().replace(
        constraint_lidar=jnp.full((3, 8), poison), previous_distance=jnp.full(3, poison)
    )
    got = total_cost(training_cost("extrinsic", THETA), inputs)
    np.testing.assert_array_equal(got, inputs.cost)
    used = total_cost(training_cost("distance_change"), inputs)
    assert not np.isfinite(used).any()


def test_weights_are_data():
    """Slots of different methods share one program."""
    costs = [training_cost(name, THETA) for name in TERMS]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *costs)
    got = jax.vmap(total_cost, in_axes=(0, None))(stacked, make_inputs())
    np.testing.assert_allclose(got, list(TERMS.values()), atol=ROUNDING)


def test_a_longer_bank_of_a_user():
    double = CostTerm("double", lambda inputs, theta: 2.0 * inputs.cost + theta[0])
    bank = (*BANK, double)
    cost = training_cost("extrinsic+double", jnp.full(41, 0.5), bank=bank)
    got = total_cost(cost, make_inputs(), bank)
    expected = 3.0 * np.array(TERMS["extrinsic"]) + 0.5
    np.testing.assert_allclose(got, expected, atol=ROUNDING)
    with pytest.raises(ValueError, match=f"each of the {len(BANK)} terms"):
        total_cost(cost, make_inputs())


@pytest.mark.parametrize("method", ["fear", "", "extrinsic+fear", "2*fear"])
def test_an_unknown_term_is_answered_with_the_bank(method):
    with pytest.raises(ValueError, match="unknown cost term") as caught:
        training_cost(method)
    assert all(name in str(caught.value) for name in TERMS)


def test_the_sum_of_weights_is_a_finite_number_too():
    with pytest.raises(ValueError, match="the sum of weight"):
        training_cost("3e38*extrinsic+3e38*extrinsic")


@pytest.mark.parametrize("weight", ["x", "nan", "1e999", "-inf", "1e39", "1e-46"])
def test_a_weight_is_a_finite_number(weight):
    with pytest.raises(ValueError, match="must be a number that float32 can hold"):
        training_cost(f"{weight}*extrinsic")


def test_the_network_needs_its_parameters():
    with pytest.raises(ValueError, match="theta"):
        training_cost("extrinsic+intrinsic")
    with pytest.raises(ValueError, match="theta"):
        training_cost("extrinsic", np.zeros(40))
    cost = training_cost("0*intrinsic+extrinsic")
    assert cost.theta.shape == (41,)


def test_the_limit_is_kept():
    assert float(training_cost("extrinsic", limit=-0.5).limit) == -0.5


# Files -----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cost", "cost.npz", "v1.5", "v1.5.npz", "cost.json"])
def test_round_trip(tmp_path, name):
    theta = np.asarray(THETA, np.float32)
    save_cost(tmp_path / name, theta, {"stage": 3})
    np.testing.assert_array_equal(load_cost(tmp_path / name), theta)
    stem = name.removesuffix(".npz").removesuffix(".json")
    assert sorted(os.listdir(tmp_path)) == [f"{stem}.json", f"{stem}.npz"]
    assert json.loads((tmp_path / f"{stem}.json").read_text()) == {"stage": 3}


def test_costs_of_the_package_load_by_name(tmp_path, monkeypatch):
    sizes = {"lidar_mlp": 41, "lidar_mlp_8": 41, "min_distance_8": 13}
    assert set(list_costs()) == set(sizes)
    for name in list_costs():
        theta = load_cost(name)
        assert theta.shape == (sizes[name],)
        assert bool(jnp.isfinite(theta).all())
        card = cost_card(name)
        assert {"found", "budget", "validation", "fails"} <= set(card)
        world = "Goal-Hazard8-Point" if name.endswith("_8") else "Goal-Hazard-Point"
        assert card["environment"] == world
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="a cost of the package"):
        save_cost("lidar_mlp_8", np.ones(41), {})
    save_cost("./lidar_mlp_8", np.ones(41), {})
    assert sorted(os.listdir(tmp_path)) == ["lidar_mlp_8.json", "lidar_mlp_8.npz"]
    assert not bool((load_cost("lidar_mlp_8") == 1).all())
    assert bool((load_cost("./lidar_mlp_8.npz") == 1).all())


def test_a_missing_card_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"cost\.json is not a readable card"):
        cost_card(tmp_path / "cost")


def test_names_with_dots_do_not_overwrite_each_other(tmp_path):
    save_cost(tmp_path / "init5.0", np.zeros(41), {})
    save_cost(tmp_path / "init5.1", np.ones(41), {})
    np.testing.assert_array_equal(load_cost(tmp_path / "init5.0"), np.zeros(41))


def write_pickled(path):
    np.savez(path, theta=np.array([{"a": 1}] * 41, dtype=object))


def write_truncated(path):
    np.savez(path, theta=THETA)
    path.write_bytes(path.read_bytes()[:-40])


def write_other_name(path):
    np.savez(path, phi=THETA)


def write_npy(path):
    with path.open("wb") as file:
        np.save(file, THETA)


def write_zip_of_text(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("theta.npy", "no array")


BAD_FILES = {
    "missing": lambda path: None,
    "directory": lambda path: path.mkdir(),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("theta"),
    "pickled": write_pickled,
    "truncated": write_truncated,
    "no theta": write_other_name,
    "npy": write_npy,
    "zip of text": write_zip_of_text,
    "short": lambda path: np.savez(path, theta=THETA[:40]),
    "matrix": lambda path: np.savez(path, theta=THETA[None]),
    "nan": lambda path: np.savez(path, theta=np.where(THETA > 0, THETA, math.nan)),
    "inf": lambda path: np.savez(path, theta=np.full(41, math.inf)),
    "strings": lambda path: np.savez(path, theta=np.full(41, "1.0")),
    "complex": lambda path: np.savez(path, theta=np.full(41, 1j)),
}


def test_a_cost_that_is_nowhere_is_answered_with_those_there_are():
    with pytest.raises(ValueError, match=r"nosuch\.npz: no such file.*lidar_mlp"):
        load_cost("nosuch")


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(tmp_path, name):
    path = tmp_path / "cost.npz"
    BAD_FILES[name](path)
    with pytest.raises(ValueError, match=str(path)) as caught:
        load_cost(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "theta",
    [np.zeros(40), np.zeros((1, 41)), np.full(41, np.nan), np.full(13, np.inf)],
)
def test_a_bad_cost_is_not_saved(tmp_path, theta):
    with pytest.raises(ValueError, match="41 or 13 finite numbers"):
        save_cost(tmp_path / "cost", theta, {})
    assert not os.listdir(tmp_path)


def test_a_bad_card_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_cost(tmp_path / "cost", np.zeros(41), {"cost": math.nan})
    assert not os.listdir(tmp_path)
