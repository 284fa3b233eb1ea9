"""The main job from its command line: whole, killed, resumed, and misused."""

import dataclasses
import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

import autocost_jax
from autocost_jax.cli import main as cli
from autocost_jax.commandline import use_compile_cache
from autocost_jax.config import SearchConfig, preset
from autocost_jax.evolve import evolve
from autocost_jax.evolve.__main__ import main
from autocost_jax.files import load_arrays, save_arrays
from autocost_jax.runs.config_files import first_difference
from autocost_jax.runs.directory import (
    RunDir,
    RunDirError,
    list_stages,
    read_config,
    read_metrics,
)
from autocost_jax.viz.run_data import load_report
from refusals import refused

SMOKE = ["--preset", "smoke", "--physics", "closed_form", "--eval-episodes", "4"]
SMOKE += ["--seed", "3"]
WAIT = 400  # seconds until a subprocess counts as hung; they take 10 to 60


def command(out: Path, *flags: str) -> list[str]:
    words = [sys.executable, "-m", "autocost_jax.evolve", "--out", str(out)]
    return [*words, *flags]


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Subprocesses share a compilation cache: cold for the first, then warm."""
    cache = tmp_path_factory.mktemp("cache")
    names = os.environ | {
        "XDG_CACHE_HOME": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    return {k: v for k, v in names.items() if k != "JAX_COMPILATION_CACHE_DIR"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, environment):
    """A smoke run from start to end, with a cold cache."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    done = subprocess.run(
        command(out, *SMOKE), env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out, done.stdout


def without_time(path: Path) -> list[str]:
    """The rows as text, in which a NaN is equal to itself."""
    return [
        json.dumps({k: v for k, v in row.items() if not k.startswith("time/")})
        for row in read_metrics(path)
    ]


def test_a_run_leaves_everything_the_readme_names(whole):
    out, text = whole
    for name in (
        "config.yaml",
        "metrics.jsonl",
        "checkpoints",
        "stage_00.npz",
        "stage_01.npz",
        "cost.npz",
        "cost.json",
        "summary.json",
        "policies/stage_01_cpo.npz",
        "policies/stage_01_ppo_lagrangian.npz",
        "policies/best_cpo.npz",
        "policies/extrinsic_ppo_lagrangian.npz",
        "replay_best_ppo_lagrangian.npz",
        "report/index.html",
        "tensorboard",
    ):
        assert (out / name).exists(), name
    assert list((out / "tensorboard").iterdir())
    assert (out / "stage_01.npz").stat().st_size < 100_000
    for word in ("compiled in", "stage 2/2", "epoch 2/2", "finalists", "time left"):
        assert word in text
    config, facts = read_config(out)
    assert config.seed == 3
    assert facts["versions"]["jax"]
    assert autocost_jax.load_cost(out / "cost.npz").shape == (41,)


def test_compiled_programs_are_kept_for_the_next_run(whole, environment):
    kept = Path(environment["XDG_CACHE_HOME"]) / "autocost_jax"
    assert list(kept.glob("jit_chunk*"))
    # Nor is what the host computes one program for each operation.
    assert len(list(kept.glob("*-cache"))) <= 100


def no_home():
    """As `Path.home` for a container's user without an entry in passwd."""
    raise RuntimeError("Could not determine home directory.")


def test_compile_cache_can_be_off_elsewhere_or_impossible(monkeypatch, tmp_path):
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        assert use_compile_cache(False) is None
        assert jax.config.values["jax_compilation_cache_dir"] == before
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "mine"))
        assert use_compile_cache(True) == tmp_path / "mine"
        assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path / "mine")
        (tmp_path / "file").touch()
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "file" / "x"))
        assert use_compile_cache(True) is None
        for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(Path, "home", no_home)
        assert use_compile_cache(True) is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_metrics_have_one_row_an_epoch_with_every_slot(whole):
    out, _ = whole
    rows = read_metrics(out)
    config = preset("smoke")
    assert [(row["stage"], row["epoch"]) for row in rows] == [
        (stage, epoch)
        for stage in range(config.total_stages)
        for epoch in range(config.epochs_of(stage))
    ]
    for row in rows:
        for name in config.algorithms:
            assert len(row[f"{name}/ep_cost"]) == config.slots_per_algorithm


def test_the_card_names_a_candidate_of_the_search(whole):
    out, _ = whole
    card = json.loads((out / "cost.json").read_text())
    stages = [np.load(file) for file in list_stages(out).values()]
    theta = autocost_jax.load_cost(out / "cost.npz")
    np.testing.assert_array_equal(theta, stages[card["stage"]]["theta"][card["index"]])


def test_the_summary_compares_with_the_references(whole):
    """And 50 steps are too short to violate: no success, no "zero violation"."""
    out, text = whole
    summary = json.loads((out / "summary.json").read_text())
    rows = summary["rows"]
    config = preset("smoke")
    assert [(row["algorithm"], row["cost"]) for row in rows] == [
        (name, cost)
        for name in config.algorithms
        for cost in ("extrinsic", "safety_margin_3x", "best")
    ]
    for row in rows:
        assert (row["seeds"], row["episodes"]) == (config.final_seeds, 4)
        assert np.isfinite([row["return"], row["violation_rate"], row["ep_cost"]]).all()
        assert len(row["by_seed"]["return"]) == config.final_seeds
    assert not summary["succeeded"]
    assert "too short to judge safety" in summary["conclusion"]
    assert summary["conclusion"] in text
    assert "zero" not in text
    for name in ("extrinsic cost alone", "3x margin by hand", "best cost found"):
        assert name in text


def test_the_report_is_made_of_the_run(whole):
    out, _ = whole
    data = load_report(out)
    assert len(data.stages) == 2
    assert len(data.replays) == 6
    assert len(data.references) == 2 * 2 * 2
    assert {row.episodes for row in data.summary} == {4}
    assert {curve.ep_return.shape[1] for curve in data.curves} == {4, 1}
    page = (out / "report" / "index.html").read_text()
    assert "Goal-Hazard-Point" in page
    assert "too short to judge safety" in page


def _edit(name, change):
    """Damage a JSON file: its content is replaced by what `change` makes of it."""

    def damage(run):
        value = json.loads((run / name).read_text())
        (run / name).write_text(json.dumps(change(value)))

    return damage


def _edit_row(change):
    """Damage the third row of the metrics."""

    def damage(run):
        lines = (run / "metrics.jsonl").read_text().splitlines()
        row = json.loads(lines[2])
        change(row)
        lines[2] = json.dumps(row)
        (run / "metrics.jsonl").write_text("\n".join(lines) + "\n")

    return damage


def _edit_arrays(name, change):
    """Damage an .npz."""

    def damage(run):
        arrays = load_arrays(run / name)
        change(arrays)
        save_arrays(run / name, arrays)

    return damage


DAMAGES = {
    "no object": (_edit("cost.json", lambda card: []), "cost.json must hold"),
    "stage 99": (_edit("cost.json", lambda c: c | {"stage": 99}), "of stage 99"),
    "index": (_edit("cost.json", lambda c: c | {"index": "0"}), "index '0'"),
    "no theta": (_edit_arrays("cost.npz", dict.clear), "cost.npz"),
    "no stage": (_edit_row(lambda row: row.pop("stage")), "row 3 .* stage None"),
    "no costs": (_edit_row(lambda row: row.pop("cpo/ep_cost")), "bad cpo/ep_cost"),
    "few slots": (
        _edit_row(lambda row: row.update({"cpo/ep_cost": [0.0]})),
        "bad cpo/ep_cost",
    ),
    "no references": (
        _edit_arrays("stage_00.npz", lambda a: a.pop("references/ep_cost")),
        "stage_00.npz is not the file of a stage",
    ),
    "text for numbers": (
        _edit_row(lambda row: row.update({"cpo/ep_cost": ["a"] * 6})),
        "bad cpo/ep_cost",
    ),
    "a stage lost": (lambda run: (run / "stage_00.npz").unlink(), "stage_00.npz is mi"),
    "a stage cut": (
        lambda run: os.truncate(run / "stage_01.npz", 900),
        "stage_01.npz: not a readable",
    ),
    "short replay": (
        _edit_arrays(
            "replay_best_cpo.npz", lambda a: a.update(reward=a["reward"][:-1])
        ),
        "replay_best_cpo.npz",
    ),
    "few poses": (
        _edit_arrays(
            "replay_best_cpo.npz",
            lambda a: a.update(qpos=a["qpos"][1:], goal_xy=a["goal_xy"][1:]),
        ),
        "50 poses for 50 steps",
    ),
    "summary": (
        _edit("summary.json", lambda s: s | {"rows": [{"cost": "best"}]}),
        "summary.json has a bad row",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_report_of_damaged_files_names_the_file(whole, tmp_path, name):
    out, _ = whole
    run = tmp_path / "run"
    ignored = shutil.ignore_patterns("checkpoints", "tensorboard")
    shutil.copytree(out, run, ignore=ignored)
    damage, words = DAMAGES[name]
    damage(run)
    with pytest.raises(ValueError, match=words) as error:
        load_report(run)
    assert "\n" not in str(error.value)


def test_killed_and_resumed_is_bit_for_bit_the_same(whole, environment, tmp_path):
    reference, _ = whole
    out = tmp_path / "killed"
    process = subprocess.Popen(
        command(out, *SMOKE), env=environment, stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + WAIT
    while not list(out.glob("checkpoints/step_*")):  # at least one epoch is safe
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    was_finished = (out / "cost.json").exists()
    done = subprocess.run(
        command(out, "--resume"),  # also how many episodes there were to be
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not was_finished
    assert "resuming" in done.stdout
    assert without_time(out) == without_time(reference)
    for name in ("stage_00.npz", "stage_01.npz", "cost.npz", "replay_best_cpo.npz"):
        a, b = np.load(reference / name), np.load(out / name)
        assert sorted(a.files) == sorted(b.files)
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key], err_msg=f"{name} {key}")
    card = (out / "cost.json").read_text()
    assert card == (reference / "cost.json").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_a_run_within_seconds(whole, environment, tmp_path, signum):
    """`whole` has warmed the compile cache; a checkpoint less old than 15 s is kept."""
    out = tmp_path / "stopped"
    with subprocess.Popen(
        command(out, *SMOKE, "--set", "num_stages=1000"),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # A shell in the background would have them ignored.
        preexec_fn=lambda: signal.signal(signum, signal.SIG_DFL),
    ) as process:
        deadline = time.monotonic() + WAIT
        try:
            while len(list(out.glob("stage_*.npz"))) < 3:
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            process.send_signal(signum)
            _, error = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 128 + signum
    assert error.splitlines()[-1].endswith(f"--resume --out {out}")
    rows, stages = read_metrics(out), len(list_stages(out))
    config, _ = read_config(out)
    with RunDir.open(out) as run:
        assert run.damages(stages) == []
    assert len(rows) // config.train.num_epochs in (stages, stages + 1)
    newest = max(int(p.name.split("_")[1]) for p in out.glob("checkpoints/step_*"))
    assert newest == len(rows)


def bad(capsys, *argv: str) -> str:
    """The one line that a bad command line gets."""
    return refused(main, argv, capsys)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "huge"], ["huge", "laptop", "paper"]),
        (["--env", "Goal-Hazard-Cat"], ["Goal-Hazard-Cat", "Goal-Hazard-Point"]),
        (["--colour", "red"], ["--colour"]),
        (["--population-size", "1"], ["num_elites", "population_size=1"]),
        (["--num-worlds", "many"], ["--num-worlds", "many"]),
        (["--num-epochs", "0"], ["num_epochs"]),
        (["--num-epochs", "1" + 25 * "0"], ["num_epochs", "2**31"]),
        (["--cost-limit", "1e300"], ["cost_limit", "float32"]),
        (["--set", "policy_lr=1e-300"], ["policy_lr", "float32"]),
        (["--preset", "smoke", "--num-worlds", "20000000"], ["search needs", "GB"]),
        (["--preset", "smoke", "--num-epochs", "1000000000"], ["search needs", "GB"]),
        (["--preset", "smoke", "--eval-episodes", "200000000"], ["episodes needs"]),
        (["--selection", "best"], ["--selection", "paper", "random"]),
        (["--devices", "99"], ["devices", "99"]),
        (["--set", "mutations=0.5"], ["'mutations'", "mutation_std", "info --preset"]),
        (["--set", "population_size=many"], ["population_size", "'many'"]),
        (["--set", "hidden_sizes=[8, 0]"], ["hidden_sizes"]),
        (["--set", "num_worlds"], ["name=value", "'num_worlds'"]),
        (["--set", "hidden_sizes=[8"], ["hidden_sizes=[8", "YAML"]),
    ],
)
def test_bad_flags_get_one_line_and_status_2(capsys, tmp_path, flags, words):
    error = bad(capsys, *flags, "--out", str(tmp_path / "run"))
    for word in words:
        assert word in error
    assert not (tmp_path / "run").exists()


def test_resume_with_another_config_names_the_difference(capsys, whole):
    out, _ = whole
    before = (out / "metrics.jsonl").read_bytes()
    error = bad(capsys, "--out", str(out), "--resume", "--seed", "4")
    assert "seed=3" in error
    assert "seed=4" in error
    assert (out / "metrics.jsonl").read_bytes() == before


@pytest.fixture
def asked(monkeypatch):
    """What the command line would run: lists of configuration, path, resume."""
    calls = []

    def run_search(config, path, *, resume, **_):
        calls.append((config, path, resume))

    monkeypatch.setattr("autocost_jax.runs.search_run.run_search", run_search)
    return calls


def test_resume_uses_another_population_chunk(asked, tmp_path):
    recorded = dataclasses.replace(preset("smoke"), seed=3)
    RunDir.create(tmp_path, recorded, {}).close()
    main(["--out", str(tmp_path), "--resume", "--set", "population_chunk=3"])
    ((config, _, resume),) = asked
    assert resume
    assert config.train.population_chunk == 3
    assert first_difference(recorded, config) is None
    with RunDir.open(tmp_path, config) as run:
        assert run.config == config


@pytest.mark.parametrize("form", ["{} {}", "{}={}"])
def test_of_a_flag_given_twice_the_last_wins(asked, tmp_path, form):
    one, two = tmp_path / "one", tmp_path / "two"
    for path, seed in ((one, 1), (two, 2)):
        RunDir.create(path, dataclasses.replace(preset("smoke"), seed=seed), {}).close()

    def flags(name, *values):
        return [word for v in values for word in form.format(name, v).split()]

    main([*flags("--preset", "laptop", "smoke"), *flags("--out", one, two)])
    worlds = flags("--env", "Push-Hazard-Point", "Goal-Pillar-Point")
    main([*flags("--preset", "laptop", "smoke"), *worlds])
    main(["--resume", *flags("--out", one, two)])
    main(["--dry-run", "--no-dry-run", *flags("--config", one, two)])
    (first, path, _), (second, *_), (third, _, resume), (fourth, *_) = asked
    assert (first, path) == (preset("smoke"), two)
    assert second.train.env.name == "Goal-Pillar-Point"
    assert second.train.env.num_steps == preset("smoke").train.env.num_steps
    assert (third.seed, resume) == (2, True)
    assert fourth.seed == 2


def test_another_world_keeps_the_closed_form_where_it_has_one(asked):
    """And the default directory is called by the world."""
    for name in ("Goal-Hazard8-Point", "Goal-Hazard-Car", "PointGoal1"):
        main(["--env", name])
    main(["--env", "Goal-Hazard-Point", "--set", "hazards_num=6", "--seed=2"])
    worlds = [(config.train.env.name, config.train.env.physics) for config, *_ in asked]
    assert worlds == [
        ("Goal-Hazard8-Point", "closed_form"),
        ("Goal-Hazard-Car", "reduced"),
        ("PointGoal1", "reduced"),
        ("Goal-Hazard6-Point-custom", "closed_form"),
    ]
    paths = [str(path) for _, path, _ in asked]
    assert paths[2:] == [
        "runs/laptop-PointGoal1-seed0",
        "runs/laptop-Goal-Hazard6-Point-custom-seed2",
    ]


def test_of_resume_and_no_resume_the_last_wins(asked, tmp_path):
    out = ["--out", str(tmp_path / "run")]
    RunDir.create(tmp_path / "run", preset("smoke"), {}).close()
    main([*out, "--no-resume", "--resume"])
    main([*out, "--resume", "--no-resume"])
    main([*out, "--resume", "--no_resume"])
    assert [resume for *_, resume in asked] == [True, False, False]
    configs = [config for config, *_ in asked]
    assert configs == [preset("smoke"), preset("laptop"), preset("laptop")]


def test_a_run_is_not_overwritten_by_accident(capsys, whole):
    out, _ = whole
    before = (out / "metrics.jsonl").read_bytes()
    assert "already holds a run" in bad(capsys, *SMOKE, "--out", str(out))
    assert (out / "metrics.jsonl").read_bytes() == before


def test_of_two_that_exclude_each_other_none_wins(capsys, tmp_path):
    RunDir.create(tmp_path, preset("smoke"), {}).close()
    before = (tmp_path / "config.yaml").read_bytes()
    both = ["--resume", "--overwrite", "--out", str(tmp_path)]
    assert "give one" in bad(capsys, *both)
    flags = ["--config", str(tmp_path), "--preset", "paper", "--dry-run"]
    assert "give no --preset beside it" in bad(capsys, *flags)
    assert (tmp_path / "config.yaml").read_bytes() == before


def test_foreign_and_unreadable_directories_are_refused(capsys, tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    assert "not empty" in bad(capsys, *SMOKE, "--out", str(tmp_path))
    assert "not a run" in bad(capsys, "--resume", "--out", str(tmp_path))
    assert (tmp_path / "thesis.txt").read_text() == "mine"
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "config.yaml").write_text("a: [")
    assert "not readable" in bad(capsys, "--resume", "--out", str(broken))


def test_dry_run_says_what_would_happen_and_writes_nothing(capsys, tmp_path):
    main(["--preset", "smoke", "--dry-run", "--out", str(tmp_path / "run")])
    text = capsys.readouterr().out
    assert f"{preset('smoke').env_steps:,} env steps" in text
    assert "memory" in text
    assert not (tmp_path / "run").exists()


def test_help_lists_the_flags(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code in (0, None)
    text = capsys.readouterr().out
    for flag in ("--preset", "--env", "--out", "--resume", "--devices", "--set"):
        assert flag in text
    assert 20 <= len(re.findall(r"^\W*--", text, re.M)) <= 27


def test_config_of_a_run_can_be_used_for_another(whole, tmp_path, capsys):
    out, _ = whole
    new = tmp_path / "new"
    main(["--config", str(out), "--num-stages", "1", "--dry-run", "--out", str(new)])
    assert "1 stages of 4 candidates" in capsys.readouterr().out


def test_settings_of_a_file_and_of_flags_come_over_the_presets(asked, tmp_path):
    """In any order of nesting; flags over the file, `--set` over all."""
    file = tmp_path / "mine.yaml"
    file.write_text(
        "num_worlds: 4\ninit_std: 2\ntrain: {agent: {hidden_sizes: [8, 8]}, "
        "env: {hazards_num: 3}}\nenv: {num_steps: 100}\n"
    )
    main(["--preset", "smoke", "--config", str(file), "--seed", "5"])
    flags = ["--num-worlds", "3", "--set", "num-worlds=6", "--set", "mutation_std=4e-1"]
    main(["--preset", "smoke", "--config", str(file), *flags])
    (first, *_), (second, *_) = asked
    train = preset("smoke").train
    agent = dataclasses.replace(train.agent, hidden_sizes=(8, 8))
    env = dataclasses.replace(train.env, hazards_num=3, num_steps=100)
    train = dataclasses.replace(train, num_worlds=4, agent=agent, env=env)
    expected = dataclasses.replace(preset("smoke"), train=train, init_std=2.0, seed=5)
    assert first == expected
    assert second.train.num_worlds == 6
    assert second.mutation_std == 0.4
    assert second.train.agent == agent


@pytest.mark.parametrize("text", ["num_wolds: 4", "- 4", "a: [", "train: {seed: []}"])
def test_a_bad_file_of_settings_is_refused_in_one_line(capsys, tmp_path, text):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    assert bad(capsys, "--config", str(file))
    assert "no.yaml" in bad(capsys, "--config", "no.yaml")


def test_no_two_settings_have_the_same_name():
    """So that `--set` needs no paths."""

    def names(config):
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            yield field.name
            yield from names(value) if dataclasses.is_dataclass(value) else ()

    found = list(names(SearchConfig()))
    assert len(found) == len(set(found)) > 90


def test_the_settings_of_a_preset_are_a_file_that_gives_it_back(
    asked, capsys, tmp_path
):
    cli(["info", "--preset", "search"])
    text = capsys.readouterr().out
    assert re.search(r"^population_size: 50 +# candidates of a stage$", text, re.M)
    (tmp_path / "all.yaml").write_text(text)
    main(["--preset", "smoke", "--config", str(tmp_path / "all.yaml")])
    assert asked[0][0] == preset("search")


def test_the_function_keeps_its_name():
    """Importing the package of the command line must not take it away."""
    importlib.import_module("autocost_jax.evolve.__main__")
    assert autocost_jax.evolve is evolve


def test_config_yaml_is_plain_yaml(whole):
    out, _ = whole
    document = yaml.safe_load((out / "config.yaml").read_text())
    assert document["config"]["population_size"] == 4


def test_read_config_of_nothing_is_one_line(tmp_path):
    with pytest.raises(RunDirError, match="not a run directory"):
        read_config(tmp_path / "nothing")
