"""Whatever is given: accepted and stored whole, or refused in one line.

The fast tests try some hundred cases each, `pytest -m slow` ten thousand.
"""

import contextlib
import dataclasses
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from autocost_jax.config import AgentConfig, EnvConfig, SearchConfig, TrainConfig
from autocost_jax.config.checks import all_fields
from autocost_jax.costs import BANK, load_cost, parse_cost
from autocost_jax.evolve.__main__ import main
from autocost_jax.runs.config_files import config_hash, from_dict, to_dict
from autocost_jax.runs.sweep import Method, SweepConfig

KINDS = (EnvConfig, AgentConfig, TrainConfig, SearchConfig, Method, SweepConfig)
FEW = settings(
    max_examples=300,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
MANY = settings(FEW, max_examples=10_000)

# Numbers of all sizes and types, texts, and lists and tuples of them.
plain = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 12),
    st.integers(),
    st.integers(10**20, 10**400),
    st.floats(),
    st.floats(1e-3, 2.0),
    st.floats(width=32).map(np.float32),
    st.integers(0, 100).map(np.int64),
    st.text(max_size=12),
    st.sampled_from(("Goal", "cpo", "closed_form", "extrinsic", "success", "graded")),
)
values = st.one_of(
    plain, st.lists(plain, max_size=4), st.lists(plain, max_size=4).map(tuple)
)


@st.composite
def constructor_calls(draw: st.DrawFn) -> tuple[type, dict[str, Any]]:
    """A configuration class and odd values of one to three of its fields."""
    kind = draw(st.sampled_from(KINDS))
    names = [field.name for field in dataclasses.fields(kind)]
    chosen = draw(st.lists(st.sampled_from(names), min_size=1, max_size=3))
    fields = {name: draw(values) for name in chosen}
    if kind is Method:
        fields.setdefault("label", "a row")
    if kind is SweepConfig:
        fields.setdefault("methods", (Method("a row"),))
    return kind, fields


def answer(function: Callable[..., Any], *args: Any, **named: Any) -> tuple[Any, Any]:
    """What a function returns, or None and the words of its ValueError."""
    try:
        return function(*args, **named), None
    except ValueError as error:
        return None, str(error)


def is_stored_or_refused(kind: type, fields: dict[str, Any]) -> None:
    """What is accepted comes back equal from YAML; the rest gets one line."""
    config, refusal = answer(kind, **fields)
    if refusal is not None:
        assert "\n" not in refusal
        return
    stored = yaml.safe_load(yaml.safe_dump(to_dict(config)))
    again = from_dict(kind, stored)
    assert config_hash(again) == config_hash(config)
    assert hash(again) == hash(from_dict(kind, to_dict(config)))
    assert isinstance(hash(config), int)


@FEW
@given(constructor_calls())
def test_a_configuration_is_stored_or_refused(call):
    is_stored_or_refused(*call)


@pytest.mark.slow
@MANY
@given(constructor_calls())
def test_ten_thousand_configurations_are_stored_or_refused(call):
    is_stored_or_refused(*call)


words = st.one_of(
    st.text(max_size=8),
    st.integers().map(str),
    st.integers(10**20, 10**40).map(str),
    st.floats().map(str),
    st.sampled_from(("cpo", "[8, 8]", "null", "{}", "[", "Goal-Hazard-Car", "1e300")),
)
flags = st.sampled_from(
    (
        "--seed",
        "--algorithms",
        "--cost-limit",
        "--population-size",
        "--num-elites",
        "--num-epochs",
        "--num-finalists",
        "--selection",
        "--physics",
        "--eval-episodes",
        "--devices",
        "--config",
        "--env",
    )
)
named = st.sampled_from(sorted(all_fields(SearchConfig)))


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """One to three flags of a search, settings among them, with odd values."""
    argv = []
    for _ in range(draw(st.integers(1, 3))):
        word = draw(words)
        setting = st.just(["--set", f"{draw(named)}={word}"])
        argv += draw(st.one_of(flags.map(lambda flag, w=word: [flag, w]), setting))
    return argv


def is_planned_or_refused(argv: list[str]) -> None:
    """A dry run says its plan, or one line and status 2; it never ends otherwise."""
    out, error, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            main(["--preset", "smoke", "--dry-run", "--no-compile-cache", *argv])
        except SystemExit as stop:
            status = stop.code
    if status == 0:
        assert "would write to" in out.getvalue(), argv
    else:
        assert (status, error.getvalue().count("\n")) == (2, 1), argv


@FEW
@given(command_lines())
def test_a_command_line_is_planned_or_refused(argv):
    is_planned_or_refused(argv)


@pytest.mark.slow
@MANY
@given(command_lines())
def test_ten_thousand_command_lines_are_planned_or_refused(argv):
    is_planned_or_refused(argv)


terms = st.tuples(
    st.one_of(
        st.just(""), st.floats(0.01, 5.0).map(lambda x: f"{x}*"), st.text("*-3e8")
    ),
    st.one_of(st.sampled_from([term.name for term in BANK]), st.text(max_size=4)),
).map("".join)
theta_of_cost = st.one_of(st.none(), st.just((0.5,) * 41), values)


@FEW
@given(st.lists(terms, max_size=3).map("+".join), theta_of_cost, plain)
def test_a_training_cost_is_understood_or_refused(method, theta, limit):
    parsed, refusal = answer(parse_cost, method, theta, limit)
    if refusal is None:
        assert np.isfinite(parsed[0]).all()
    else:
        assert "\n" not in refusal


@FEW
@given(data=st.data())
def test_a_damaged_cost_file_is_read_or_refused(data, tmp_path):
    """Bytes changed, cut off or added."""
    file = tmp_path / "cost.npz"
    np.savez(file, theta=np.zeros(41, np.float32))
    raw = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(raw)))
    file.write_bytes(bytes(raw[:end]) + data.draw(st.binary(max_size=8)))
    theta, refusal = answer(load_cost, file)
    if refusal is None:
        assert theta.shape == (41,)
    else:
        assert str(file) in refusal
        assert "\n" not in refusal
