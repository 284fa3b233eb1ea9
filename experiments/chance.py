"""Is a difference from Safety Gym's scene the model's, or would the scene differ, too?

    python experiments/chance.py run      # minutes on two cores
    python experiments/chance.py collect  # JSON and table

Contacts amplify rounding. So beside MJX's reduced model the scene itself, in MuJoCo C,
is started from the same states moved by 1e-7 (normal, on every coordinate and
velocity): what it then differs by from itself is chance, what MJX differs by beyond
that is the model's. Four cases: a Car under uniform actions, a Point that leans on a
pillar off its centre or turning, and a Car that backs into a box. Where they touch,
single control steps are compared, from the states of the scene's own run.
"""

import json
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco as untyped_mujoco
import numpy as np
from common import Options, compact, run_part

from autocost_jax import Layout, env_config, make_env
from autocost_jax.config import EnvConfig
from autocost_jax.envs.physics.models import BOX_PARTS, scene_model
from autocost_jax.runs.directory import run_facts

mujoco: Any = untyped_mujoco  # its compiled names have no stubs
NUM, MOVED = 200, 1e-7  # worlds, and by how much their states are moved
QUANTILES = (0.5, 0.9, 0.99, 1.0)


class Case(NamedTuple):
    """One situation.

    Attributes:
      world: name of the environment.
      steps: control steps of a run.
      action: [U], the same in every step; None for uniform actions.
      target: xy of the pillar or box, moved by up to a centimetre from world to world.
      parts: of the velocity that are compared.
    """

    world: str
    steps: int
    action: tuple[float, float] | None = None
    target: tuple[float, float] = (0.0, 0.0)
    parts: slice = slice(None)


CASES = {
    "Car, uniform actions": Case("Goal-Hazard-Car", 200),
    "Point at a pillar off its centre": Case(
        "Goal-Pillar-Point", 80, (1.0, 0.0), (1.0, 0.1)
    ),
    "Point at a pillar, turning": Case(
        "Goal-Pillar-Point", 80, (1.0, 0.11), (0.95, 0.15)
    ),
    "Car backs into a box": Case(
        "Push-Hazard-Car", 80, (-0.03, -0.03), (0.0, 0.6), slice(-6, -3)
    ),
}


class State(NamedTuple):
    """Physics of `NUM` worlds, [N, ...]."""

    qpos: np.ndarray
    qvel: np.ndarray
    warmstart: np.ndarray


class Scenes:
    """`NUM` worlds of a case in MuJoCo C."""

    def __init__(self, case: Case) -> None:
        self.config = env_config(case.world)
        self.model = scene_model(self.config)
        rng = np.random.default_rng(1)
        self.targets = np.add(case.target, rng.uniform(-0.01, 0.01, (NUM, 2)))
        self.worlds = [mujoco.MjData(self.model) for _ in range(NUM)]
        for data, xy in zip(self.worlds, self.targets, strict=True):
            if self.config.task == "Push":
                data.qpos[-7:-5] = xy
            for number in range(self.config.pillars_num):
                body = self.model.body(f"pillar{number}").id
                place = data.mocap_pos[self.model.body_mocapid[body]]
                place[:2] = xy if number == 0 else 6.0 + number

    def start(self) -> State:
        """The model's own pose, at rest."""
        return self.read()

    def read(self) -> State:
        """The present states."""
        names = ("qpos", "qvel", "qacc_warmstart")
        return State(
            *(np.array([getattr(d, name) for d in self.worlds]) for name in names)
        )

    def step(self, state: State, actions: np.ndarray) -> State:
        """One control step from any states."""
        for i, data in enumerate(self.worlds):
            data.qpos[:], data.qvel[:] = state.qpos[i], state.qvel[i]
            data.qacc_warmstart[:] = state.warmstart[i]
            data.ctrl[:] = actions[i]
            mujoco.mj_step(self.model, data, nstep=10)
        return self.read()

    def touches(self) -> np.ndarray:
        """[N] whether robot and pillar or box touch now."""
        robot = self.model.body("robot").id
        found = np.zeros(NUM, bool)
        for i, data in enumerate(self.worlds):
            for pair in data.contact.geom[data.contact.efc_address >= 0]:
                is_robot = self.model.body_rootid[self.model.geom_bodyid[pair]] == robot
                name = self.model.geom(pair[np.argmin(is_robot)]).name
                is_target = name.startswith("pillar") or name in BOX_PARTS
                found[i] |= is_robot.sum() == 1 and is_target
        return found


class Worlds:
    """The same worlds in MJX."""

    def __init__(self, config: EnvConfig, targets: np.ndarray) -> None:
        env = make_env(config)
        far = np.array([[6.0 + i] * 2 for i in range(config.pillars_num)])

        def layout(xy: jax.Array) -> Layout:
            pillars = jnp.asarray(far.reshape(-1, 2), jnp.float32)
            pillars = pillars.at[:1].set(xy) if config.pillars_num else pillars
            zero = jnp.zeros(())
            origin, away = jnp.zeros(2), jnp.full(2, 9.0)
            hazards = jnp.tile(away, (config.hazards_num, 1))
            return Layout(origin, zero, away, hazards, pillars, xy, zero)

        def reset(xy: jax.Array) -> Any:
            return env.reset_to(layout(xy), jax.random.key(0))

        self.fresh = jax.jit(jax.vmap(reset))(jnp.asarray(targets, jnp.float32))
        self.jitted = jax.jit(jax.vmap(env.step))

    def step(self, state: State, actions: np.ndarray) -> State:
        """One control step from any states."""
        qpos, qvel, warmstart = (jnp.asarray(x, jnp.float32) for x in state)
        data = self.fresh.data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        after = self.jitted(
            self.fresh.replace(data=data), jnp.asarray(actions, jnp.float32)
        )
        data = after.data
        return State(*map(np.asarray, (data.qpos, data.qvel, data.qacc_warmstart)))


def moved(state: State, rng: np.random.Generator) -> State:
    """The states, moved by `MOVED`."""
    qpos, qvel = (x + MOVED * rng.normal(size=x.shape) for x in state[:2])
    return State(qpos, qvel, state.warmstart)


def free_run(case: Case, steps: int) -> dict[str, Any]:
    """Open loop under uniform actions: places after ten steps, and mean speeds."""
    scenes, rng = Scenes(case), np.random.default_rng(0)
    worlds = Worlds(scenes.config, scenes.targets)
    shape = (50 + steps, NUM, scenes.model.nu)
    actions = rng.uniform(-1, 1, shape)
    state = scenes.start()
    for action in actions[:50]:  # away from rest
        state = scenes.step(state, action)
    runs = {"scene": state, "scene moved": moved(state, rng), "MJX": state}
    steppers = {"MJX": worlds.step}
    places: dict[str, np.ndarray] = {}
    speeds = {name: np.zeros(NUM) for name in runs}
    for number, action in enumerate(actions[50:], 1):
        for name, now in runs.items():
            runs[name] = steppers.get(name, scenes.step)(now, action)
            speeds[name] += np.linalg.norm(runs[name].qvel[:, :2], axis=1) / steps
            if number == min(10, steps):
                places[name] = runs[name].qpos[:, :2]
    rows = {}
    for name in ("scene moved", "MJX"):
        apart = np.linalg.norm(places[name] - places["scene"], axis=1)
        ratio = speeds[name].mean() / speeds["scene"].mean() - 1
        gap = np.abs(speeds[name] / speeds["scene"] - 1)
        rows[name] = {
            "metres apart after 10 steps": quantiles(apart),
            "mean speed, all worlds": float(ratio),
            "mean speed, each world": quantiles(gap),
        }
    return rows


def contact_steps(case: Case, steps: int) -> dict[str, Any]:
    """Single steps from the scene's states in contact: differences of velocity."""
    scenes, rng = Scenes(case), np.random.default_rng(0)
    worlds = Worlds(scenes.config, scenes.targets)
    actions = np.tile(np.asarray(case.action, float), (NUM, 1))
    state = scenes.start()
    found: dict[str, list[np.ndarray]] = {"scene moved": [], "MJX": []}
    for _ in range(steps):
        after = scenes.step(state, actions)
        touches = scenes.touches()
        if touches.any():
            others = {
                "scene moved": scenes.step(moved(state, rng), actions),
                "MJX": worlds.step(state, actions),
            }
            for name, other in others.items():
                gap = np.abs(other.qvel - after.qvel)[touches][:, case.parts]
                found[name].append(gap.max(1))
        state = after
    rows = {}
    for name, parts in found.items():
        gap = np.concatenate(parts) if parts else np.zeros(1)
        rows[name] = {
            "velocity apart after a step": quantiles(gap),
            "steps": len(gap),
            "share above 0.5": float((gap > 0.5).mean()),
        }
    return rows


def quantiles(values: np.ndarray) -> list[float]:
    """At `QUANTILES`."""
    return [float(x) for x in np.quantile(values, QUANTILES)]


def run(options: Options) -> None:
    """All cases, a file each."""
    options.runs.mkdir(parents=True, exist_ok=True)
    for name in options.only or CASES:
        file, case = options.runs / f"{name}.json", CASES[name]
        if not file.exists():
            steps = 2 if options.smoke else case.steps
            part = free_run if case.action is None else contact_steps
            file.write_text(json.dumps(part(case, steps)))
            print(name, flush=True)


def table(cases: dict[str, Any]) -> str:
    """The table of experiments/results/chance/chance.md."""
    lines = [
        "| case | measure | the scene, moved by 1e-7 | MJX |",
        "|---|---|---|---|",
    ]
    for name, rows in cases.items():
        one, other = rows["scene moved"], rows["MJX"]
        for measure in one:
            if measure != "steps":
                cells = f"{show(one[measure])} | {show(other[measure])}"
                lines.append(f"| {name} | {measure} | {cells} |")
    return "\n".join(lines) + "\n"


def show(value: Any) -> str:
    """A number, or its quantiles."""
    if isinstance(value, list):
        return ", ".join(f"{x:.1e}" for x in value)
    return f"{value:.2%}"


def collect(options: Options) -> None:
    """JSON and table."""
    files = {name: options.runs / f"{name}.json" for name in CASES}
    cases = {n: json.loads(f.read_text()) for n, f in files.items() if f.exists()}
    command = "python experiments/chance.py run && python experiments/chance.py collect"
    result = {"command": command, "facts": run_facts(), "quantiles": QUANTILES}
    options.results.mkdir(parents=True, exist_ok=True)
    text = compact({**result, "cases": cases})
    (options.results / "chance.json").write_text(text + "\n")
    (options.results / "chance.md").write_text(table(cases))


if __name__ == "__main__":
    run_part("chance", __doc__, {"run": run, "collect": collect}, CASES)
