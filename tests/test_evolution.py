"""The search on the toy environment: watched, resumed or pure, it is one search."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax import population
from autocost_jax.commandline import guarded
from autocost_jax.costs import BANK, CostTerm
from autocost_jax.es import top, truncation_es
from autocost_jax.runs.directory import list_stages
from autocost_jax.runs.search_run import run_search
from autocost_jax.search import evolution
from autocost_jax.search.evolution import (
    best_of,
    evolve,
    init_search,
    make_searcher,
    pick_label,
    search,
)
from autocost_jax.search.stages import (
    ASK,
    TRACKED,
    deal,
    stage_key,
    stage_result,
    stage_slots,
)
from autocost_jax.viz.report import render_report
from autocost_jax.viz.run_data import load_report
from toys import (
    Counter,
    linear_agent,
    make_toy_env,
    search_config,
    train_config,
)

CONFIG = search_config(
    train=train_config(num_epochs=6), num_stages=3, fitness_epochs=2, init_std=5.0
)
ACROSS_PROGRAMS = 1e-4  # six epochs of float32 in two programs; the toy is smooth


@pytest.fixture(scope="module", autouse=True)
def toy_world():
    """The search finds the toy environment and a cheap agent in place of its own."""
    counter = Counter()

    def make_agents(algorithms, config, env):
        del config
        return tuple(linear_agent(env) for _ in algorithms)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            evolution, "make_env", lambda c: make_toy_env(c.num_steps, counter=counter)
        )
        patch.setattr(evolution, "make_agents", make_agents)
        yield counter


@pytest.fixture(scope="module")
def searcher():
    return make_searcher(CONFIG)


def copy(tree):
    """NumPy copies: what a checkpoint holds, safe from donation."""
    return jax.tree.map(np.array, tree)


def run(config=CONFIG, **options):
    """All yielded states and reports of a search, copied."""
    return [(copy(state), report) for state, report in evolve(config, **options)]


@pytest.fixture(scope="module")
def events(searcher):
    return run(searcher=searcher)


def results(events):
    return [report.result for _, report in events if report.result is not None]


def assert_same_bits(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)


def test_every_chunk_is_reported(events):
    assert [(e.stage, e.epoch) for _, e in events] == [
        (stage, epoch) for stage in range(3) for epoch in range(6)
    ]
    ends = [report.result is not None for _, report in events]
    assert ends == ([False] * 5 + [True]) * 3
    for _, report in events:
        for group in report.metrics:
            assert group["ep_cost"].shape == (1, CONFIG.population_size)
            assert isinstance(group["ep_cost"], np.ndarray)


def test_the_state_counts(events):
    places = [(int(state.stage), int(state.epoch)) for state, _ in events]
    assert places[:7] == [(0, 1), (0, 2), (0, 3), (0, 4), (0, 5), (1, 0), (1, 1)]
    assert places[-1][0] == CONFIG.num_stages
    assert int(events[-1][0].es.generation) == CONFIG.num_stages


def test_fitness_is_the_mean_of_the_last_epochs(events):
    """Of both algorithms, over `fitness_epochs`, from the reported metrics."""
    for stage, result in enumerate(results(events)):
        rows = [e.metrics for _, e in events if e.stage == stage]
        for name, got in (
            ("ep_cost", result.fitness.cost),
            ("ep_return", result.fitness.ep_return),
        ):
            values = np.array([[g[name][0] for g in row] for row in rows])  # [E, A, P]
            expected = values[-CONFIG.fitness_epochs :].mean(axis=(0, 1))
            np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(
                result.scores[name], values[-2:].mean(axis=0), rtol=1e-6, atol=1e-6
            )
        assert len(np.unique(result.fitness.ep_return)) == CONFIG.population_size


def test_elites_are_retrained_with_new_seeds(events):
    first, second = results(events)[:2]
    order = np.asarray(first.order)
    np.testing.assert_array_equal(second.candidates[:2], first.candidates[order[:2]])
    assert not np.isin(second.fitness.ep_return, first.fitness.ep_return).any()


def test_a_stage_asks_with_its_own_key(events):
    strategy = truncation_es(CONFIG)
    asked = strategy.ask(stage_key(jax.random.key(0), 0, ASK), strategy.init())
    first = results(events)[0].candidates
    np.testing.assert_allclose(first, asked, rtol=1e-6)  # compiled with its stage


def test_the_archive_holds_every_stage(events):
    es = events[-1][0].es
    told = results(events)
    np.testing.assert_array_equal(
        es.archive, np.concatenate([result.candidates for result in told])
    )
    np.testing.assert_array_equal(
        es.archive_fitness.cost, np.concatenate([r.fitness.cost for r in told])
    )
    pick = best_of(CONFIG, es)
    chosen = told[int(pick.generation)]
    np.testing.assert_array_equal(pick.candidate, chosen.candidates[int(pick.index)])


# One and the same search --------------------------------------------------------


def test_the_pure_search_is_the_same(events):
    result = jax.jit(search(CONFIG))(jax.random.key(CONFIG.seed))
    assert result.fitness.cost.shape == (3, CONFIG.population_size)
    for stage, told in enumerate(results(events)):
        np.testing.assert_allclose(
            result.fitness.cost[stage], told.fitness.cost, atol=ACROSS_PROGRAMS
        )
        np.testing.assert_allclose(
            result.fitness.ep_return[stage],
            told.fitness.ep_return,
            atol=ACROSS_PROGRAMS,
        )
    es = events[-1][0].es
    np.testing.assert_allclose(result.es.archive, es.archive, rtol=1e-6)


def test_the_same_seed_twice(searcher, events):
    assert_same_bits(run(searcher=searcher)[-1][0], events[-1][0])


def test_keys_are_not_of_the_users_generator():
    with jax.default_prng_impl("rbg"):
        root = make_searcher(CONFIG).root
    assert jax.random.key_impl(root) == "threefry2x32"


def test_another_seed_is_another_search(events):
    other = run(dataclasses.replace(CONFIG, seed=1, num_stages=1))
    assert not np.isin(other[-1][0].candidates, events[5][0].candidates).any()


@pytest.mark.parametrize("chunk", [0, 3, 5, 6, 11, 16])
def test_resume_from_any_yielded_state(searcher, events, chunk):
    """Within a stage, at its end, and before the last chunk; bit for bit."""
    saved = copy(events[chunk][0])
    resumed = run(searcher=searcher, state=saved)
    assert len(resumed) == len(events) - chunk - 1
    assert_same_bits(resumed[-1][0], events[-1][0])
    for (_, one), (_, two) in zip(resumed, events[chunk + 1 :], strict=True):
        assert (one.stage, one.epoch) == (two.stage, two.epoch)
        assert_same_bits(one.metrics, two.metrics)


def test_resume_in_a_new_process_compiles_the_same(events):
    """A fresh searcher from the same configuration continues the same run."""
    resumed = run(state=copy(events[13][0]), searcher=make_searcher(CONFIG))
    assert_same_bits(resumed[-1][0], events[-1][0])


def test_a_finished_search_has_nothing_to_do(searcher, events):
    assert run(searcher=searcher, state=copy(events[-1][0])) == []


def test_chunks_of_another_length(events):
    train = train_config(num_epochs=6, chunk_epochs=2)
    other = run(dataclasses.replace(CONFIG, train=train))
    assert len(other) == len(events) // 2
    assert other[0][1].metrics[0]["ep_cost"].shape == (2, 4)
    for one, two in zip(results(other), results(events), strict=True):
        np.testing.assert_allclose(
            one.fitness.cost, two.fitness.cost, atol=ACROSS_PROGRAMS
        )
        np.testing.assert_allclose(
            one.fitness.ep_return, two.fitness.ep_return, atol=ACROSS_PROGRAMS
        )


# Cohorts ------------------------------------------------------------------------


@pytest.mark.slow
def test_with_cohorts_fitness_is_of_whole_fresh_episodes():
    """Pure or in chunks it is the same search, and its fitness no training metric."""
    train = train_config(num_epochs=6, segments_per_episode=2)
    config = dataclasses.replace(CONFIG, train=train)
    assert config.final_rounds == 1
    events = list(evolve(config))
    pure = jax.jit(search(config))(jax.random.key(config.seed))
    for stage, result in enumerate(results(events)):
        np.testing.assert_allclose(
            result.fitness.cost, pure.fitness.cost[stage], atol=ACROSS_PROGRAMS
        )
        np.testing.assert_allclose(
            result.fitness.ep_return,
            pure.fitness.ep_return[stage],
            atol=ACROSS_PROGRAMS,
        )
        np.testing.assert_allclose(
            result.fitness.ep_return, result.scores["ep_return"].mean(0), rtol=1e-5
        )
    history = events[-1][0].history["ep_return"]
    trained = np.asarray(history)[-config.fitness_epochs :].mean((0, 1))
    assert np.abs(results(events)[-1].fitness.ep_return - trained).max() > 1e-3


# One trace, one compile ---------------------------------------------------------


def test_one_trace_and_one_compilation(toy_world, monkeypatch, caplog):
    """Of the chunk; and after two stages nothing at all is compiled any more.

    The small functions around it are compiled twice: for a state that has just been
    made, and for one that has been on the devices.
    """
    traces, chunks, compiled = [], [], []
    run_epoch = population.run_epoch

    def counted(*args):
        traces.append(1)
        return run_epoch(*args)

    monkeypatch.setattr(population, "run_epoch", counted)
    toy_world.steps = 0
    config = dataclasses.replace(CONFIG, num_stages=4, seed=5)
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        for _, report in evolve(config):
            if report.result is not None:
                lines = [record.getMessage() for record in caplog.records]
                lines = [line for line in lines if line.startswith("Compiling ")]
                compiled.append(len(lines))
                chunks.append(sum("jit(chunk)" in line for line in lines))
    assert len(traces) == 1
    assert toy_world.steps == 1
    assert chunks == [1, 1, 1, 1]
    assert compiled[1:] == [compiled[1]] * 3


# Broken candidates --------------------------------------------------------------


def make_history(cost, ep_return):
    """[E, A, P] histories of every tracked metric."""
    cost, ep_return = jnp.asarray(cost), jnp.asarray(ep_return)
    others = {name: jnp.zeros_like(cost) for name in TRACKED}
    return others | {"ep_cost": cost, "ep_return": ep_return}


def test_a_frozen_agent_costs_everything():
    """Whatever its metrics say; one broken algorithm is enough."""
    cost = jnp.zeros((6, 2, 4)).at[:, :, 3].set(2.0)
    frozen = jnp.zeros((2, 4), bool).at[1, 0].set(True)
    result = stage_result(
        CONFIG, jnp.zeros((4, 41)), make_history(cost, cost + 1.0), frozen
    )
    assert result.fitness.cost.tolist() == [np.inf, 0.0, 0.0, 2.0]
    assert result.fitness.ep_return.tolist() == [-np.inf, 1.0, 1.0, 3.0]
    assert result.order.tolist() == [1, 2, 3, 0]


def poison(searcher, broken):
    """A state before the first chunk, with NaN parameters in some slots."""
    state = init_search(searcher)
    group, *others = state.training.learners
    weights = group.agent.weights.at[np.array(broken)].set(jnp.nan)
    group = group.replace(agent=group.agent.replace(weights=weights))
    training = state.training.replace(learners=(group, *others))
    return state.replace(training=training)


def test_a_frozen_candidate_is_never_an_elite(searcher):
    stage = run(searcher=searcher, state=poison(searcher, [0, 2]))[:6]
    result = stage[-1][1].result
    assert result is not None
    assert result.frozen.tolist() == [[True, False, True, False], [False] * 4]
    assert np.isinf(result.fitness.cost).tolist() == [True, False, True, False]
    elites = stage[-1][0].es.elites
    assert sorted(np.asarray(result.order[:2]).tolist()) == [1, 3]
    assert not np.isin(elites, result.candidates[np.array([0, 2])]).any()


def test_a_stage_without_survivors_ends_the_search(searcher):
    state = poison(searcher, range(CONFIG.population_size))
    seen = []
    events = (
        (copy(after), report)
        for after, report in evolve(CONFIG, searcher=searcher, state=state)
    )
    with pytest.raises(RuntimeError, match="every candidate of stage 1 failed"):
        seen.extend(events)
    assert len(seen) == CONFIG.train.num_epochs
    failed = seen[-1][0]
    for go_on in (
        lambda: run(searcher=searcher, state=copy(failed)),
        lambda: best_of(CONFIG, failed.es),
    ):
        with pytest.raises(RuntimeError, match="every candidate of stage 1 failed"):
            go_on()


def test_nothing_is_best_before_the_first_stage(searcher):
    with pytest.raises(RuntimeError, match="before its first stage"):
        best_of(CONFIG, init_search(searcher).es)


def broken_agents(algorithms, config, env):
    """Agents that turn to NaN in their first update."""
    del config
    agent = linear_agent(env)

    def update(state, *rest):
        after, metrics = agent.update(state, *rest)
        return after.replace(weights=jnp.nan * after.weights), metrics

    return tuple(agent._replace(update=update) for _ in algorithms)


def test_the_pure_search_of_broken_agents_has_no_best(monkeypatch):
    monkeypatch.setattr(evolution, "make_agents", broken_agents)
    config = search_config(train=train_config(num_epochs=3), num_stages=2)
    es = jax.jit(search(config))(jax.random.key(0)).es
    with pytest.raises(RuntimeError, match="every candidate of stage 1 failed"):
        best_of(config, es)


def test_a_run_that_failed_stays_failed(monkeypatch, tmp_path, capsys):
    """Resumed it says so again, nothing is published, and its report has no best."""
    monkeypatch.setattr(evolution, "make_agents", broken_agents)
    config = search_config(train=train_config(num_epochs=3), num_stages=2)
    path = tmp_path / "run"

    def attempt(resume):
        run_search(config, path, resume=resume)

    for resume in (False, True):
        with pytest.raises(SystemExit) as stop:
            guarded(lambda r=resume: attempt(r), "search")
        assert stop.value.code == 1
        error = capsys.readouterr().err
        assert error.startswith("search: every candidate of stage 1 failed")
        assert error.count("\n") == 1
        left = {file.name for file in path.iterdir()}
        assert not left & {"cost.npz", "cost.json", "replay.npz", "report", "policies"}
    assert list(list_stages(path)) == [0]
    data = load_report(path)
    assert data.best is None
    assert "Every candidate of a stage diverged" in render_report(data)

    # As an earlier version left it, which resumed past the failure.
    card = {"stage": 0, "index": 0, "search_cost": "Infinity", "evaluation": {}}
    (path / "cost.json").write_text(json.dumps(card))
    (path / "summary.json").write_text(json.dumps({"rows": [], "conclusion": "best"}))
    data = load_report(path)
    assert (data.best, data.replays, data.summary) == (None, (), ())


def test_random_selection_is_another_search(events):
    config = dataclasses.replace(CONFIG, selection="random", num_stages=2)
    other = results(run(config))
    same = results(events)
    assert_same_bits(other[0].candidates, same[0].candidates)
    np.testing.assert_array_equal(other[0].order, same[0].order)
    assert not np.array_equal(other[1].candidates[:2], same[1].candidates[:2])


# Slots --------------------------------------------------------------------------


def test_slots_of_a_stage(key):
    candidates = jax.random.normal(key, (4, 41))
    config = dataclasses.replace(CONFIG, cost_limit=-0.5)
    groups = stage_slots(config, key, 1, candidates)
    assert len(groups) == 2
    keys = [jax.random.key_data(group.key) for group in groups]
    for group, data in zip(groups, keys, strict=True):
        np.testing.assert_array_equal(group.cost.theta, candidates)
        assert (group.cost.limit == -0.5).all()
        named = dict(zip([t.name for t in BANK], group.cost.weights.T, strict=True))
        used = {name for name, weight in named.items() if (weight != 0).all()}
        assert used == {"extrinsic", "intrinsic"}
        assert len(np.unique(data, axis=0)) == 1  # common random numbers
    assert not np.array_equal(keys[0], keys[1])
    later = stage_slots(config, key, 2, candidates)
    assert not np.array_equal(jax.random.key_data(later[0].key), keys[0])


def test_seeds_and_references_are_slots(key):
    """Candidate by candidate, seed by seed, then references; seeds are shared."""
    candidates = jax.random.normal(key, (4, 41))
    config = dataclasses.replace(CONFIG, references=True, seeds_per_candidate=3)
    group, other = stage_slots(config, key, 1, candidates)
    keys = jax.random.key_data(group.key).reshape(6, 3, -1)
    assert len(np.unique(keys[0], axis=0)) == 3
    np.testing.assert_array_equal(keys, np.broadcast_to(keys[:1], keys.shape))
    assert not np.isin(jax.random.key_data(other.key), keys).all()
    np.testing.assert_array_equal(
        group.cost.theta[3:6], np.asarray(candidates)[[1, 1, 1]]
    )
    named = dict(zip([t.name for t in BANK], group.cost.weights.T, strict=True))
    used = {name: np.flatnonzero(weight).tolist() for name, weight in named.items()}
    assert used["extrinsic"] == list(range(18))
    assert used["intrinsic"] == list(range(12))
    assert used["safety_margin_3x"] == [15, 16, 17]


FINALS = dataclasses.replace(
    CONFIG,
    train=train_config(num_epochs=3),
    num_stages=2,
    fitness_epochs=1,
    references=True,
    judge_by="success",
    pool_scores=True,
    num_finalists=2,
    final_seeds=2,
    final_epochs=5,
)


@pytest.fixture(scope="module")
def finals_searcher():
    return make_searcher(FINALS)


@pytest.fixture(scope="module")
def finals(finals_searcher):
    return run(FINALS, searcher=finals_searcher)


def test_finalists_are_trained_afresh_in_the_same_program(finals_searcher, finals):
    events = finals
    assert [(e.stage, e.epoch) for _, e in events] == [
        (stage, epoch) for stage in range(3) for epoch in range((3, 3, 5)[stage])
    ]
    assert len(results(events)) == 2
    last = events[-1][0]
    assert int(last.stage) == FINALS.total_stages == 3
    es = last.es
    _, order = top(es, 2, pool_scores=True)
    np.testing.assert_array_equal(last.candidates[:2], es.archive[np.asarray(order)])
    begun = next(state for state, e in events if e.stage == 1 and e.epoch == 2)
    assert (int(begun.stage), int(begun.epoch)) == (2, 0)
    # Killed in the finalists' stage it goes on to the same end.
    resumed = run(FINALS, state=copy(events[7][0]), searcher=finals_searcher)
    assert_same_bits(resumed[-1][0], last)


def test_the_pure_search_trains_the_same_finalists(finals):
    events = finals
    pure = jax.jit(search(FINALS))(jax.random.key(FINALS.seed))
    assert pure.finalists.shape == (2, 41)
    np.testing.assert_allclose(pure.finalists, events[-1][0].candidates[:2], rtol=1e-6)
    assert pure.references["ep_return"].shape == (2, 2, 2)
    last = np.stack([group["ep_return"][0] for group in events[-1][1].metrics])
    dealt = deal(FINALS, is_final=True)
    np.testing.assert_allclose(
        pure.final_scores["ep_return"], dealt.table(last), atol=ACROSS_PROGRAMS
    )


def test_success_is_judged_against_the_extrinsic_cost_for_each_algorithm():
    """Fleeing agents, a useful cost, one that is safe with PPO alone, a useful one."""
    rates = [[0.0, 0.09, 0.0, 0.05, 0.8, 0.1], [0.0, 0.09, 0.8, 0.09, 0.8, 0.1]]
    ep_return = jnp.broadcast_to(jnp.array([-5.0, 6, 9, 5, 10, 1]), (3, 2, 6))
    history = make_history(jnp.zeros((3, 2, 6)), ep_return)
    history["violating_worlds"] = jnp.broadcast_to(jnp.array(rates), (3, 2, 6))
    result = stage_result(FINALS, jnp.zeros((4, 41)), history, jnp.zeros((2, 6), bool))
    far = [2 * (0.4 + 0.5) / 0.1, 0.0, (1 - 0.125) / 0.125, 0.0]
    np.testing.assert_allclose(result.fitness.cost, far, rtol=1e-5)
    assert result.order.tolist() == [1, 3, 2, 0]  # of two at the aims the bolder one
    assert result.references["ep_return"].tolist() == [[10.0, 1.0]] * 2


def test_a_broken_reference_sets_no_bars():
    """Seeds that froze are left out; an algorithm without any other judges nothing."""
    config = dataclasses.replace(FINALS, seeds_per_candidate=2, num_finalists=0)
    ep_return = jnp.broadcast_to(jnp.arange(12.0), (3, 2, 12))
    history = make_history(jnp.zeros((3, 2, 12)), ep_return)
    frozen = jnp.zeros((2, 12), bool).at[0, 8].set(True).at[1, 8:10].set(True)
    result = stage_result(config, jnp.zeros((4, 41)), history, frozen)
    np.testing.assert_array_equal(result.references["ep_return"][:, 0], [9.0, np.nan])
    aim = 0.4 * 9.0  # of PPO-Lagrangian alone; its bar lies 0.9 below
    far = (aim - np.array([0.5, 2.5, aim, aim])) / 0.9
    np.testing.assert_allclose(result.fitness.cost, far, rtol=1e-5, atol=1e-6)


def test_the_label_names_the_rule_that_picked():
    judged = dataclasses.replace(CONFIG, references=True, judge_by="success")
    assert pick_label(judged, is_zero=True) == "closest to success"
    assert pick_label(CONFIG, is_zero=True) == "zero violation, highest return"
    assert pick_label(CONFIG, is_zero=False) == "lowest cost"
    assert pick_label(CONFIG, False, True) == "fewest violating episodes"
    compared = dataclasses.replace(CONFIG, references=True)
    assert pick_label(compared, True, True) == "closest to success"


def test_a_candidate_is_judged_by_the_mean_over_its_seeds():
    config = dataclasses.replace(CONFIG, seeds_per_candidate=2)
    cost = jnp.broadcast_to(jnp.arange(8.0), (6, 2, 8))
    frozen = jnp.zeros((2, 8), bool).at[0, 7].set(True)
    result = stage_result(config, jnp.zeros((4, 41)), make_history(cost, cost), frozen)
    assert result.fitness.cost.tolist() == [0.5, 2.5, 4.5, np.inf]
    assert result.frozen.tolist() == [[False, False, False, True], [False] * 4]


def test_a_longer_bank_of_a_user():
    bank = (*BANK, CostTerm("extra", lambda inputs, theta: inputs.cost))
    config = search_config(num_stages=1)
    events = run(config, searcher=make_searcher(config, bank=bank))
    assert np.isfinite(results(events)[0].fitness.cost).all()
