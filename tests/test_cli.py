"""The other commands, in one tiny training run."""

import json
import os
import subprocess
import sys
from importlib.metadata import version

import jax
import numpy as np
import pytest

from autocost_jax.cli import main
from autocost_jax.commandline import NEEDED, guarded
from autocost_jax.config import preset
from autocost_jax.runs import limits
from autocost_jax.runs.directory import RunDir, read_metrics
from autocost_jax.runs.sweep import Method, SweepConfig, sweep_slots
from refusals import refused

TRAIN = ["train", "--preset", "smoke", "--episodes", "3"]
FLAGS = ["--algorithms", "ppo", "ppo_lagrangian", "--num-seeds", "2", "--limit", "0.5"]
FLAGS += ["--cost", "extrinsic+safety_margin_2x"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Plain and constrained PPO, two seeds each, with a hand-made cost."""
    out = tmp_path_factory.mktemp("runs") / "train"
    main([*TRAIN, *FLAGS, "--out", str(out)])
    return out


def test_train_scores_every_method_and_seed(trained):
    table = json.loads((trained / "evaluation.json").read_text())
    rows = table["rows"]
    assert [(row["method"], row["seed"]) for row in rows] == [
        ("ppo", 0),
        ("ppo", 1),
        ("ppo_lagrangian", 0),
        ("ppo_lagrangian", 1),
    ]
    assert all(row["episodes"] == 3 for row in rows)
    epochs = read_metrics(trained)
    assert [row["epoch"] for row in epochs] == [0, 1]
    multipliers = epochs[0]["ppo_lagrangian/multiplier"]
    assert multipliers[:2] == [0.0, 0.0]  # PPO ignores cost
    assert min(multipliers[2:]) > 0.0


def test_train_resumes_and_ends_the_same(trained, capsys):
    before = (trained / "evaluation.json").read_text()
    main([*TRAIN, *FLAGS, "--out", str(trained), "--resume"])
    assert "resuming" in capsys.readouterr().out
    assert (trained / "evaluation.json").read_text() == before


@pytest.fixture
def asked(monkeypatch):
    """The tables that the command line would train."""
    tables = []
    monkeypatch.setattr(
        "autocost_jax.runs.sweep.run_sweep",
        lambda config, *_, **__: tables.append(config),
    )
    return tables


def test_train_resumes_with_another_population_chunk(trained, asked):
    """And without the other flags, which default to the run's own settings."""
    main(["train", "--out", str(trained), "--resume", "--set", "population_chunk=2"])
    (table,) = asked
    assert table.train.population_chunk == 2
    with RunDir.open(trained, table) as run:
        assert run.config == table


@pytest.mark.parametrize(
    ("flags", "old", "new"),
    [
        (["--num-worlds", "4"], "train.num_worlds=2", "train.num_worlds=4"),
        (["--limit", "25"], "limit=0.5", "limit=25.0"),
        (["--cost", "extrinsic"], "cost=extrinsic+safety_margin_2x", "cost=extrinsic"),
        (["--algorithms", "ppo", "cpo"], "label=ppo_lagrangian", "label=cpo"),
        (["--num-seeds", "3"], "seeds=[0, 1]", "seeds=[0, 1, 2]"),
    ],
)
def test_train_resumed_with_another_setting_is_refused(
    trained, capsys, flags, old, new
):
    argv = ["train", "--out", str(trained), "--resume", *flags]
    error = refused(main, argv, capsys)
    assert old in error
    assert new in error


def test_of_a_flag_given_twice_the_last_wins(trained, asked):
    main(["train", "--preset=laptop", "--preset", "smoke"])
    main(["train", "--resume", "--out", "nowhere", f"--out={trained}"])
    main(["train", "--resume", "--no-resume", "--out", str(trained)])
    smoke, resumed, fresh = asked
    assert smoke.train == preset("smoke").train
    assert [method.label for method in resumed.methods] == ["ppo", "ppo_lagrangian"]
    assert fresh.train == preset("laptop").train


def test_evaluate_scores_saved_policies(trained, tmp_path, capsys):
    out = tmp_path / "scores.json"
    flags = ["--episodes", "4", "--deterministic", "--json", str(out)]
    main(["evaluate", "--run", str(trained), "--policies", "ppo_seed1", *flags])
    assert "ppo_seed1: return" in capsys.readouterr().out
    (row,) = json.loads(out.read_text())
    assert row["episodes"] == 4
    assert np.isfinite(row["return_mean"])


def test_info_lists_what_there_is(capsys, trained):
    main(["info"])
    text = capsys.readouterr().out
    for word in ("Goal-Hazard-Point", "laptop", "safety_margin_3x", "jax"):
        assert word in text
    main(["info", "--run", str(trained)])
    assert "extrinsic+safety_margin_2x" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["fly"], ["fly", "train", "evaluate", "report", "info"]),
        ([*TRAIN, "--cost", "pain"], ["pain", "extrinsic", "safety_margin_2x"]),
        ([*TRAIN, "--cost", "x*extrinsic"], ["'x'"]),
        ([*TRAIN, "--cost", "intrinsic"], ["theta"]),
        ([*TRAIN, "--theta", "no.npz"], ["no.npz"]),
        ([*TRAIN, "--env", "Goal-Hazard-Cat"], ["Goal-Hazard-Point"]),
        ([*TRAIN, "--algorithms", "dqn"], ["dqn", "cpo"]),
        ([*TRAIN, "--num-seeds", "0"], ["seeds"]),
        (["train", "--preset", "tiny"], ["tiny", "laptop"]),
        (["evaluate", "--run", "nowhere"], ["nowhere"]),
        (["report", "--run", "nowhere"], ["nowhere"]),
        (["info", "--run", "nowhere"], ["nowhere"]),
    ],
)
def test_bad_input_gets_one_line_and_status_2(argv, words, capsys, tmp_path):
    if argv[0] == "train":
        argv = [*argv, "--out", str(tmp_path / "run")]
    error = refused(main, argv, capsys)
    for word in words:
        assert word in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([*TRAIN, "--num-worlds", "20000000"], ["the training needs", "GB"]),
        ([*TRAIN, "--episodes", "200000000"], ["200000000 episodes needs", "GB"]),
        (["evaluate", "--episodes", "200000000"], ["200000000 episodes needs", "GB"]),
    ],
)
def test_what_cannot_fit_is_refused_before_anything_is_written(
    argv, words, capsys, tmp_path, trained
):
    train = argv[0] == "train"
    argv = [*argv, *(["--out", str(tmp_path / "run")] if train else [])]
    argv = argv if train else [*argv, "--run", str(trained)]
    error = refused(main, argv, capsys)
    for word in words:
        assert word in error
    assert not (tmp_path / "run").exists()


def test_a_job_has_less_memory_than_its_machine(monkeypatch, tmp_path):
    """A limit of a container counts, the word `max` does not."""
    files = [tmp_path / "max", tmp_path / "limit", tmp_path / "missing"]
    files[0].write_text("max\n")
    monkeypatch.setattr(limits, "CGROUP_LIMITS", files)
    machine = limits.memory_of(jax.devices())
    files[1].write_text("1000000\n")
    assert limits.memory_of(jax.devices()) == 1_000_000 // len(jax.devices())
    assert machine is not None
    assert machine > 1_000_000


def test_unknown_policy_lists_those_of_the_run(trained, capsys):
    argv = ["evaluate", "--run", str(trained), "--policies", "best"]
    assert "ppo_seed0" in refused(main, argv, capsys)


@pytest.mark.parametrize(
    ("settings", "answer"),
    [
        ({"JAX_NUM_CPU_DEVICES": "3"}, "3"),
        ({"XLA_FLAGS": "--xla_force_host_platform_device_count=5"}, "5"),
        ({"JAX_PLATFORMS": "cuda"}, "JAX finds no device: JAX_PLATFORMS=cuda names"),
    ],
)
def test_the_settings_of_the_user_of_jax_hold(settings, answer):
    program = (
        "from autocost_jax.commandline import guarded, use_devices\n"
        "guarded(lambda: print(len(use_devices(None))), 'autocost')\n"
    )
    names = ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES", "JAX_PLATFORMS")
    known = {name: value for name, value in os.environ.items() if name not in names}
    done = subprocess.run(
        [sys.executable, "-c", program], env=known | settings, capture_output=True
    )
    lines = (done.stdout + done.stderr).decode().splitlines()
    assert [answer in line for line in lines] == [True]
    assert done.returncode == (2 if "no device" in answer else 0)


def test_commands_set_jax_back_to_what_they_need(capsys):
    before = {name: getattr(jax.config, name) for name in NEEDED}
    odd = {"jax_debug_nans": True, "jax_numpy_rank_promotion": "raise"}
    seen = []
    try:
        for name, value in odd.items():
            jax.config.update(name, value)
        guarded(lambda: seen.append({n: getattr(jax.config, n) for n in NEEDED}), "it")
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
    assert seen == [NEEDED]
    error = capsys.readouterr().err
    assert error.endswith(": jax_debug_nans, jax_numpy_rank_promotion\n")
    guarded(lambda: None, "it")
    assert capsys.readouterr().err == ""


def test_the_search_is_a_command_like_any_other(capsys):
    error = refused(main, ["evolve", "--num-epochs", "0"], capsys)
    assert error.startswith("autocost evolve: num_epochs must be")
    main(["--version"])
    assert capsys.readouterr().out == f"autocost {version('autocost-jax')}\n"


def test_no_command_prints_the_commands(capsys):
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 2
    assert "evaluate" in capsys.readouterr().out


def test_report_of_a_table_is_refused_in_one_line(trained, capsys):
    assert refused(main, ["report", "--run", str(trained)], capsys)


def test_slots_of_a_table_follow_its_rows():
    config = SweepConfig(
        methods=(Method("a", "ppo"), Method("b", "cpo", limit=-1.0)), seeds=(4, 5)
    )
    assert config.algorithms == ("ppo_lagrangian", "cpo")
    ppo, cpo = sweep_slots(config)
    np.testing.assert_array_equal(ppo.constrained, [0.0, 0.0])
    np.testing.assert_array_equal(cpo.cost.limit, [-1.0, -1.0])
    with pytest.raises(ValueError, match="distinct labels"):
        SweepConfig(methods=(Method("a"), Method("a")))


@pytest.mark.parametrize("label", ["", "../../x", "a/b", ".hidden", "a\\b", "a\n"])
def test_a_label_names_a_file_within_the_run(label):
    with pytest.raises(ValueError, match="name of a file"):
        Method(label)


def test_networks_of_a_table_have_one_size():
    """Slots are stacked; one without a network takes the size of the others."""
    cost = "extrinsic+intrinsic"
    methods = [Method("plain")]
    methods += [Method(f"{n}", cost=cost, theta=(0.5,) * n) for n in (13, 41)]
    with pytest.raises(ValueError, match=r"one size, got \[13, 41\]"):
        SweepConfig(methods=tuple(methods))
    (slots,) = sweep_slots(SweepConfig(methods=tuple(methods[:2])))
    np.testing.assert_array_equal(slots.cost.theta, [[0.0] * 13, [0.5] * 13])
