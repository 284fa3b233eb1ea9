"""The measuring itself: rows are of what they say, and bad sizes are refused."""

import json

import jax
import pytest

from autocost_jax.bench import env_speed, slot_speeds
from autocost_jax.cli import main
from autocost_jax.config import preset
from autocost_jax.env_config import EnvConfig


def test_env_speed_counts_worlds_and_compiles():
    config = EnvConfig(physics="closed_form")
    speed = env_speed(config, 8, jax.devices()[:1])
    assert speed.env == "Goal-Hazard-Point"
    assert speed.physics == "closed_form"
    assert speed.worlds == 8
    assert speed.compile_seconds > 0
    assert speed.env_steps_per_second > 100


def test_programs_of_more_slots_have_more_worlds():
    train = preset("smoke").train
    rows = slot_speeds(train, "ppo_lagrangian", (1, 3), jax.devices()[:1])
    assert [row.worlds for row in rows] == [train.num_worlds, 3 * train.num_worlds]
    assert [row.what for row in rows] == [
        "ppo_lagrangian, 1 slots",
        "ppo_lagrangian, 3 slots",
    ]
    assert all(row.env_steps_per_second > 0 for row in rows)


def test_bench_prints_a_page_and_writes_json(monkeypatch, tmp_path, capsys):
    """The command, with the measuring of programs left to the tests above."""
    from autocost_jax import bench

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
