"""The demo: shipped policies that do what their card says, side by side."""

import numpy as np
import pytest

from autocost_jax import cost_card
from autocost_jax.viz.demo import FOUND, write_demo

pytestmark = pytest.mark.optimised


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return write_demo(tmp_path_factory.mktemp("demo"), seed=0, num_episodes=20)


def test_the_page_shows_both_and_says_how_they_do(demo):
    page = demo.page.read_text()
    assert demo.page.name == "index.html"
    assert page.startswith("<!doctype html>") or page.startswith("<!DOCTYPE html>")
    assert "http://" not in page.replace("http://www.w3.org", "")
    for line in demo.lines:
        assert line in page
    assert "extrinsic cost alone" in demo.lines[0]
    assert FOUND in demo.lines[1]


def test_the_shipped_policies_are_as_their_card_says(demo):
    """Returns of 20 episodes; the card's are of 200."""
    card = cost_card(FOUND)
    for line, scores in zip(
        demo.lines, (card["extrinsic_alone"], card["evaluation"]), strict=True
    ):
        shown = float(line.split("return ")[1].split(",")[0])
        expect = scores["cpo"]["by_seed"]["return"][0]  # the shipped seed
        np.testing.assert_allclose(shown, expect, rtol=0.25)
    rates = [int(line.split("%")[0].split()[-1]) for line in demo.lines]
    assert rates[1] < rates[0] / 2
