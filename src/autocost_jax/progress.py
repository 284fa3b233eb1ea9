"""The live display of a run: a rich table in a terminal, plain lines elsewhere."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TextIO

import numpy as np


@dataclass(frozen=True)
class EpochSummary:
    """One line of the display.

    Attributes:
      stage: stage, counted from 1.
      num_stages: of how many.
      epoch: epochs of the stage done.
      num_epochs: of how many.
      best_cost: lowest extrinsic cost of an episode over candidates.
      median_cost: median over candidates.
      median_return: median return over candidates.
      num_zero: candidates all of whose episodes of the epoch cost nothing.
      population_size: of how many.
    """

    stage: int
    num_stages: int
    epoch: int
    num_epochs: int
    best_cost: float
    median_cost: float
    median_return: float
    num_zero: int
    population_size: int

    def cells(self) -> list[str]:
        """The columns as text."""
        return [
            f"{self.stage}/{self.num_stages}",
            f"{self.epoch}/{self.num_epochs}",
            f"{self.best_cost:.2f}",
            f"{self.median_cost:.2f}",
            f"{self.median_return:.2f}",
            f"{self.num_zero}/{self.population_size}",
        ]


COLUMNS = (
    "stage",
    "epoch",
    "best cost",
    "median cost",
    "median return",
    "at zero",
    "env steps/s",
    "time left",
)


def summarise(
    stage: int,
    num_stages: int,
    epochs_done: int,
    num_epochs: int,
    metrics: Sequence[dict[str, np.ndarray]],
) -> EpochSummary:
    """The display's line from the last epoch of a chunk.

    Args:
      stage: counted from 0.
      num_stages: of how many.
      epochs_done: epochs of the stage done.
      num_epochs: of how many.
      metrics: for each algorithm, arrays [K, P].
    """
    cost = np.mean([group["ep_cost"][-1] for group in metrics], axis=0)
    ep_return = np.mean([group["ep_return"][-1] for group in metrics], axis=0)
    finite = cost[np.isfinite(cost)]
    return EpochSummary(
        stage=stage + 1,
        num_stages=num_stages,
        epoch=epochs_done,
        num_epochs=num_epochs,
        best_cost=float(finite.min()) if finite.size else math.inf,
        median_cost=float(np.median(cost)),
        median_return=float(np.median(ep_return)),
        num_zero=int(np.sum(cost <= 0)),
        population_size=cost.size,
    )


def format_seconds(seconds: float) -> str:
    """A duration such as "3m 05s"."""
    if not math.isfinite(seconds):
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}h {minutes:02d}m"
    return f"{minutes}m {rest:02d}s" if minutes else f"{rest}s"


class Display:
    """Shows a run while it goes; use as a context manager.

    In a terminal the table is redrawn in place and finished stages stay above it;
    elsewhere every chunk is one plain line.
    """

    def __init__(self, total_steps: int, done_steps: int, stream: TextIO) -> None:
        from rich.console import Console

        self._console = Console(file=stream)
        self._is_live = self._console.is_terminal
        self._live: Any = None
        self._total, self._done = total_steps, done_steps
        self._made = time.monotonic()
        self._start: float | None = None
        self._start_steps = done_steps
        self._rows: list[list[str]] = []

    def __enter__(self) -> "Display":
        if self._is_live:
            from rich.live import Live

            self._live = Live(console=self._console, auto_refresh=False)
            self._live.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*exception)
            self._live = None

    def say(self, text: str) -> None:
        """A line of its own, above the table."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def start_clock(self) -> None:
        """Called when training starts, after the compile."""
        self._start = time.monotonic()

    def skip(self, done_steps: int) -> None:
        """Count steps that an earlier process has done."""
        self._done = self._start_steps = done_steps

    @property
    def elapsed(self) -> float:
        """Seconds since the display was made."""
        return time.monotonic() - self._made

    @property
    def steps_per_second(self) -> float:
        """Environment steps a second since the clock started."""
        if self._start is None:
            return math.nan
        elapsed = time.monotonic() - self._start
        return (self._done - self._start_steps) / max(elapsed, 1e-9)

    def update(self, summary: EpochSummary, new_steps: int) -> None:
        """Show a chunk of `new_steps` environment steps."""
        self._done += new_steps
        rate = self.steps_per_second
        left = (self._total - self._done) / rate if rate > 0 else math.inf
        row = [*summary.cells(), f"{rate:,.0f}", format_seconds(left)]
        if self._live is None:
            fields = zip(COLUMNS, row, strict=True)
            self.say("  ".join(f"{name} {value}" for name, value in fields))
            return
        is_same_stage = self._rows and self._rows[-1][0] == row[0]
        self._rows = (self._rows[:-1] if is_same_stage else self._rows) + [row]
        self._live.update(self._table(), refresh=True)

    def _table(self) -> Any:
        from rich.table import Table

        table = Table(*COLUMNS, title="AutoCost: extrinsic cost and return an episode")
        for row in self._rows:
            table.add_row(*row)
        return table
