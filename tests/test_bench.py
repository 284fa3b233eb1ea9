"""The measuring itself: rows are of what they say, and bad sizes are refused."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import pytest

from autocost_jax import bench
from autocost_jax.bench import Speed, env_speed, slot_speeds, update_flop
from autocost_jax.cli import main
from autocost_jax.config import EnvConfig, preset
from autocost_jax.costs import training_cost
from autocost_jax.envs.env import make_env
from autocost_jax.population import make_agents
from autocost_jax.records import CostInputs, Slot, Trajectory
from scripts import load_script

programs = load_script("benchmarks/programs")


def closed_form(env):
    """The same world, compiled sooner."""
    return dataclasses.replace(env, physics="closed_form")


def test_env_speed_counts_worlds_and_compiles():
    config = EnvConfig(physics="closed_form")
    speed = env_speed(config, 8, jax.devices()[:1])
    assert speed.env == "Goal-Hazard-Point"
    assert speed.physics == "closed_form"
    assert speed.worlds == 8
    assert speed.compile_seconds > 0
    assert speed.env_steps_per_second > 100


def test_physics_alone_is_less_than_a_step():
    config = EnvConfig(physics="closed_form")
    alone = env_speed(config, 64, jax.devices()[:1], physics_only=True)
    assert alone.what == "physics alone"
    whole = env_speed(config, 64, jax.devices()[:1])
    assert alone.workspace_bytes < whole.workspace_bytes


@pytest.fixture
def rates(monkeypatch):
    """Programs are not compiled; those that do not learn are twice as fast."""
    calls = []

    def speed(train, population, slots, what):
        calls.append((population, slots[0].key.shape[0], what))
        worlds = slots[0].key.shape[0] * train.num_worlds
        rate = 1000 * len(calls)
        return Speed("env", "physics", what, worlds, 0.0, rate, 0)

    monkeypatch.setattr(programs, "program_speed", speed)
    monkeypatch.setattr(bench, "program_speed", speed)
    monkeypatch.setattr(programs, "matmul_rate", lambda width, devices: 1e12)
    return calls


def test_a_timed_call_can_be_one_epoch(monkeypatch, tmp_path):
    """`--chunk-epochs`: only the chunk differs from the preset."""
    script, configs = load_script("benchmarks/population"), []

    def speeds(config, devices):
        configs.append(config)
        return []

    monkeypatch.setattr(script, "search_speeds", speeds)
    monkeypatch.setattr(script, "use_devices", lambda count: jax.devices()[:1])
    words = ["population.py", "--preset", "paper", "--parts", "mjx"]
    for more in ([], ["--chunk-epochs", "1"]):
        monkeypatch.setattr("sys.argv", [*words, *more, "--out", str(tmp_path)])
        script.main()
    usual, short = configs
    assert usual == preset("paper")
    train = dataclasses.replace(usual.train, chunk_epochs=1)
    assert short == dataclasses.replace(usual, train=train)


def test_update_speed_is_the_difference_of_two_programs(rates):
    train = dataclasses.replace(preset("paper").train, num_worlds=4)
    row = programs.update_speed(train, "cpo", 3, jax.devices()[:1])
    assert row.seconds == 6.0  # 12,000 steps at 1000 less at 2000 a second
    flop = 3 * update_flop(train, "cpo", make_env(train.env))
    assert row.tera_flop == round(flop / 1e12, 4)
    assert row.share == round(flop / 6.0 / 1e12, 3)


@pytest.mark.parametrize(("there", "taken"), [(1, [1]), (3, [1, 2]), (8, [1, 2, 4, 8])])
def test_device_speeds_take_powers_of_two(rates, monkeypatch, there, taken):
    monkeypatch.setattr(
        bench, "make_population", lambda env, agents, train, devices: devices
    )
    devices = list(range(there))
    rows = programs.device_speeds(preset("smoke").train, "ppo_lagrangian", 4, devices)
    expect = [f"ppo_lagrangian, 4 slots, {count} devices" for count in taken]
    assert [row.what for row in rows] == expect
    assert [call[0] for call in rates] == [devices[:count] for count in taken]


@pytest.mark.parametrize("algorithm", ["ppo_lagrangian", "cpo"])
def test_update_flop_is_what_the_compiler_counts(algorithm):
    """It counts the body of a loop once, so every loop is made to run once."""
    train = preset("paper").train
    agent = dataclasses.replace(
        train.agent, policy_passes=1, value_passes=1, cg_iterations=1
    )
    env = EnvConfig(num_steps=100, physics="closed_form")
    train = dataclasses.replace(train, agent=agent, num_worlds=4, env=env)
    env = make_env(env)
    (learner,) = make_agents((algorithm,), train, env)
    state = jax.eval_shape(learner.init, jax.random.key(0))
    shape = (100, 4)
    row = jnp.zeros(shape)
    inputs = CostInputs(row, jnp.zeros((*shape, 8)), row, row, row)
    trajectory = Trajectory(
        obs=jnp.zeros((101, 4, env.observation_size)),
        action=jnp.zeros((*shape, env.action_size)),
        reward=row,
        cost_inputs=inputs,
        valid=row,
    )
    slot = Slot(training_cost("extrinsic"), jax.random.key(0), jnp.ones(()))
    lowered = jax.jit(learner.update).lower(
        state, trajectory, row, slot, jax.random.key(0)
    )
    analysis = lowered.compile().cost_analysis()
    assert analysis is not None
    counted = analysis["flops"]
    # On top come the acting and first passes, a line search and all that is no product.
    assert 0.6 * counted < update_flop(train, algorithm, env) < counted


@pytest.mark.slow
def test_a_warm_compile_reads_the_cache():
    before = getattr(jax.config, "jax_compilation_cache_dir", None)
    config = preset("smoke")
    train = dataclasses.replace(config.train, env=closed_form(config.train.env))
    config = dataclasses.replace(config, train=train, algorithms=("ppo_lagrangian",))
    times = programs.compile_times(config, jax.devices()[:1])
    assert 0 < times.warm < 0.7 * times.cold
    assert getattr(jax.config, "jax_compilation_cache_dir", None) == before


def test_a_peer_that_cannot_be_measured_says_why(monkeypatch, tmp_path):
    peers = load_script("benchmarks/peers")
    monkeypatch.setattr(peers, "HERE", tmp_path)
    monkeypatch.setattr(peers.shutil, "which", lambda name: None)
    with pytest.raises(peers.PeerError, match=r"no python3\.10 on the path"):
        peers.measure_peer(peers.CASES[0])
    (tmp_path / ".venv").mkdir()
    with pytest.raises(peers.PeerError, match="ZeroDivisionError"):
        peers.call([peers.sys.executable, "-c", "1 / 0"])
    row = peers.CASES[-1]._asdict() | {"peer_rate": None, "why": "no pip", "rate": 1234}
    table = peers.render({"rows": [row]})
    assert "not measured: no pip" in table
    assert "1,234" in table


@pytest.mark.slow
def test_programs_of_more_slots_have_more_worlds():
    train = preset("smoke").train
    train = dataclasses.replace(train, env=closed_form(train.env))
    rows = slot_speeds(train, "ppo_lagrangian", (1, 3), jax.devices()[:1])
    assert [row.worlds for row in rows] == [train.num_worlds, 3 * train.num_worlds]
    assert [row.what for row in rows] == [
        "ppo_lagrangian, 1 slots",
        "ppo_lagrangian, 3 slots",
    ]
    assert all(row.env_steps_per_second > 0 for row in rows)


def test_bench_prints_a_page_and_writes_json(monkeypatch, tmp_path, capsys):
    """The command, with the measuring of programs left to the tests above."""

    def first_row(config, envs, batch, devices):
        yield bench.env_speed(envs[-1], batch, devices)

    monkeypatch.setattr(bench, "bench", first_row)
    file = tmp_path / "bench.json"
    main(["bench", "--batch", "4", "--devices", "1", "--json", str(file)])
    page = capsys.readouterr().out.splitlines()
    assert "device(s)" in page[0]
    assert "Goal-Hazard-Point, closed_form: env steps" in page[2]
    result = json.loads(file.read_text())
    assert result["command"].startswith("autocost bench --batch 4")
    (row,) = result["rows"]
    assert f"{row['env_steps_per_second']:,}" in page[2]
    assert result["facts"]["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize("flags", [["--batch", "0"], ["--envs", "Goal-Hazard-Cat"]])
def test_bench_refuses_in_one_line(flags, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["bench", *flags])
    assert stop.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
