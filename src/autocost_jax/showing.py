"""The verbs of `autocost` that show something: demo, render, report, envs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from autocost_jax.commandline import parse, use_compile_cache


def run_config(path: Path) -> Any:
    """The configuration of a run directory of either kind."""
    from autocost_jax.runs.config_files import read_document
    from autocost_jax.runs.directory import SearchConfig, read_config
    from autocost_jax.runs.sweep import SweepConfig

    config = read_document(path).get("config")
    is_table = isinstance(config, dict) and "methods" in config
    return read_config(path, SweepConfig if is_table else SearchConfig)[0]


def _require_page(out: Path | None) -> None:
    """Refuse to write a page over what is none, such as a run's configuration."""
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"out must be an .html file, got {str(out)!r}")


def demo(argv: list[str]) -> None:
    """Shipped policies side by side."""

    @dataclass(frozen=True)
    class Options:
        """Shipped policies side by side: the extrinsic cost alone and a found cost.

        Attributes:
          out: folder of the page.
          seed: of the layouts and actions.
          compile_cache: keep compiled programs in the user's cache directory.
        """

        out: Path = Path("runs/demo")
        seed: int = 0
        compile_cache: bool = True

    options = parse(Options, argv, "autocost demo")
    use_compile_cache(options.compile_cache)
    from autocost_jax.viz.demo import write_demo

    demo = write_demo(options.out, options.seed)
    for line in [*demo.lines, f"open {demo.page}"]:
        print(line)


def render(argv: list[str]) -> None:
    """One episode of a policy, as a page and a film."""

    @dataclass(frozen=True)
    class Options:
        """Replay one episode: an HTML page, and a film if --video is given.

        Attributes:
          run: run directory whose policy acts; or give --env.
          env: world in which a scripted policy acts; `autocost info` lists them.
          policy: file in the run's policies/, by default that of the best cost; with
            --env: random (default), forward, or seek, which heads for the goal.
          steps: length of the episode; default: the world's.
          deterministic: act by the mean instead of sampling.
          seed: of the layout and the actions.
          out: the page; default: replays/POLICY.html in the run directory, or
            runs/replays/ENV-POLICY.html.
          video: film to write as well, .mp4 or .gif.
          camera: of the film: track (the robot), fixed, or top.
          size: width and height of the film; default: 640 480, a .gif's 480 360.
          compile_cache: keep compiled programs in the user's cache directory.
        """

        run: Path | None = None
        env: str | None = None
        policy: str | None = None
        steps: int | None = None
        deterministic: bool = False
        seed: int = 0
        out: Path | None = None
        video: Path | None = None
        camera: Literal["track", "fixed", "top"] = "track"
        size: tuple[int, int] | None = None
        compile_cache: bool = True

    options = parse(Options, argv, "autocost render")
    if (options.run is None) == (options.env is None):
        raise ValueError("give either --run DIR or --env NAME")
    _require_page(options.out)
    use_compile_cache(options.compile_cache)
    from autocost_jax.viz.picture import film_size
    from autocost_jax.viz.render import best_policy, run_player, script_player, show

    if options.video is not None:
        film_size(options.video, options.size)  # refuses bad ones early
    if options.run is not None:
        config = run_config(options.run)
        name = options.policy or best_policy(options.run)
        player = run_player(options.run, config, name, options.deterministic)
    else:
        player = script_player(options.env or "", options.policy or "random")
    player = player.with_steps(options.steps)
    for line in show(
        player,
        seed=options.seed,
        out=options.out,
        video=options.video,
        camera=options.camera,
        size=options.size,
    ):
        print(line, flush=True)


def report(argv: list[str]) -> None:
    """The report of a search, written again."""

    @dataclass(frozen=True)
    class Options:
        """Write a search's HTML report again.

        Attributes:
          run: run directory of a search, finished or not.
          out: where to write; default: report/index.html in the run directory.
        """

        run: Path
        out: Path | None = None

    options = parse(Options, argv, "autocost report")
    _require_page(options.out)
    from autocost_jax.viz.run_data import write_run_report

    print(write_run_report(options.run, options.out))


def envs(argv: list[str]) -> None:
    """Pictures of the worlds."""
    import tyro

    @dataclass(frozen=True)
    class Options:
        """A picture and the facts of every world, and a page that shows them all.

        Attributes:
          names: worlds that `autocost info` lists; default: all but Safety Gym's.
          out: folder to write to.
          seed: of the layouts.
        """

        names: tyro.conf.Positional[tuple[str, ...]] = ()
        out: Path = Path("runs/envs")
        seed: int = 0

    options = parse(Options, argv, "autocost envs")
    from autocost_jax.config import ENVS
    from autocost_jax.viz.gallery import write_gallery

    names = options.names or tuple(ENVS)
    gallery = write_gallery(names, options.out, options.seed)
    if gallery.hint is not None:
        print(f"drawn from above: {gallery.hint}")
    print(f"{len(gallery.pictures)} pictures; open {gallery.index}")
