import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_data import float32_bound, load

from autocost_jax.envs.sensors import flatten, lidar, slices

FLOAT32 = 1e-5  # float32 against the engine's float64
FLOAT64 = 1e-12
PRINTED = 1e-6  # the test vector is printed with six digits
SETTINGS = {
    "b16_max3": {"num_bins": 16, "max_dist": 3.0},
    "b8_max3": {"num_bins": 8, "max_dist": 3.0},
    "b10_max3": {"num_bins": 10, "max_dist": 3.0},
    "b16_exp1": {"num_bins": 16},
    "b8_exp05": {"num_bins": 8, "exp_gain": 0.5},
    "b16_max3_noalias": {"num_bins": 16, "max_dist": 3.0, "alias": False},
}
TARGETS = np.array([(1.0, 0.5), (-0.4, 0.9), (0.3, -1.5)], np.float32)
POSITION = np.array([0.3, -0.2, 0.1], np.float32)


def rotation_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)


@pytest.fixture(scope="module")
def recorded():
    return load("lidar")


@pytest.mark.parametrize("name", SETTINGS)
def test_lidar_matches_safety_gym(recorded, name):
    # Repeating the first object changes no maximum and replaces the NaN padding.
    seen = recorded["n_objects"] > 0
    objects = recorded["objects"]
    objects = np.where(np.isnan(objects), objects[:, :1], objects)[seen, :, :2]
    arrays = (objects, recorded["robot_pos"][seen], recorded["robot_mat"][seen])
    read = jax.vmap(functools.partial(lidar, **SETTINGS[name]))
    expected = recorded[name][seen]
    assert len(expected) > 100
    with jax.enable_x64(True):  # every case, bin borders included
        got = read(*(jnp.asarray(array) for array in arrays))
        np.testing.assert_allclose(got, expected, atol=FLOAT64)
    got = np.asarray(read(*(jnp.asarray(array, jnp.float32) for array in arrays)))
    closest = np.linalg.norm(objects - arrays[1][:, None, :2], axis=-1).min(-1)
    error = np.abs(got - expected) / float32_bound(closest)[:, None]
    if "noalias" in name:
        # Without aliasing a reading jumps at a bin border, where float32 may land on
        # either side; with it the reading is continuous.
        error = error[recorded["case"][seen] != "bin_edge"]
    assert error.max() < 1


def test_lidar_without_targets_reads_zero(recorded):
    empty = recorded["n_objects"] == 0
    assert (recorded["b16_max3"][empty] == 0).all()
    got = lidar(jnp.zeros((0, 2)), jnp.zeros(3), jnp.eye(3), num_bins=16)
    np.testing.assert_array_equal(got, np.zeros(16))


@pytest.mark.parametrize(
    ("num_bins", "max_dist", "expected"),
    [
        (
            16,
            3.0,
            ".670017 .145705 .191876 .565387 .373511 0 0 0 0 .443437 .566667 .123230 "
            "0 0 0 .524312",
        ),
        (
            16,
            None,
            ".371595 .080809 .092135 .271487 .179352 0 0 0 0 .213266 .272532 .059266 "
            "0 0 0 .290787",
        ),
        (8, 3.0, ".670017 .565387 .469449 0 .505052 .566667 .061615 .597164"),
        (8, None, ".371595 .271487 .225420 0 .242899 .272532 .029633 .331191"),
    ],
)
def test_lidar_reproduces_the_test_vector(num_bins, max_dist, expected):
    got = lidar(
        jnp.asarray(TARGETS),
        jnp.asarray(POSITION),
        jnp.asarray(rotation_z(0.7)),
        num_bins=num_bins,
        max_dist=max_dist,
    )
    np.testing.assert_allclose(got, [float(x) for x in expected.split()], atol=PRINTED)


def test_lidar_turns_with_the_robot():
    """Turning by one sector shifts the bins; turning the world too changes nothing."""
    read = functools.partial(lidar, num_bins=8)
    still = read(
        jnp.asarray(TARGETS), jnp.asarray(POSITION), jnp.asarray(rotation_z(0.7))
    )
    turned = jnp.asarray(rotation_z(0.7 + 2 * np.pi / 8))
    ahead = read(jnp.asarray(TARGETS), jnp.asarray(POSITION), turned)
    np.testing.assert_allclose(ahead, np.roll(still, -1), atol=FLOAT32)
    world = rotation_z(1.1)
    targets = jnp.asarray(TARGETS @ world[:2, :2].T)
    moved = read(
        targets, jnp.asarray(world @ POSITION), jnp.asarray(rotation_z(0.7 + 1.1))
    )
    np.testing.assert_allclose(moved, still, atol=FLOAT32)


@pytest.mark.parametrize("num_bins", [8, 10, 16])
def test_lidar_wraps_an_angle_just_below_zero(num_bins):
    """The case on which the original raises: the angle rounds to 2 pi, bin n."""
    target = jnp.array([[1.0, -1e-17]])
    got = np.asarray(lidar(target, jnp.zeros(3), jnp.eye(3), num_bins=num_bins))
    expected = np.zeros(num_bins)
    expected[[0, -1]] = np.exp(-1)
    np.testing.assert_allclose(got, expected, atol=FLOAT32)


def test_lidar_stays_in_range():
    key = jax.random.key(0)
    targets = 8 * jax.random.normal(key, (500, 6, 2))
    read = functools.partial(lidar, num_bins=8, max_dist=3.0)
    got = jax.vmap(lambda t: read(t, jnp.zeros(3), jnp.eye(3)))(targets)
    assert float(got.min()) == 0.0
    assert float(got.max()) <= 1.0


def test_flatten_sorts_by_name_and_slices_agree():
    parts = {"b": jnp.arange(2.0), "a": jnp.arange(3.0) + 5, "c": jnp.ones((2, 2))}
    flat = flatten(parts)
    where = slices({name: part.size for name, part in parts.items()})
    assert list(where) == ["a", "b", "c"]
    for name, part in parts.items():
        np.testing.assert_array_equal(flat[where[name]], part.ravel())
