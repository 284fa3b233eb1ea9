"""Frozen configuration of learners and search.

All of it shapes the program and is checked before tracing; the worlds have a module of
their own, `env_config`. Every default marked *ours* is a choice that neither the
AutoCost paper nor Safety Gym settles.
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

from autocost_jax.config.checks import (
    is_finite,
    is_integer,
    require,
    require_counts,
    require_finite,
    require_positive,
)
from autocost_jax.config.env import EnvConfig

Algorithm = Literal["ppo_lagrangian", "cpo"]
Selection = Literal["paper", "random"]
Start = Literal["normal", "graded"]
Judge = Literal["cost", "success"]
TrainingSeeds = Literal["stage", "candidate"]
Precision = Literal["float32", "tensorfloat32", "bfloat16"]
CostNetwork = Literal["lidar_mlp", "min_distance"]
THETA_SIZES: dict[CostNetwork, int] = {"lidar_mlp": 41, "min_distance": 13}


@dataclass(frozen=True)
class AgentConfig:
    """Hyper-parameters of PPO, PPO-Lagrangian and CPO; defaults are the paper's.

    Where the paper is silent they are Safety Gym's starter agents'. An update makes
    `policy_passes` x `policy_minibatches` policy steps (CPO: always one full-batch
    step) and `value_passes` x `value_minibatches` critic steps. `critic_precision` is
    that of the hidden layers in the critics' own steps, nowhere else: tensorfloat32
    (of a GPU; float32 elsewhere) or bfloat16 for speed. `normalize_obs` (ours) brings
    every observation to mean 0 and deviation 1 over what the agent has seen.
    `violation_factor` (ours, 1 in the literature) times its violation of the limit is
    what a CPO step is made to remove: above 1 safety comes before the return.
    """

    hidden_sizes: tuple[int, ...] = (256, 256)
    normalize_obs: bool = False
    log_std_init: float = -0.5
    gamma: float = 0.99
    gae_lambda: float = 0.97
    cost_gamma: float = 0.99
    cost_gae_lambda: float = 0.97
    policy_lr: float = 4e-4
    policy_passes: int = 80
    policy_minibatches: int = 1
    clip_eps: float = 0.2
    target_kl: float = 0.01
    kl_stop_factor: float = 1.2
    value_lr: float = 1e-3
    value_passes: int = 80
    value_minibatches: int = 1
    critic_precision: Precision = "float32"
    multiplier_init: float = 1.0
    multiplier_lr: float = 0.05
    cg_iterations: int = 10
    cg_damping: float = 0.1
    backtrack_steps: int = 10
    backtrack_ratio: float = 0.8
    violation_factor: float = 1.0

    def __post_init__(self) -> None:
        require_counts(
            self,
            "policy_passes",
            "policy_minibatches",
            "value_passes",
            "value_minibatches",
            "cg_iterations",
            "backtrack_steps",
        )
        require_finite(self, "log_std_init")
        flag = self.normalize_obs
        require(isinstance(flag, bool), "normalize_obs", "true or false", flag)
        known = get_args(Precision)
        require(
            self.critic_precision in known,
            "critic_precision",
            f"one of {', '.join(known)}",
            self.critic_precision,
        )
        require(
            all(is_integer(size) and size >= 1 for size in self.hidden_sizes),
            "hidden_sizes",
            "a tuple of integers >= 1",
            self.hidden_sizes,
        )
        for name in ("gamma", "cost_gamma"):
            value = getattr(self, name)
            require(0 < value <= 1, name, "in (0, 1]", value)
        for name in ("gae_lambda", "cost_gae_lambda"):
            value = getattr(self, name)
            require(0 <= value <= 1, name, "in [0, 1]", value)
        require_positive(
            self,
            "policy_lr",
            "value_lr",
            "clip_eps",
            "target_kl",
            "kl_stop_factor",
            "multiplier_init",
            "multiplier_lr",
            "cg_damping",
            "violation_factor",
        )
        ratio = self.backtrack_ratio
        require(0 < ratio < 1, "backtrack_ratio", "in (0, 1)", ratio)


@dataclass(frozen=True)
class TrainConfig:
    """How every slot is trained: worlds, epochs and the learner's settings.

    An epoch of a slot is `num_worlds` x `env.num_steps` steps. With
    `segments_per_episode` = k > 1 the slot has k cohorts of `num_worlds` worlds and
    an epoch is `env.num_steps` / k steps long; k = 1 is the paper.
    `chunk_epochs` epochs run in one jitted call. `population_chunk` bounds the memory
    of updates: so many slots of an algorithm learn at once on a device, the others
    after them; 0 for what suits the device, one on a CPU and all on others. The
    numbers do not depend on it.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    num_worlds: int = 30
    segments_per_episode: int = 1
    num_epochs: int = 333
    chunk_epochs: int = 1
    population_chunk: int = 0

    def __post_init__(self) -> None:
        require_counts(
            self, "num_worlds", "segments_per_episode", "num_epochs", "chunk_epochs"
        )
        chunk = self.population_chunk
        ok = is_integer(chunk) and chunk >= 0
        require(ok, "population_chunk", "an integer >= 0", chunk)
        k, steps = self.segments_per_episode, self.env.num_steps
        require(
            steps % k == 0, "segments_per_episode", f"a divisor of num_steps={steps}", k
        )
        rows = self.num_worlds * steps  # k cohorts x 1/k of an episode
        for name in ("policy_minibatches", "value_minibatches"):
            count = getattr(self.agent, name)
            require(
                rows % count == 0,
                name,
                f"a divisor of num_worlds x num_steps = {rows}",
                count,
            )
        chunk = self.chunk_epochs
        require(
            self.num_epochs % chunk == 0,
            "chunk_epochs",
            f"a divisor of num_epochs={self.num_epochs}",
            chunk,
        )

    @property
    def epoch_steps(self) -> int:
        """Steps of each world in an epoch, T."""
        return self.env.num_steps // self.segments_per_episode


@dataclass(frozen=True)
class SearchConfig:
    """The evolutionary search; defaults are the paper's, or ours where it is silent.

    Ours: `init_std` 1 (the paper: "randomly sample"), 7 stages, each child mutated
    additively or multiplicatively with probability 1/2, factors element-wise uniform
    in [`mutation_low`, `mutation_high`], elites kept and retrained with new seeds,
    "converged" = the mean over the last `fitness_epochs` epochs (with
    `segments_per_episode` > 1 over as many whole fresh episodes), "zero violation" =
    a mean extrinsic cost <= `zero_tolerance` over those episodes.
    `selection="random"` replaces the ranking by a random choice: the control.

    Options of ours beside the paper's rule, all off by default. `start="graded"` draws
    first costs that rise as anything comes nearer, with a set reach and loudness, see
    `graded_start`. Each candidate is trained with `seeds_per_candidate` seeds and
    judged by their mean. With `training_seeds="stage"` a stage's candidates share these
    seeds, and each stage has new ones; with "candidate" each place of the population
    has its own, the same in every stage, so that stages compare place by place and
    their means do not hang on one seed. With `references` each algorithm trains two
    more costs with as many seeds in every stage, the extrinsic cost alone and with a
    margin of 3x.
    `judge_by="success"` compares candidates with the first of them, by violating
    episodes and return and for each algorithm, see `shortfall`; the paper's
    rule alone rewards costs that make agents flee or stand still, as these are the
    first to be safe. With `pool_scores` elites are judged by all stages that trained
    them. After the last stage the `num_finalists` best are trained from scratch with
    `final_seeds` fresh seeds for `final_epochs` epochs (0: as many as in a stage), the
    references beside them.
    With `network="min_distance"` candidates are networks of 13 parameters that see only
    how near the closest object is, see `costs.intrinsic_logit`; "lidar_mlp" is the
    paper's.
    """

    train: TrainConfig = field(default_factory=TrainConfig)
    seed: int = 0
    algorithms: tuple[Algorithm, ...] = ("ppo_lagrangian", "cpo")
    cost_limit: float = 0.0
    population_size: int = 50
    num_elites: int = 5
    num_stages: int = 7
    fitness_epochs: int = 10
    init_std: float = 1.0
    mutation_std: float = 1.0
    mutation_low: float = 0.5
    mutation_high: float = 2.0
    zero_tolerance: float = 0.0
    selection: Selection = "paper"
    start: Start = "normal"
    network: CostNetwork = "lidar_mlp"
    seeds_per_candidate: int = 1
    training_seeds: TrainingSeeds = "stage"
    references: bool = False
    judge_by: Judge = "cost"
    pool_scores: bool = False
    num_finalists: int = 0
    final_seeds: int = 3
    final_epochs: int = 0

    def __post_init__(self) -> None:
        require_counts(
            self,
            "population_size",
            "num_elites",
            "num_stages",
            "fitness_epochs",
            "seeds_per_candidate",
            "final_seeds",
        )
        size = self.population_size
        require(
            self.num_elites <= size,
            "num_elites",
            f"in [1, population_size={size}]",
            self.num_elites,
        )
        require(
            self.fitness_epochs <= max(1, self.train.num_epochs // 3),
            "fitness_epochs",
            f"in [1, num_epochs={self.train.num_epochs} // 3]",
            self.fitness_epochs,
        )
        known = ("ppo_lagrangian", "cpo")
        require(
            len(self.algorithms) > 0
            and len(set(self.algorithms)) == len(self.algorithms)
            and all(name in known for name in self.algorithms),
            "algorithms",
            f"distinct names out of {', '.join(known)}",
            self.algorithms,
        )
        require_positive(
            self, "init_std", "mutation_std", "mutation_low", "mutation_high"
        )
        require_finite(self, "cost_limit")
        low, high = self.mutation_low, self.mutation_high
        require(high >= low, "mutation_high", f">= mutation_low={low}", high)
        tolerance = self.zero_tolerance
        ok = is_finite(tolerance) and tolerance >= 0
        require(ok, "zero_tolerance", "finite and >= 0", tolerance)
        literals = {
            "selection": Selection,
            "start": Start,
            "judge_by": Judge,
            "training_seeds": TrainingSeeds,
            "network": CostNetwork,
        }
        for name, kind in literals.items():
            value, known = getattr(self, name), get_args(kind)
            require(value in known, name, f"one of {', '.join(known)}", value)
        ok = is_integer(self.seed) and 0 <= self.seed < 2**32
        require(ok, "seed", "an integer in [0, 2**32)", self.seed)
        self._check_options()

    def _check_options(self) -> None:
        """The options of ours."""
        for name in ("references", "pool_scores"):
            flag = getattr(self, name)
            require(isinstance(flag, bool), name, "true or false", flag)
        ok = self.references or self.judge_by != "success"
        require(ok, "judge_by", '"cost" without references', self.judge_by)
        count, size = self.num_finalists, self.population_size
        ok = is_integer(count) and 0 <= count <= size
        require(ok, "num_finalists", f"in [0, population_size={size}]", count)
        chunk, epochs = self.train.chunk_epochs, self.final_epochs
        require(
            is_integer(epochs) and epochs >= 0 and epochs % chunk == 0,
            "final_epochs",
            f"a multiple of chunk_epochs={chunk}, or 0",
            epochs,
        )

    @property
    def num_references(self) -> int:
        """Reference costs that each algorithm trains beside the candidates, R."""
        return 2 if self.references else 0

    @property
    def slots_per_algorithm(self) -> int:
        """Slots of each algorithm in the program, those of a stage or of the finalists.

        Where one has fewer, copies of its first slot fill it up.
        """
        costs = self.population_size + self.num_references
        finalists = self.num_finalists + self.num_references
        final = finalists * self.final_seeds if self.num_finalists else 0
        return max(costs * self.seeds_per_candidate, final)

    def epochs_of(self, stage: int) -> int:
        """Epochs of a stage; `num_stages` is that of the finalists."""
        is_final = stage >= self.num_stages
        return (is_final and self.final_epochs) or self.train.num_epochs

    @property
    def total_stages(self) -> int:
        """Stages of training, the finalists' included."""
        return self.num_stages + (self.num_finalists > 0)

    @property
    def theta_size(self) -> int:
        """Parameters of a candidate, D."""
        return THETA_SIZES[self.network]

    @property
    def final_rounds(self) -> int:
        """Rounds of whole fresh episodes that a stage's fitness is taken from.

        0 where the last `fitness_epochs` epochs are such episodes themselves; else
        enough for as many episodes.
        """
        segments = self.train.segments_per_episode
        return 0 if segments == 1 else -(-self.fitness_epochs // segments)

    @property
    def env_steps(self) -> int:
        """Environment steps of the whole search's training."""
        epochs = sum(self.epochs_of(stage) for stage in range(self.total_stages))
        return epochs * self.epoch_env_steps

    @property
    def epoch_env_steps(self) -> int:
        """Environment steps of an epoch of all slots."""
        slots = self.slots_per_algorithm * len(self.algorithms)
        return slots * self.train.num_worlds * self.train.env.num_steps
