"""What experiments/agreement.py compares and how it counts, without training."""

import dataclasses

import numpy as np
import pytest

from scripts import load_script

agreement = load_script("experiments/agreement")


@pytest.mark.parametrize("name", [n for n in agreement.VARIANTS if n != "plain"])
def test_a_variant_changes_one_thing(name):
    def settings(name):
        config = agreement.variant(name, smoke=False)
        flat = dataclasses.asdict(config)
        env, agent = flat.pop("env"), flat.pop("agent")
        return flat | env | agent

    plain, other = settings(agreement.PLAIN), settings(name)
    changed = [key for key in plain if plain[key] != other[key]]
    assert len(changed) == 1
    assert plain["physics"] == "closed_form"
    assert plain["critic_precision"] == "float32"


def test_differences_are_taken_seed_by_seed():
    plain = [10.0, 20.0, 30.0]
    gap = agreement.difference([11.0, 21.0, 31.0], plain)
    assert gap["mean"] == gap["low"] == gap["high"] == 1.0
    wide = agreement.difference([12.0, 20.0, 31.0], plain)
    assert wide["low"] < 0 < wide["high"]
    half = 4.302653 * np.std([2, 0, 1], ddof=1) / np.sqrt(3)  # t of 2 degrees, 97.5 %
    assert wide["high"] == pytest.approx(1.0 + half, rel=1e-6)
