"""Frozen configuration of learners and search.

All of it shapes the program and is checked before tracing; the worlds have a module of
their own, `env_config`. Every default marked *ours* is a choice that neither the
AutoCost paper nor Safety Gym settles.
"""

from dataclasses import dataclass, field
from typing import Literal

from autocost_jax.config.checks import (
    COUNT,
    COUNTS,
    DISCOUNT,
    FINITE,
    NOT_NEGATIVE,
    NUMBER,
    POSITIVE,
    RATIO,
    SEED,
    SHARE,
    SWITCH,
    check_fields,
    one_of,
    require,
    setting,
    some_of,
)
from autocost_jax.config.env import EnvConfig

Algorithm = Literal["ppo_lagrangian", "cpo", "focops", "pid_lagrangian"]
AlgorithmName = Literal["ppo", Algorithm]
Selection = Literal["paper", "random"]
Start = Literal["normal", "graded"]
Judge = Literal["cost", "success"]
Precision = Literal["float32", "tensorfloat32", "bfloat16"]
CostNetwork = Literal["lidar_mlp", "min_distance"]
THETA_SIZES: dict[CostNetwork, int] = {"lidar_mlp": 41, "min_distance": 13}


@dataclass(frozen=True)
class AgentConfig:
    """Hyper-parameters of PPO, PPO-Lagrangian and CPO; defaults are the paper's.

    Where the paper is silent they are Safety Gym's starter agents'. An update makes
    `policy_passes` x `policy_minibatches` policy steps (CPO: always one full-batch
    step) and `value_passes` x `value_minibatches` critic steps. `normalize_obs`,
    `policy_output_scale` and `violation_factor` are ours. Lower `critic_precision` is
    for the hidden layers in the critics' own steps alone: tensorfloat32 (of a GPU;
    float32 elsewhere) or bfloat16.
    """

    hidden_sizes: tuple[int, ...] = setting(
        (256, 256), COUNTS, "of the policy's and the critics' networks"
    )
    normalize_obs: bool = setting(
        False, SWITCH, "bring observations to mean 0 and deviation 1 over all seen"
    )
    log_std_init: float = setting(-0.5, FINITE, "log deviation of actions at first")
    policy_output_scale: float = setting(
        1.0, POSITIVE, "x Glorot's weights of the policy's last layer at first"
    )
    gamma: float = setting(0.99, DISCOUNT, "discount of rewards")
    gae_lambda: float = setting(0.97, SHARE, "of the reward's advantages")
    cost_gamma: float = setting(0.99, DISCOUNT, "discount of costs")
    cost_gae_lambda: float = setting(0.97, SHARE, "of the cost's advantages")
    policy_lr: float = setting(4e-4, POSITIVE, "Adam's, of PPO's policy")
    policy_passes: int = setting(80, COUNT, "over an epoch's rows, at most")
    policy_minibatches: int = setting(1, COUNT, "of a pass")
    clip_eps: float = setting(0.2, POSITIVE, "PPO's bound of the ratio")
    target_kl: float = setting(0.01, POSITIVE, "trust region of an epoch")
    kl_stop_factor: float = setting(1.2, POSITIVE, "PPO stops at this x target_kl")
    value_lr: float = setting(1e-3, POSITIVE, "Adam's, of the critics")
    value_passes: int = setting(80, COUNT, "over an epoch's rows")
    value_minibatches: int = setting(1, COUNT, "of a pass")
    critic_precision: Precision = setting(
        "float32", one_of(Precision), "of the critics' hidden layers as they learn"
    )
    multiplier_init: float = setting(1.0, POSITIVE, "PPO-Lagrangian's at first")
    multiplier_lr: float = setting(0.05, POSITIVE, "Adam's, of the multiplier")
    cg_iterations: int = setting(10, COUNT, "of CPO's conjugate gradient")
    cg_damping: float = setting(0.1, POSITIVE, "added to CPO's Fisher matrix")
    backtrack_steps: int = setting(10, COUNT, "of CPO's line search, at most")
    backtrack_ratio: float = setting(0.8, RATIO, "by which each shortens the step")
    violation_factor: float = setting(
        1.0, POSITIVE, "x its violation is what a CPO step is made to remove"
    )

    def __post_init__(self) -> None:
        check_fields(self)


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
    num_worlds: int = setting(30, COUNT, "of a slot in an epoch")
    segments_per_episode: int = setting(
        1, COUNT, "cohorts of num_worlds worlds, each a part of an episode ahead"
    )
    num_epochs: int = setting(333, COUNT, "of training in a stage")
    chunk_epochs: int = setting(1, COUNT, "in one call of the program")
    population_chunk: int = setting(
        0, NUMBER, "slots that learn at once on a device; 0: as suits it"
    )

    def __post_init__(self) -> None:
        check_fields(self)
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
    judged by their mean; a stage's candidates share these seeds, and each stage has new
    ones. With `references` each algorithm trains two more costs with as many seeds in
    every stage, the extrinsic cost alone and with a margin of 3x.
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
    seed: int = setting(0, SEED, "of the search")
    algorithms: tuple[Algorithm, ...] = setting(
        ("ppo_lagrangian", "cpo"), some_of(Algorithm), "that train every candidate"
    )
    cost_limit: float = setting(0.0, FINITE, "allowed training cost per episode")
    population_size: int = setting(50, COUNT, "candidates of a stage")
    num_elites: int = setting(5, COUNT, "that are kept and mutated")
    num_stages: int = setting(7, COUNT, "of selection")
    fitness_epochs: int = setting(10, COUNT, "last epochs by which agents are judged")
    init_std: float = setting(1.0, POSITIVE, "scale of the first costs' parameters")
    mutation_std: float = setting(1.0, POSITIVE, "of what is added to a parameter")
    mutation_low: float = setting(0.5, POSITIVE, "lowest factor of a parameter")
    mutation_high: float = setting(2.0, POSITIVE, "highest factor of a parameter")
    zero_tolerance: float = setting(
        0.0, NOT_NEGATIVE, "highest mean cost that counts as no violation"
    )
    selection: Selection = setting(
        "paper", one_of(Selection), "the paper's, or elites drawn at random: a control"
    )
    start: Start = setting(
        "normal",
        one_of(Start),
        "first costs: the paper's, or of set reach and loudness",
    )
    network: CostNetwork = setting(
        "lidar_mlp",
        one_of(CostNetwork),
        "the paper's of 8 readings, or of the highest alone",
    )
    seeds_per_candidate: int = setting(1, COUNT, "trainings by which one is judged")
    references: bool = setting(
        False, SWITCH, "train the extrinsic cost alone and a 3x margin beside"
    )
    judge_by: Judge = setting(
        "cost", one_of(Judge), "extrinsic cost, or how far from the bars of success"
    )
    pool_scores: bool = setting(False, SWITCH, "judge elites by all their trainings")
    num_finalists: int = setting(0, NUMBER, "best ones to train again afterwards")
    final_seeds: int = setting(3, COUNT, "fresh seeds of each finalist")
    final_epochs: int = setting(0, NUMBER, "of a finalist; 0: as many as in a stage")

    def __post_init__(self) -> None:
        check_fields(self)
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
        low, high = self.mutation_low, self.mutation_high
        require(high >= low, "mutation_high", f">= mutation_low={low}", high)
        ok = self.references or self.judge_by != "success"
        require(ok, "judge_by", '"cost" without references', self.judge_by)
        count = self.num_finalists
        require(
            count <= size, "num_finalists", f"in [0, population_size={size}]", count
        )
        chunk, epochs = self.train.chunk_epochs, self.final_epochs
        allowed = f"a multiple of chunk_epochs={chunk}, or 0"
        require(epochs % chunk == 0, "final_epochs", allowed, epochs)

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
