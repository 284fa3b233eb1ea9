"""The run directory: exact round trips, and one clear line for whatever is wrong."""

import dataclasses
import errno
import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
import pytest
import yaml

from autocost_jax import files as arrays
from autocost_jax.config import PRESETS, SearchConfig, preset
from autocost_jax.runs import checkpoints
from autocost_jax.runs import directory as store
from autocost_jax.runs.directory import ArraySpec, DiskFullError, RunDir, RunDirError

FACTS = store.run_facts(0)
SMOKE = preset("smoke")
THETA = ArraySpec(("P", 41), "float32", finite=True)


def make_tree(seed: int = 0) -> dict[str, Any]:
    """A state with every kind of leaf a checkpoint has to keep."""
    key = jax.random.key(seed)
    params = {"w": jax.random.normal(key, (3, 4)), "b": jnp.zeros(0)}
    nan_payload = np.array([0x7FC12345, 0xFF800000, 0x80000000], np.uint32)
    return {
        "params": params,
        "opt": optax.adam(1e-3).init(params),
        "keys": jax.random.split(key, 3),
        "rbg": jax.random.key(seed, impl="rbg"),
        "no_keys": jax.random.split(key, 1)[:0],
        "epoch": jnp.int32(7),
        "ok": jnp.array([True, False]),
        "odd": jnp.asarray(nan_payload.view(np.float32)),
        "zeros": -jnp.zeros(5),
        "wide": np.array([1.0, np.nan, np.inf], np.float64),
        "count": np.arange(4, dtype=np.uint32),
    }


def assert_same_bits(a: Any, b: Any) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert type(x) is type(y)
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert not getattr(y, "weak_type", False)
        for name, value in arrays.flatten([x]).items():
            assert value.tobytes() == arrays.flatten([y])[name].tobytes()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunDir]:
    with RunDir.create(tmp_path / "run", SMOKE, FACTS) as created:
        yield created


def step_dir(run: RunDir, step: int) -> Path:
    return run.path / "checkpoints" / f"step_{step:08d}"


# Configuration


@pytest.mark.parametrize("name", PRESETS)
def test_config_survives_yaml(name: str) -> None:
    config = preset(name)
    text = yaml.safe_dump(store.to_dict(config))
    again = store.from_dict(SearchConfig, yaml.safe_load(text))
    assert again == config
    assert store.config_hash(again) == store.config_hash(config)


@dataclass(frozen=True)
class Inner:
    size: float | int | None = None
    pair: tuple[int, float] | None = (1, 2.0)


@dataclass(frozen=True)
class Odd:
    inner: Inner = dataclasses.field(default_factory=Inner)
    kind: Literal["a", "b"] = "a"
    names: tuple[str, ...] = ()
    rate: float = 1e-5
    flag: bool = True


@pytest.mark.parametrize(
    "config",
    [
        Odd(),
        Odd(Inner(0.1 + 0.2, None), "b", ("x", "1"), float("inf"), False),
        Odd(Inner(3, (2, 1e300)), rate=-0.0),
        Odd(rate=1),
    ],
)
def test_odd_fields_survive_yaml(config: Odd) -> None:
    text = yaml.safe_dump(store.to_dict(config))
    again = store.from_dict(Odd, yaml.safe_load(text))
    assert again == config
    assert str(again.rate) == str(float(config.rate))
    assert store.config_hash(again) == store.config_hash(config)


def test_hash_tells_configs_apart() -> None:
    assert store.config_hash(Odd(rate=2.0)) != store.config_hash(Odd())
    assert store.config_hash(Odd(names=("a",))) != store.config_hash(Odd())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"colour": 1}, ["unknown field colour", "kind, names, rate"]),
        ({"inner": {"size": 1}}, ["missing field inner.pair", "size, pair"]),
        ({"kind": "c"}, ["kind must be one of a, b", "'c'"]),
        ({"rate": "fast"}, ["rate must be a float", "'fast'"]),
        ({"rate": True}, ["rate must be a float"]),
        ({"flag": 1}, ["flag must be a bool"]),
        ({"names": "abc"}, ["names must be a list"]),
        ({"inner": {"size": None, "pair": [1]}}, ["inner.pair must have 2 entries"]),
        ({"inner": 3}, ["inner must be a mapping"]),
    ],
)
def test_bad_config_is_named(change: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError, match=words[0]) as caught:
        store.from_dict(Odd, {**store.to_dict(Odd()), **change})
    assert all(word in str(caught.value) for word in words), caught.value
    assert "\n" not in str(caught.value)


def test_number_that_yaml_takes_for_text() -> None:
    data = {**store.to_dict(Odd()), "rate": yaml.safe_load("4e-4")}
    assert store.from_dict(Odd, data).rate == 4e-4


# The directory


def test_create_writes_config_and_facts(run: RunDir) -> None:
    config, facts = store.read_config(run.path)
    assert config == SMOKE
    assert facts == FACTS
    assert facts["versions"]["jax"] == jax.__version__
    assert facts["device"]
    assert not list(run.path.glob(".tmp-*"))


def test_create_refuses_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("mine")
    fake = tmp_path / "fake"
    fake.mkdir()
    (fake / "config.yaml").write_text("a: 1")
    for name, words in (
        ("foreign", "not empty and not a run"),
        ("file", "is a file"),
        ("fake", "not written by this package"),
        ("file/below", "cannot be written"),
    ):
        with pytest.raises(RunDirError, match=words):
            RunDir.create(tmp_path / name, SMOKE, FACTS, overwrite=True)
    assert sorted(os.listdir(tmp_path / "foreign")) == ["thesis.tex"]
    assert os.listdir(fake) == ["config.yaml"]


def test_create_refuses_a_run_but_may_overwrite_it(run: RunDir) -> None:
    run.log_metrics({"a": 1}, 0)
    run.write_stage(0, {"theta": np.zeros(3)})
    run.save_checkpoint({"a": jnp.ones(2)}, 1)
    run.write_json("summary", {"rows": []})
    run.write_arrays("replay_best_cpo", {"a": np.zeros(1)})
    (run.path / "notes.txt").write_text("mine")
    run.close()
    with pytest.raises(RunDirError, match="already holds a run"):
        RunDir.create(run.path, SMOKE, FACTS)
    assert store.list_stages(run.path)
    other = dataclasses.replace(SMOKE, seed=5)
    with RunDir.create(run.path, other, FACTS, overwrite=True):
        assert store.read_config(run.path)[0] == other
    assert sorted(os.listdir(run.path)) == ["config.yaml", "lock", "notes.txt"]


def test_create_in_what_a_kill_left(tmp_path: Path) -> None:
    (tmp_path / "lock").write_text("pid 1 on gone")
    (tmp_path / ".tmp-1-config.yaml").write_text("half")
    RunDir.create(tmp_path, SMOKE, FACTS).close()
    assert sorted(os.listdir(tmp_path)) == ["config.yaml", "lock"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no config.yaml"),
        (b"a: [", "not readable"),
        (b"\xff\xfe\x00", "not readable"),
        (b"format: other", "not written by this package"),
        (b"format: autocost_jax run 1\nconfig: {seed: 1}", "missing field train"),
        (b"format: autocost_jax run 1\nconfig: {}\nfacts: []", "not a mapping"),
        ("directory", "not readable"),
    ],
)
def test_open_refuses_foreign_directories(
    tmp_path: Path, content: bytes | str | None, words: str
) -> None:
    if isinstance(content, bytes):
        (tmp_path / "config.yaml").write_bytes(content)
    elif content:
        (tmp_path / "config.yaml").mkdir()
    with pytest.raises(RunDirError, match=words) as caught:
        RunDir.open(tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "lock").exists()


def test_open_names_the_first_difference(run: RunDir) -> None:
    run.close()
    train = dataclasses.replace(SMOKE.train, num_worlds=4)
    other = dataclasses.replace(SMOKE, train=train, seed=9)
    with pytest.raises(RunDirError, match=r"train\.num_worlds=2.*train\.num_worlds=4"):
        RunDir.open(run.path, other)
    with RunDir.open(run.path, SMOKE) as again:
        assert again.config == SMOKE
        assert again.warnings == []


def test_open_lets_population_chunk_differ(run: RunDir) -> None:
    """It is used; the recorded configuration and the checkpoints stay as they are."""
    run.save_checkpoint({"a": jnp.ones(1)}, 1)
    run.close()
    recorded = (run.path / "config.yaml").read_bytes()
    train = dataclasses.replace(SMOKE.train, population_chunk=3)
    other = dataclasses.replace(SMOKE, train=train)
    with RunDir.open(run.path, other) as again:
        assert again.config.train.population_chunk == 3
        found = again.resume({"a": jnp.ones(1)})
        assert found is not None
        assert found.step == 1
        again.save_checkpoint({"a": jnp.ones(1)}, 2)
    assert (run.path / "config.yaml").read_bytes() == recorded
    with RunDir.open(run.path) as again:
        found = again.resume({"a": jnp.ones(1)})
        assert found is not None
        assert (found.step, found.warnings) == (2, [])
    both = dataclasses.replace(other, seed=9)
    with pytest.raises(RunDirError, match="seed=0"):
        RunDir.open(run.path, both)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        (
            {"versions": {**FACTS["versions"], "jax": "0.0.1"}},
            f"jax 0.0.1 -> {jax.__version__}",
        ),
        ({"num_devices": 64}, f"num_devices 64 -> {len(jax.devices())}"),
    ],
)
def test_open_warns_of_other_versions_and_devices(
    tmp_path: Path, facts: dict[str, Any], words: str
) -> None:
    """Another number of devices is another program, with other last bits."""
    RunDir.create(tmp_path, SMOKE, {**FACTS, **facts}).close()
    with RunDir.open(tmp_path) as again:
        (warning,) = again.warnings
        assert words in warning


HOLDER = """
import sys
from autocost_jax.runs.directory import RunDir
run = RunDir.open(sys.argv[1])
print("held", flush=True)
sys.stdin.read()
"""


def test_lock_holds_until_the_other_process_is_killed(run: RunDir) -> None:
    run.close()
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(run.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(RunDirError, match=f"in use by pid {other.pid}"):
            RunDir.open(run.path)
        with pytest.raises(RunDirError, match="in use"):
            RunDir.create(run.path, SMOKE, FACTS, overwrite=True)
        assert store.read_config(run.path)[0] == SMOKE  # readers need no lock
        other.kill()
        other.wait()
    RunDir.open(run.path).close()


@pytest.mark.parametrize("name", ["lock", "metrics.jsonl"])
def test_nothing_is_written_through_a_link(
    run: RunDir, tmp_path: Path, name: str
) -> None:
    run.close()
    (run.path / name).unlink(missing_ok=True)
    mine = tmp_path / "thesis.txt"
    mine.write_text("mine")
    (run.path / name).symlink_to(mine)
    with (
        pytest.raises(RunDirError, match=f"{name} is a link"),
        RunDir.open(run.path) as again,
    ):
        again.truncate_metrics(0)
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("missing", ["module", "system call"])
def test_without_locks_a_run_goes_on_with_a_warning(
    run: RunDir, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    """On some network file systems, and on Windows."""

    def flock(*_: int) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    run.close()
    without = SimpleNamespace(flock=flock, LOCK_EX=2, LOCK_NB=4)
    fcntl = None if missing == "module" else without
    monkeypatch.setattr("autocost_jax.files.fcntl", fcntl)
    with RunDir.open(run.path) as again:
        (warning,) = again.warnings
        assert "without locks" in warning
        again.log_metrics({"loss": 1.0}, 0)
    with RunDir.create(run.path, SMOKE, FACTS, overwrite=True) as new:
        assert "without locks" in new.warnings[0]


# Checkpoints


def test_checkpoint_keeps_every_bit(run: RunDir) -> None:
    tree = make_tree()
    run.log_metrics({"loss": 1.0}, 0)
    run.save_checkpoint(tree, 3, {"stage": 1, "epoch": 2})
    found = run.resume(make_tree(1))
    assert found is not None
    assert_same_bits(found.tree, tree)
    assert (found.step, found.extra, found.warnings) == (
        3,
        {"stage": 1, "epoch": 2},
        [],
    )
    assert found.metrics_bytes == (run.path / "metrics.jsonl").stat().st_size
    abstract = jax.eval_shape(lambda: {k: v for k, v in tree.items() if k != "wide"})
    run.save_checkpoint({k: v for k, v in tree.items() if k != "wide"}, 4)
    found = run.resume(abstract)
    assert found is not None
    assert jnp.array_equal(found.tree["keys"], tree["keys"])
    assert isinstance(found.tree["opt"][0], type(tree["opt"][0]))


def test_only_the_last_three_stay(run: RunDir) -> None:
    for step in range(5):
        run.save_checkpoint({"a": jnp.full(2, float(step))}, step)
    folder = run.path / "checkpoints"
    assert checkpoints.list_steps(folder) == [2, 3, 4]
    assert len(os.listdir(folder)) == 3


def test_same_step_again_replaces_it(run: RunDir) -> None:
    for value in (1.0, 2.0):
        run.save_checkpoint({"a": jnp.float32(value)}, 1)
    found = run.resume({"a": jnp.float32(0)})
    assert found is not None
    assert found.tree["a"] == 2.0


@pytest.mark.parametrize("damage", ["flip", "remove", "truncate", "add"])
def test_damage_to_any_file_is_seen(run: RunDir, damage: str) -> None:
    for step in (1, 2):
        run.save_checkpoint({"a": jnp.arange(8.0) * step, "b": jnp.ones(1)}, step)
    files = [file for file in step_dir(run, 2).rglob("*") if file.is_file()]
    assert step_dir(run, 2) / "manifest.json" in files
    assert len(files) > 3
    for file in files:
        intact = file.read_bytes()
        if damage == "flip":
            middle = len(intact) // 2
            flipped = bytes([intact[middle] ^ 1])
            file.write_bytes(intact[:middle] + flipped + intact[middle + 1 :])
        elif damage == "remove":
            file.unlink()
        elif damage == "truncate":
            file.write_bytes(intact[:-1])
        else:
            file.with_name("extra").write_bytes(b"x")
        found = run.resume({"a": jnp.zeros(8), "b": jnp.zeros(1)})
        assert found is not None
        assert found.step == 1, file
        assert len(found.warnings) == 1
        assert "step_00000002 is broken" in found.warnings[0]
        assert "\n" not in found.warnings[0]
        file.with_name("extra").unlink(missing_ok=True)
        file.write_bytes(intact)
    found = run.resume({"a": jnp.zeros(8), "b": jnp.zeros(1)})
    assert found is not None
    assert (found.step, found.warnings) == (2, [])


def test_every_byte_of_the_manifest_counts(run: RunDir) -> None:
    run.save_checkpoint({"a": jnp.ones(1)}, 1)
    file = step_dir(run, 1) / "manifest.json"
    intact = file.read_bytes()
    for place in range(0, len(intact), 3):
        flipped = bytes([intact[place] ^ 1])
        file.write_bytes(intact[:place] + flipped + intact[place + 1 :])
        with pytest.raises(RunDirError, match="no checkpoint is whole"):
            run.resume({"a": jnp.ones(1)})


def test_after_a_fall_back_the_broken_one_goes(run: RunDir) -> None:
    for step in (1, 2, 3):
        run.save_checkpoint({"a": jnp.float32(step)}, step)
    for step in (2, 3):
        (step_dir(run, step) / "manifest.json").unlink()
    found = run.resume({"a": jnp.float32(0)})
    assert found is not None
    assert (found.step, len(found.warnings)) == (1, 2)
    run.save_checkpoint({"a": jnp.float32(2)}, 2)
    assert checkpoints.list_steps(run.path / "checkpoints") == [1, 2]


def test_checkpoint_of_another_config_is_not_used(run: RunDir) -> None:
    run.save_checkpoint({"a": jnp.ones(1)}, 1)
    run.close()
    text = (run.path / "config.yaml").read_text()
    (run.path / "config.yaml").write_text(text.replace("seed: 0", "seed: 1"))
    with (
        RunDir.open(run.path) as again,
        pytest.raises(RunDirError, match="config_hash"),
    ):
        again.resume({"a": jnp.ones(1)})


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ({"a": jnp.ones(3), "k": jax.random.key(0)}, "a must be float32.3., got"),
        ({"a": jnp.ones(2, jnp.int32), "k": jax.random.key(0)}, "a must be int32"),
        ({"a": jnp.ones(2), "k": jax.random.key(0, impl="rbg")}, "k must be key<rbg>"),
        ({"a": jnp.ones(2)}, "k must be nothing"),
        (
            {"a": jnp.ones(2), "k": jax.random.key(0), "new": jnp.ones(1)},
            "new must be float32.1., got nothing",
        ),
    ],
)
def test_template_that_does_not_fit(run: RunDir, template: Any, words: str) -> None:
    run.save_checkpoint({"a": jnp.ones(2), "k": jax.random.key(0)}, 1)
    with pytest.raises(RunDirError, match=words):
        run.resume(template)


def test_only_arrays_are_saved(run: RunDir) -> None:
    for leaf in (1.0, "text", np.array([None]), jnp.ones(1, jnp.bfloat16)):
        with pytest.raises(RunDirError, match=r"a/0: only arrays"):
            run.save_checkpoint({"a": [leaf]}, 1)
    with pytest.raises(RunDirError, match="have the path a/b"):
        run.save_checkpoint({"a": {"b": jnp.ones(1)}, "a/b": jnp.ones(1)}, 1)


def test_what_a_kill_left_is_ignored_and_cleaned(
    run: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.save_checkpoint({"a": jnp.ones(1)}, 1)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "remove", lambda path: None)
        patch.setattr(checkpoints, "_dump", lambda manifest: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run.save_checkpoint({"a": jnp.ones(1)}, 2)
    left = run.path / "checkpoints" / ".tmp-step_00000002"
    assert (left / "arrays").is_dir()
    found = run.resume({"a": jnp.ones(1)})
    assert found is not None
    assert (found.step, found.warnings) == (1, [])
    run.close()
    RunDir.open(run.path).close()
    assert not left.exists()


WRITER = """
import sys
import numpy as np
from autocost_jax.runs.directory import RunDir
with RunDir.open(sys.argv[1]) as run:
    for step in range(1, 10**6):
        run.log_metrics({"a": step}, step)
        run.save_checkpoint({"a": np.full(1000, step, np.int32)}, step)
        print(step, flush=True)
"""


def test_kill_in_the_middle_of_writing(run: RunDir) -> None:
    run.close()
    command = [sys.executable, "-c", WRITER, str(run.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for _ in range(5):
            writer.stdout.readline()
        writer.kill()
        last = max([5, *(int(line) for line in writer.stdout if line.endswith("\n"))])
    with RunDir.open(run.path) as again:
        found = again.resume({"a": np.zeros(1000, np.int32)})
        assert found is not None
        assert found.warnings == []
        assert found.step in (last, last + 1)
        assert (found.tree["a"] == found.step).all()
        steps = [row["step"] for row in store.read_metrics(run.path)]
        assert steps == list(range(1, found.step + 1))


def raise_orbax(*_: Any, **__: Any) -> None:
    raise ValueError("RESOURCE_EXHAUSTED: ... No space left on device [os_error_code]")


def raise_system(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("target", "name", "replacement"),
    [
        (ocp.Checkpointer, "save", raise_orbax),
        (checkpoints, "write_atomic", raise_system),
        (os, "fsync", raise_system),
    ],
)
def test_full_disk_leaves_the_last_checkpoint(
    run: RunDir,
    monkeypatch: pytest.MonkeyPatch,
    target: Any,
    name: str,
    replacement: Any,
) -> None:
    run.save_checkpoint({"a": jnp.ones(1)}, 1)
    with monkeypatch.context() as patch:
        patch.setattr(target, name, replacement)
        with pytest.raises(DiskFullError, match="the disk is full") as caught:
            run.save_checkpoint({"a": jnp.ones(1)}, 2)
    assert "\n" not in str(caught.value)
    assert os.listdir(run.path / "checkpoints") == ["step_00000001"]
    found = run.resume({"a": jnp.ones(1)})
    assert found is not None
    assert (found.step, found.warnings) == (1, [])


def test_space_is_checked_before_writing(
    run: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = make_tree()
    estimate = store.estimate_bytes(tree)
    path = run.save_checkpoint(tree, 1)
    used = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    assert used <= estimate <= 10 * used
    big = {"a": jax.ShapeDtypeStruct((1000, 1000), jnp.float32)}
    assert 4_000_000 <= store.estimate_bytes(big) <= 4_100_000
    usage = os.statvfs(run.path)
    with pytest.raises(DiskFullError, match="MB left"):
        store.check_free_space(
            run.path / "not" / "yet", usage.f_frsize * usage.f_blocks
        )
    monkeypatch.setattr(checkpoints, "estimate_bytes", lambda _: 2**62)
    with pytest.raises(DiskFullError, match="MB are needed"):
        run.save_checkpoint(tree, 2)


QUIET = """
import sys, warnings
warnings.simplefilter("error")
import numpy as np
from autocost_jax.config import preset
from autocost_jax.runs.directory import RunDir
with RunDir.create(sys.argv[1], preset("smoke")) as run:
    run.save_checkpoint({"a": np.ones(3, np.float32)}, 1)
    run.resume({"a": np.ones(3, np.float32)})
"""


def test_checkpoints_are_silent(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", QUIET, str(tmp_path)], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# Metrics


def test_metrics_round_trip_as_strict_json(run: RunDir) -> None:
    run.log_metrics({"a": np.float32(0.1), "b": [1, jnp.inf], "c": jnp.arange(2)}, 4)
    run.log_metrics({"a": float("nan"), "b": -np.inf, "name": "x"}, 5)

    def refuse(text: str) -> None:
        raise AssertionError(text)

    for line in (run.path / "metrics.jsonl").read_text().splitlines():
        json.loads(line, parse_constant=refuse)
    first, second = store.read_metrics(run.path)
    assert first == {
        "step": 4,
        "a": float(np.float32(0.1)),
        "b": [1, np.inf],
        "c": [0, 1],
    }
    assert np.isnan(second["a"])
    assert (second["b"], second["name"]) == (-np.inf, "x")


def test_full_disk_leaves_whole_lines(
    run: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    class HalfFull(io.FileIO):
        def write(self, data: Any) -> int:
            if len(data) < 20:  # the second half of the line no longer fits
                raise_system()
            return super().write(data[:-10])

    run.log_metrics({"a": 1}, 0)
    with monkeypatch.context() as patch:
        half = HalfFull(run.path / "metrics.jsonl", "ab")
        patch.setattr(run, "_metrics", half)
        with pytest.raises(DiskFullError, match=r"metrics\.jsonl"):
            run.log_metrics({"a": "a line of some length"}, 1)
        half.close()
    run.log_metrics({"a": 2}, 1)
    assert [row["a"] for row in store.read_metrics(run.path)] == [1, 2]


def test_torn_last_line_is_left_out(run: RunDir) -> None:
    assert store.read_metrics(run.path) == []
    run.log_metrics({"a": 1}, 0)
    with (run.path / "metrics.jsonl").open("ab") as file:
        file.write(b'{"step": 1, "a"')
    assert store.read_metrics(run.path) == [{"step": 0, "a": 1}]
    with (run.path / "metrics.jsonl").open("ab") as file:
        file.write(b'\n{"step": 2}\n')
    with pytest.raises(RunDirError, match="line 2"):
        store.read_metrics(run.path)


def test_resume_cuts_metrics_to_the_checkpoint(run: RunDir) -> None:
    run.log_metrics({"a": 0}, 0)
    run.save_checkpoint({"a": jnp.ones(1)}, 0)
    run.log_metrics({"a": 1}, 1)
    run.close()
    with RunDir.open(run.path) as again:
        assert len(store.read_metrics(run.path)) == 2
        again.resume({"a": jnp.ones(1)})
        assert len(store.read_metrics(run.path)) == 1
        again.log_metrics({"a": 2}, 1)
        assert [row["a"] for row in store.read_metrics(run.path)] == [0, 2]
        (run.path / "metrics.jsonl").write_text("")
        found = again.resume({"a": jnp.ones(1)})
        assert found is not None
        assert "lost" in found.warnings[0]


def test_resume_before_the_first_checkpoint_starts_again(run: RunDir) -> None:
    run.log_metrics({"a": 0}, 0)
    assert run.resume({"a": jnp.ones(1)}) is None
    assert store.read_metrics(run.path) == []


def read_events(path: Path) -> list[Any]:
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    events = []
    for file in sorted(path.glob("events*")):
        data = file.read_bytes()
        while data:  # TFRecord: length, its crc, the event, its crc
            (length,) = struct.unpack("<Q", data[:8])
            events.append(event_pb2.Event.FromString(data[12 : 12 + length]))
            data = data[16 + length :]
    return events


def test_tensorboard_events_are_superseded_on_resume(run: RunDir) -> None:
    pytest.importorskip("tensorboardX")
    assert run.start_tensorboard() is None
    run.log_metrics({"a": 1.0, "name": "x", "b": jnp.arange(3.0)}, 0)
    run.close()
    events = read_events(run.path / "tensorboard")
    values = {v.tag: v.simple_value for event in events for v in event.summary.value}
    assert values == {"a": 1.0, "b": 1.0}
    with RunDir.open(run.path) as again:
        again.start_tensorboard(purge_step=7)
        again.log_metrics({"a": 2.0}, 7)
    events = read_events(run.path / "tensorboard")
    assert any(e.HasField("session_log") and e.step == 7 for e in events)


def test_without_tensorboard_there_is_a_hint(
    run: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert "pip install tensorboardX" in (run.start_tensorboard() or "")
    run.log_metrics({"a": 1.0}, 0)
    assert not (run.path / "tensorboard").exists()


# Artifacts


def test_artifacts_round_trip(run: RunDir) -> None:
    theta = np.arange(82, dtype=np.float32).reshape(2, 41)
    stage = {"theta": jnp.asarray(theta), "archive/cost": np.array([0.0, np.inf])}
    for number in (10, 0, 2):
        run.write_stage(number, stage)
    assert list(store.list_stages(run.path)) == [0, 2, 10]
    file = store.list_stages(run.path)[2]
    assert file.name == "stage_02.npz"
    spec = {"theta": THETA, "archive/cost": ArraySpec(("P",), "float64")}
    loaded = store.load_arrays(file, spec)
    assert np.array_equal(loaded["theta"], theta)
    intact = file.read_bytes()
    assert run.write_stage(2, stage).read_bytes() == intact

    run.write_cost({"theta": theta[0]}, {"cost": np.float32(np.inf), "stage": 1})
    assert json.loads((run.path / "cost.json").read_text())["cost"] == "Infinity"
    assert store.load_arrays(run.path / "cost.npz")["theta"].shape == (41,)

    params = {"net": ({"w": jnp.ones((2, 3))}, jnp.zeros(2)), "key": jax.random.key(3)}
    path = run.write_policy("best", params)
    assert path == run.path / "policies" / "best.npz"
    assert_same_bits(arrays.unflatten(store.load_arrays(path), params), params)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"theta": np.ones((2, 40), np.float32)}, "theta must be float32.2, 41."),
        ({"theta": np.ones(41, np.float32)}, "theta must be float32.P, 41."),
        ({"theta": np.ones((2, 41))}, "theta must be float32"),
        ({"theta": np.full((2, 41), np.nan, np.float32)}, "theta must be finite"),
        ({"other": np.ones(1)}, "theta is missing"),
        (
            {"theta": np.ones((2, 41), np.float32), "more": np.ones(1)},
            "more is unknown",
        ),
    ],
)
def test_artifact_that_is_not_as_specified(
    tmp_path: Path, content: dict[str, Any], words: str
) -> None:
    file = tmp_path / "stage_00.npz"
    store.save_arrays(file, content)
    with pytest.raises(RunDirError, match=words) as caught:
        store.load_arrays(file, {"theta": THETA})
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_lengths_must_agree(tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    store.save_arrays(file, {"a": np.ones(2), "b": np.ones(3)})
    spec = {name: ArraySpec(("P",), "float64") for name in "ab"}
    with pytest.raises(RunDirError, match=r"b must be float64\[2\], got float64\[3\]"):
        store.load_arrays(file, spec)
    store.load_arrays(file, {n: ArraySpec((None,), "float64") for n in "ab"})


class Bomb:
    def __reduce__(self) -> tuple:
        return (os.mkdir, ("exploded",))


def test_unreadable_and_pickled_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("pickled.npz", theta=np.array([Bomb()], object))
    np.save("bare", np.ones(3))
    Path("noise.npz").write_bytes(b"PK\x03\x04 nothing here")
    Path("empty.npz").write_bytes(b"")
    for name in ("pickled.npz", "bare.npy", "noise.npz", "empty.npz", "absent.npz"):
        with pytest.raises(RunDirError, match=name) as caught:
            store.load_arrays(Path(name))
        assert "\n" not in str(caught.value)
    assert not Path("exploded").exists()


def test_a_failed_write_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.npz"
    store.save_arrays(file, {"a": np.ones(2)})
    monkeypatch.setattr(os, "fsync", raise_system)
    with pytest.raises(DiskFullError, match=r"a\.npz"):
        store.save_arrays(file, {"a": np.zeros(2)})
    assert os.listdir(tmp_path) == ["a.npz"]
    assert store.load_arrays(file)["a"].all()


def test_what_cannot_be_made_again_is_named(tmp_path):
    """Before a resumed run trains to its end, not after."""
    with RunDir.create(tmp_path / "run", preset("smoke"), {}) as run:
        for number in range(3):
            run.write_stage(number, {"theta": np.zeros(3)})
            run.log_metrics({"cost": number}, number)
        assert run.damages(3) == []
        (run.path / "stage_00.npz").unlink()
        os.truncate(run.path / "stage_02.npz", 50)
        with (run.path / "metrics.jsonl").open("r+b") as file:
            file.write(b"[")
        lines = run.damages(3)
    words = ("stage_00.npz", "stage_02.npz", "line 1 is not")
    assert len(lines) == len(words)
    for line, word in zip(lines, words, strict=True):
        assert word in line
