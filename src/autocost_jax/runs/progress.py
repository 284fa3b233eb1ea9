"""The live display of a run: a rich table in a terminal, plain lines elsewhere."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

import numpy as np

from autocost_jax.config import SearchConfig
from autocost_jax.records import Metrics
from autocost_jax.runs.labels import COST_LABELS, algorithm_label
from autocost_jax.search.stages import REFERENCES, StageResult, deal

COLUMNS = (
    "stage",
    "epoch",
    "cost",
    "return",
    "violating",
    "extrinsic alone: return",
    "violating",
    "env steps/s",
    "time left",
)
HEARTBEAT = 5.0  # seconds between two signs of life
SLOW_AFTER = 3  # updates, whose rate tells how long a run takes
SLOWER = 1.3  # times the planned duration that is worth a word


@dataclass(frozen=True)
class EpochSummary:
    """One line of the display: agents of the last epoch, all algorithms together.

    Attributes:
      stage: stage, counted from 1, or "finalists".
      epoch: epochs of the stage done.
      num_epochs: of how many.
      cost: median extrinsic cost per episode over the candidates.
      ep_return: median return per episode.
      violating: share of the candidates' episodes with any extrinsic cost.
      reference: return and share of violating episodes of the agents that learn with
        the extrinsic cost alone; None without references.
    """

    stage: str
    epoch: int
    num_epochs: int
    cost: float
    ep_return: float
    violating: float
    reference: tuple[float, float] | None = None

    def cells(self) -> list[str]:
        """The columns as text."""
        reference = ["-", "-"]
        if self.reference is not None:
            reference = [f"{self.reference[0]:.1f}", f"{self.reference[1]:.0%}"]
        return [
            self.stage,
            f"{self.epoch}/{self.num_epochs}",
            f"{self.cost:.2f}",
            f"{self.ep_return:.1f}",
            f"{self.violating:.0%}",
            *reference,
        ]


def summarise(
    config: SearchConfig,
    stage: int,
    epochs_done: int,
    metrics: Sequence[dict[str, np.ndarray]],
) -> EpochSummary:
    """The display's line from the last epoch of a chunk.

    Args:
      config: the search.
      stage: counted from 0.
      epochs_done: epochs of the stage done.
      metrics: for each algorithm, arrays [K, N].
    """
    is_final = stage == config.num_stages
    dealt = deal(config, is_final)
    count = dealt.num_costs - config.num_references

    def table(name: str) -> np.ndarray:
        """[A, C, S]."""
        return np.stack([dealt.table(group[name][-1]) for group in metrics])

    cost, ep_return = table("ep_cost"), table("ep_return")
    violating = table("violating_worlds")
    reference = None
    if config.num_references:
        means = (float(x[:, count].mean()) for x in (ep_return, violating))
        reference = (next(means), next(means))
    return EpochSummary(
        stage="finalists" if is_final else f"{stage + 1}/{config.num_stages}",
        epoch=epochs_done,
        num_epochs=config.epochs_of(stage),
        cost=_over_known(np.median, cost[:, :count].mean((0, 2))),
        ep_return=_over_known(np.median, ep_return[:, :count].mean((0, 2))),
        violating=_over_known(np.mean, violating[:, :count]),
        reference=reference,
    )


def _over_known(function: Callable[..., Any], values: np.ndarray) -> float:
    """Of those values that are not NaN; NaN if all are."""
    known = values[~np.isnan(values)]
    return float(function(known)) if known.size else math.nan


def stage_lines(config: SearchConfig, stage: int, result: StageResult) -> list[str]:
    """What a finished stage has brought, beside its references.

    Args:
      config: the search.
      stage: counted from 0.
      result: of the stage.
    """
    best = int(np.asarray(result.order)[0])

    def cells(scores: Metrics, at: int) -> str:
        return "   ".join(
            f"{algorithm_label(name)} return {ep_return:5.1f} violating {rate:4.0%}"
            for name, ep_return, rate in zip(
                config.algorithms,
                np.asarray(scores["ep_return"])[:, at],
                np.asarray(scores["violating_worlds"])[:, at],
                strict=True,
            )
        )

    lines = [f"stage {stage + 1}, the last {config.fitness_epochs} epochs:"]
    for at, name in enumerate(REFERENCES if config.references else ()):
        lines.append(f"  {COST_LABELS[name]:21} {cells(result.references, at)}")
    title = f"candidate {best + 1} is best"
    return [*lines, f"  {title:21} {cells(result.scores, best)}"]


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

    def __init__(
        self,
        total_steps: int,
        done_steps: int,
        stream: TextIO,
        planned: float | None = None,
    ) -> None:
        """A display of `total_steps`, meant to take `planned` seconds if given."""
        from rich.console import Console

        self._console = Console(file=stream)
        # FORCE_COLOR makes rich take a file for a terminal.
        self._is_live = stream.isatty() and not self._console.is_dumb_terminal
        self._live: Any = None
        self._total, self._done = total_steps, done_steps
        self._made = time.monotonic()
        self._start: float | None = None
        self._start_steps = done_steps
        self._rows: list[list[str]] = []
        self._planned, self._num_updates = planned, 0

    def __enter__(self) -> "Display":
        if self._is_live:
            from rich.live import Live

            self._live = Live(console=self._console, auto_refresh=False)
            self._live.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.__exit__(*exception)
            self._live = None

    @contextlib.contextmanager
    def working(self, what: str) -> Iterator[Callable[[int, int], None]]:
        """Say every few seconds that something without epochs is still going on.

        Yields:
          (done, all) -> None, to tell how far it is.
        """
        start, done = time.monotonic(), [""]
        over = threading.Event()

        def beat() -> None:
            while not over.wait(HEARTBEAT):
                seconds = format_seconds(time.monotonic() - start)
                line = f"{what} ... {done[0]}{seconds}"
                if self._live is None:
                    self.say(line)
                else:  # one line below the table, redrawn
                    self._redraw(line)

        def tell(count: int, total: int) -> None:
            done[0] = f"{count} of {total}, "

        self.say(f"{what} ...")
        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield tell
        finally:
            over.set()
            thread.join()

    def say(self, text: str) -> None:
        """A line of its own, above the table."""
        with contextlib.suppress(OSError):  # a closed terminal is no reason to stop
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
        self._warn_if_slow(left)
        if self._live is None:
            fields = zip(COLUMNS, row, strict=True)
            self.say("  ".join(f"{name} {value}" for name, value in fields))
            return
        is_same_stage = self._rows and self._rows[-1][0] == row[0]
        self._rows = (self._rows[:-1] if is_same_stage else self._rows) + [row]
        self._redraw()

    def _warn_if_slow(self, left: float) -> None:
        """Once, after the first epochs, if the whole takes longer than was planned."""
        if self._planned is None or self._num_updates >= SLOW_AFTER:
            return
        self._num_updates += 1
        total = self.elapsed + left
        if self._num_updates == SLOW_AFTER and total > SLOWER * self._planned:
            self.say(
                f"this machine is slower than planned: about {format_seconds(total)} "
                f"in all instead of {format_seconds(self._planned)}"
            )

    def _redraw(self, caption: str | None = None) -> None:
        with contextlib.suppress(OSError):
            self._live.update(self._table(caption), refresh=True)

    def _table(self, caption: str | None = None) -> Any:
        from rich.table import Table

        title = "AutoCost: candidates and reference, per episode"
        table = Table(*COLUMNS, title=title, caption=caption)
        for row in self._rows:
            table.add_row(*row)
        return table
