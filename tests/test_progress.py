"""The display: plain lines for files, a live table for terminals."""

import io

import numpy as np
import pytest

from autocost_jax.progress import COLUMNS, Display, format_seconds, summarise


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def metrics(cost, ep_return):
    return {"ep_cost": np.asarray(cost), "ep_return": np.asarray(ep_return)}


@pytest.fixture
def summary():
    groups = (
        metrics([[9.0, 9.0, 9.0], [0.0, 2.0, np.inf]], [[0, 0, 0], [1.0, 2.0, 3.0]]),
        metrics([[9.0, 9.0, 9.0], [0.0, 4.0, 1.0]], [[0, 0, 0], [3.0, 4.0, 5.0]]),
    )
    return summarise(1, 3, 5, 27, groups)


def test_the_summary_is_of_the_last_epoch_over_algorithms(summary):
    assert (summary.stage, summary.epoch) == (2, 5)
    assert summary.best_cost == 0.0
    assert summary.median_cost == 3.0  # of 0, 3, inf
    assert summary.median_return == 3.0  # of 2, 3, 4
    assert (summary.num_zero, summary.population_size) == (1, 3)


def test_all_broken_is_shown_as_such():
    summary = summarise(0, 1, 1, 1, (metrics([[np.nan]], [[np.nan]]),))
    assert summary.best_cost == np.inf
    assert summary.num_zero == 0


def test_a_file_gets_one_plain_line_a_chunk(summary):
    stream = io.StringIO()
    with Display(1000, 0, stream) as display:
        display.start_clock()
        display.update(summary, 500)
    (line,) = stream.getvalue().splitlines()
    for name in COLUMNS:
        assert name in line
    assert "stage 2/3  epoch 5/27  best cost 0.00  median cost 3.00" in line
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


def test_rate_and_time_left_count_only_this_process(summary, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("autocost_jax.progress.time.monotonic", lambda: now[0])
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
