"""The display: plain lines for files, a live table for terminals."""

import dataclasses
import io
import time

import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.config import SearchConfig, TrainConfig
from autocost_jax.runs import progress
from autocost_jax.runs.progress import (
    COLUMNS,
    Display,
    format_seconds,
    stage_lines,
    summarise,
)
from autocost_jax.search.stages import TRACKED, stage_result

CONFIG = SearchConfig(
    train=TrainConfig(num_epochs=27),
    population_size=3,
    num_elites=1,
    num_stages=3,
    fitness_epochs=2,
    references=True,
    num_finalists=1,
    final_seeds=2,
    final_epochs=40,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def metrics(cost, ep_return, violating):
    """Of the last of two epochs; three candidates, two references, a spare slot."""
    rows = {"ep_cost": cost, "ep_return": ep_return, "violating_worlds": violating}
    return {name: np.asarray([[9.0] * 6, row]) for name, row in rows.items()}


@pytest.fixture
def groups():
    return (
        metrics([0, 2, 4, 5, 6, 9], [1, 2, 3, 10, 4, 9], [0, 0.5, 1, 0.75, 0.25, 1]),
        metrics([0, 4, 1, 7, 8, 9], [3, 4, 5, 20, 6, 9], [0, 0.5, 1, 0.25, 0.75, 1]),
    )


@pytest.fixture
def summary(groups):
    return summarise(CONFIG, 1, 5, groups)


def test_the_summary_is_of_the_last_epoch_over_algorithms(summary):
    assert (summary.stage, summary.epoch, summary.num_epochs) == ("2/3", 5, 27)
    assert summary.cost == 2.5  # of 0, 3, 2.5
    assert summary.ep_return == 3.0  # of 2, 3, 4
    assert summary.violating == 0.5
    assert summary.reference == (15.0, 0.5)


def test_the_finalists_have_a_row_of_their_own(groups):
    """One finalist and two references with two seeds each: six slots."""
    summary = summarise(CONFIG, 3, 7, groups)
    assert (summary.stage, summary.num_epochs) == ("finalists", 40)
    assert summary.cost == np.mean([0, 2, 0, 4])
    assert summary.reference == (np.mean([3, 10, 5, 20]), np.mean([1, 0.75, 1, 0.25]))


def test_a_search_without_references_shows_none(groups):
    config = dataclasses.replace(
        CONFIG, population_size=6, references=False, num_finalists=0
    )
    summary = summarise(config, 0, 1, groups)
    assert summary.reference is None
    assert summary.cells()[-2:] == ["-", "-"]


def test_all_broken_is_shown_as_such():
    config = dataclasses.replace(CONFIG, references=False, num_finalists=0)
    names = ("ep_cost", "ep_return", "violating_worlds")
    nan = {name: np.full((1, 3), np.nan) for name in names}
    assert "nan" in " ".join(summarise(config, 0, 1, (nan, nan)).cells())


def test_a_finished_stage_is_compared_with_its_references():
    """Candidates and stages count from 1."""
    zeros = jnp.zeros((27, 2, 6))
    history: dict[str, jnp.ndarray] = {name: zeros for name in TRACKED}
    history["ep_return"] = zeros.at[:, :, 3].set(12.0)  # extrinsic alone
    history["violating_worlds"] = zeros.at[:, :, 3].set(0.71)
    history["ep_cost"] = (zeros + 1.0).at[:, :, 1].set(0.0)  # the second is best
    result = stage_result(CONFIG, jnp.zeros((3, 41)), history, jnp.zeros((2, 6), bool))
    lines = stage_lines(CONFIG, 0, result)
    assert lines[0].startswith("stage 1, ")
    assert lines[1].split()[:4] == ["extrinsic", "cost", "alone", "PPO-Lagrangian"]
    assert "return  12.0 violating  71%" in lines[1]
    assert lines[2].startswith("  3x margin by hand")
    assert lines[3].startswith("  candidate 2 is best")


def test_long_work_gives_signs_of_life(monkeypatch):
    monkeypatch.setattr(progress, "HEARTBEAT", 0.01)
    stream = io.StringIO()
    with Display(1000, 0, stream) as display, display.working("evaluating") as tell:
        tell(3, 12)
        time.sleep(0.3)
    lines = stream.getvalue().splitlines()
    assert lines[0] == "evaluating ..."
    assert len(lines) > 3
    assert lines[-1].startswith("evaluating ... 3 of 12, ")


@pytest.mark.parametrize(("seconds", "warns"), [(10.0, False), (100.0, True)])
def test_a_slow_machine_is_told_from_the_first_epochs(
    summary, monkeypatch, seconds, warns
):
    now = [0.0]
    monkeypatch.setattr("autocost_jax.runs.progress.time.monotonic", lambda: now[0])
    stream = io.StringIO()
    with Display(1000, 0, stream, planned=150.0) as display:
        display.start_clock()
        for _ in range(5):
            now[0] += seconds
            display.update(summary, 100)
    assert stream.getvalue().count("slower than planned") == warns


def test_a_file_gets_one_plain_line_a_chunk(summary):
    stream = io.StringIO()
    with Display(1000, 0, stream) as display:
        display.start_clock()
        display.update(summary, 500)
    (line,) = stream.getvalue().splitlines()
    for name in COLUMNS:
        assert name in line
    assert "stage 2/3  epoch 5/27  cost 2.50  return 3.0  violating 50%" in line
    assert "\x1b" not in line


def test_a_terminal_gets_a_table_with_one_row_a_stage(summary, monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "120")
    stream = Terminal()
    with Display(1000, 0, stream) as display:
        display.start_clock()
        display.update(summary, 250)
        display.update(summary, 250)
    last = stream.getvalue().rsplit("AutoCost", 1)[1]
    assert last.count("2/3") == 1
    for name in COLUMNS:
        assert name in last


@pytest.mark.parametrize(
    ("stream", "variable", "value"),
    [(Terminal, "TERM", "dumb"), (io.StringIO, "FORCE_COLOR", "1")],
)
def test_what_cannot_redraw_gets_plain_lines(
    summary, monkeypatch, stream, variable, value
):
    monkeypatch.setenv(variable, value)
    text = stream()
    with Display(1000, 0, text) as display:
        display.start_clock()
        display.update(summary, 250)
        display.update(summary, 250)
    assert text.getvalue().count("stage 2/3") == 2
    assert "\x1b" not in text.getvalue()


def test_rate_and_time_left_count_only_this_process(summary, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("autocost_jax.runs.progress.time.monotonic", lambda: now[0])
    stream = io.StringIO()
    with Display(1000, 0, stream) as display:
        display.skip(400)  # done before a resume
        display.start_clock()
        now[0] += 10.0
        display.update(summary, 100)
    assert display.steps_per_second == 10.0
    assert "time left 50s" in stream.getvalue()
    assert display.elapsed == 10.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0s"), (59, "59s"), (61, "1m 01s"), (7260, "2h 01m"), (np.inf, "-")],
)
def test_durations(seconds, text):
    assert format_seconds(seconds) == text
