"""How far any cost of the distance gets: hand-made shapes, heights and limits.

    python experiments/shapes.py run --scale reduced_10m   # 3 minutes on an H200
    python experiments/shapes.py collect --scale reduced_10m

A shape is a cost of the distance D to the closest object, silent beyond a multiple m of
its radius R and added to the extrinsic cost:

    hinge  h max(0, m R - D)        step  h [D < m R]
    bowl   h max(0, m R - D)^2 / (m R)

with a constant on top for some, and a limit. Both algorithms, two seeds; scores are
those of the training episodes of the last 20 epochs. Shapes are no entries of the
package's bank: this is also an example of a bank of one's own. `--at-once 2` trains two
shapes at a time, as a CPU should; what has been trained is not trained again.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import paper

from autocost_jax import CostTerm, Slot, make_env, make_population
from autocost_jax.config import THETA_SIZES
from autocost_jax.costs import BANK, training_cost
from autocost_jax.population import make_agents, stack_slots
from autocost_jax.records import CostInputs
from autocost_jax.runs.config_files import to_json
from autocost_jax.runs.directory import run_facts

SEEDS = (0, 1)
LAST = 20  # epochs whose training episodes are scored
SCORES = {
    "return": "ep_return",
    "cost": "ep_cost",
    "training_cost": "ep_total_cost",
    "violating": "violating_worlds",
}


class Shape(NamedTuple):
    """A cost of the distance.

    Attributes:
      kind: hinge, step or bowl.
      multiple: m, radii from the centre of an object to where it falls silent.
      height: h, the cost of a step for each metre inside, or of each step inside.
      constant: added everywhere.
      limit: allowed training cost per episode.
    """

    kind: str
    multiple: float
    height: float = 1.0
    constant: float = 0.0
    limit: float = 0.0

    @property
    def is_plain(self) -> bool:
        """Whether its width alone sets it apart from others of its kind."""
        usual = 0.1 if self.kind == "step" else 1.0
        return self.height == usual and not self.constant and not self.limit

    @property
    def title(self) -> str:
        """As in the table."""
        parts = [f"{self.kind} {self.multiple:g}x"]
        parts += [f"height {self.height:g}"] if self.height != 1 else []
        parts += [f"plus {self.constant:g}"] if self.constant else []
        parts += [f"limit {self.limit:g}"] if self.limit else []
        return ", ".join(parts)


def _gap(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    """How far inside, metres; the multiple is the first entry of theta."""
    return jnp.maximum(theta[0] * inputs.radius - inputs.distance, 0.0)


def _step(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    return (_gap(inputs, theta) > 0).astype(inputs.distance.dtype)


def _bowl(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    return _gap(inputs, theta) ** 2 / (theta[0] * inputs.radius)


def _constant(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    del theta
    return jnp.ones_like(inputs.distance)


SHAPES = (
    BANK[0],  # the extrinsic cost
    CostTerm("hinge", _gap),
    CostTerm("step", _step),
    CostTerm("bowl", _bowl),
    CostTerm("constant", _constant),
)
LIMITS = ((1.5, 0.5), (1.5, 2.0), (2.0, 0.5), (2.0, 2.0), (2.0, 8.0))
LIMITS += ((2.5, 2.0), (2.5, 8.0))
STEPS = ((1.25, 0.1), (1.5, 0.1), (1.75, 0.1), (2.0, 0.1), (1.5, 0.01), (2.0, 0.01))
TRIED = (
    *(Shape("hinge", m) for m in (1.25, 1.5, 1.75, 2.0, 2.25, 2.5)),
    *(Shape("hinge", m, 0.1) for m in (1.5, 2.0, 2.5)),
    *(Shape("hinge", m, limit=limit) for m, limit in LIMITS),
    *(Shape("step", m, height) for m, height in STEPS),
    *(Shape("bowl", m) for m in (2.0, 2.5, 3.0)),
    *(Shape("hinge", 2.0, constant=constant) for constant in (1e-4, 1e-3)),
    *(Shape("hinge", m, 10.0) for m in (2.0, 1.5)),
)
MARKERS = {
    "margin_2x": "D",
    "evolved": "*",
    "evolved_dense": "P",
}  # of the figure "margins"


def slot(shape: Shape, seed: int) -> Slot:
    """What trains one shape with one seed."""
    terms = f"extrinsic+{shape.height}*{shape.kind}+{shape.constant}*constant"
    theta = np.zeros(THETA_SIZES["min_distance"])
    theta[0] = shape.multiple
    cost = training_cost(terms, theta, shape.limit, SHAPES)
    return Slot(cost, jax.random.key(seed), jnp.ones(()))


def train(shapes: Sequence[Shape], scale: paper.Scale) -> Iterator[dict[str, Any]]:
    """Train shapes side by side; a row of scores each, [seeds] for both algorithms."""
    config = paper.table(scale.world, ["extrinsic"], scale).train
    env = make_env(config.env)
    agents = make_agents(paper.BOTH, config, env)
    group = stack_slots([slot(shape, seed) for shape in shapes for seed in SEEDS])
    slots = tuple(group for _ in agents)
    population = make_population(env, agents, config, SHAPES, jax.devices())
    state, history = population.init(slots), []
    for epoch in range(0, config.num_epochs, config.chunk_epochs):
        state, metrics = population.chunk(state, slots, epoch)
        history.append(jax.tree.map(np.asarray, population.fetch(metrics)))
        print(f"epoch {epoch + config.chunk_epochs} of {config.num_epochs}", flush=True)
    whole = jax.tree.map(lambda *chunks: np.concatenate(chunks), *history)
    for index, shape in enumerate(shapes):
        own = slice(len(SEEDS) * index, len(SEEDS) * (index + 1))
        yield {"shape": shape._asdict()} | {
            algorithm: {
                name: values[key][-LAST:, own].mean(0, float).round(5).tolist()
                for name, key in SCORES.items()
            }
            for algorithm, values in zip(paper.BOTH, whole, strict=True)
        }


def trained(runs: Path) -> dict[Shape, dict[str, Any]]:
    """The rows of the shapes that have been trained, in the order of `TRIED`."""
    file = runs / "shapes.jsonl"
    lines = file.read_text().splitlines() if file.exists() else ()
    rows = {Shape(**row["shape"]): row for row in map(json.loads, lines)}
    return {shape: rows[shape] for shape in TRIED if shape in rows}


def run(args: argparse.Namespace) -> None:
    """Train what is missing, some shapes at a time."""
    scale = paper.scales(args.world)[args.scale]
    known = TRIED[:2] if args.smoke else TRIED
    done = trained(args.runs)
    missing = [shape for shape in known if shape not in done]
    facts = run_facts()
    facts.pop("seed")
    args.runs.mkdir(parents=True, exist_ok=True)
    for start in range(0, len(missing), args.at_once):
        for row in train(missing[start : start + args.at_once], scale):
            with (args.runs / "shapes.jsonl").open("a") as file:
                file.write(json.dumps(to_json(row | {"facts": facts})) + "\n")


def collect(args: argparse.Namespace) -> None:
    """JSON, table and picture."""
    rows = list(trained(args.runs).values())
    facts = {json.dumps(row.pop("facts"), sort_keys=True) for row in rows}
    scale = paper.scales(args.world)[args.scale]
    config = scale.train
    result = {
        "title": "Shapes of a cost by hand",
        "world": scale.world,
        "scale": scale.name,
        "command": paper.command("shapes", scale),
        "steps_a_slot": paper.steps_a_slot(config),
        "seeds": list(SEEDS),
        "episodes": config.num_worlds * min(LAST, config.num_epochs) * len(SEEDS),
        "trained": [json.loads(text) for text in sorted(facts)],
        "shapes": rows,
    }
    file = paper.write(result, "shapes", args.results)
    file.with_suffix(".md").write_text(render(result))
    draw(result, file.with_suffix(".png"), args.results / "margins.json")
    print(file)


def caption(result: dict[str, Any]) -> str:
    """How much the numbers rest on."""
    return (
        f"{result['scale']} scale: {result['steps_a_slot']:,} steps a slot, "
        f"{len(result['seeds'])} seeds, the last {result['episodes']} training episodes"
    )


def render(result: dict[str, Any]) -> str:
    """A row a shape."""
    columns = ("return", "cost", "violating")
    heads = [f"{paper.NAMES[a]}: {column}" for a in paper.BOTH for column in columns]
    lines = [
        f"{result['world']} ({caption(result)})",
        "",
        f"| shape | {' | '.join(heads)} |",
        "|---" * (1 + len(heads)) + "|",
    ]
    for row in result["shapes"]:
        cells = [Shape(**row["shape"]).title]
        for algorithm in paper.BOTH:
            gain, cost, rate = (np.mean(row[algorithm][name]) for name in columns)
            cells += [f"{gain:.1f}", f"{cost:.3f}", f"{rate:.1%}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(result: dict[str, Any], file: Path, margins: Path) -> None:
    """Violating episodes against return, and the evolved costs of `margins`."""
    from matplotlib.figure import Figure as Picture

    picture = Picture(figsize=(9.5, 4.2), layout="constrained")
    panels = picture.subplots(1, 2, sharey=True)
    for panel, algorithm in zip(panels, paper.BOTH, strict=True):
        for index, kind in enumerate(("hinge", "step", "bowl")):
            for is_plain in (True, False):
                own = [
                    row[algorithm]
                    for row in result["shapes"]
                    if row["shape"]["kind"] == kind
                    and Shape(**row["shape"]).is_plain == is_plain
                ]
                if own:
                    panel.plot(
                        [np.mean(row["return"]) for row in own],
                        [100 * np.mean(row["violating"]) for row in own],
                        "os^"[index],
                        color=f"C{index}",
                        fillstyle="full" if is_plain else "none",
                        label=kind if is_plain else f"{kind}: height, limit, constant",
                    )
        for design, score in fresh_scores(margins, result["world"], algorithm):
            panel.plot(
                score["return"]["mean"],
                100 * score["violation_rate"],
                MARKERS[design],
                color="k",
                markersize=8,
                label=f"{paper.DESIGNS[design].title} ({score['episodes']} fresh)",
            )
        panel.set_title(paper.NAMES[algorithm], fontsize=9)
        panel.set_xlabel("return per episode")
        panel.set_yscale("symlog", linthresh=0.2)
        panel.set_ylim(-0.02, 100)
    panels[0].set_ylabel("violating episodes, %")
    lines, names = panels[0].get_legend_handles_labels()
    picture.legend(lines, names, fontsize=6, ncols=4, loc="outside lower center")
    text = (
        f"{result['title']}, {result['world']}\n{caption(result)}; black: 5 seeds, "
        "fresh episodes"
    )
    picture.suptitle(text, fontsize=8)
    picture.savefig(file, dpi=130)


def fresh_scores(
    margins: Path, world: str, algorithm: str
) -> list[tuple[str, dict[str, Any]]]:
    """Scores of the designs of `MARKERS` over fresh episodes, if there are any."""
    if not margins.exists():
        return []
    panel = json.loads(margins.read_text())["worlds"].get(world, {})
    known = [design for design in MARKERS if design in panel]
    return [(design, panel[design]["algorithms"][algorithm]) for design in known]


PARTS = {"run": run, "collect": collect}

if __name__ == "__main__":
    flags = paper.parser(__doc__, PARTS, scales=("reduced", "reduced_10m"))
    flags.add_argument("--at-once", type=int, default=len(TRIED), help="shapes trained")
    options = paper.arguments(flags)
    PARTS[options.part](options)
