"""The walk that tunes: where it ends no neighbour is better, and it says which axes ended it."""

import math

import numpy as np
import pytest

from benchmarks import _tuning
from benchmarks._tuning import Rates, geometric_mean, walk


def cost_around(**best):
    """A cost that is least at these settings, in the logarithm of each; and what was asked."""
    asked = []

    def cost(settings):
        asked.append(settings)
        return sum(math.log(settings[name] / value) ** 2 for name, value in best.items())

    return cost, asked


AXES = {"rate": Rates(0.1), "lam": (1.0, 3.0, 10.0, 30.0)}
START = {"rate": 0.1, "lam": 10.0}


def test_it_finds_the_least_of_the_grid_and_asks_once():
    cost, asked = cost_around(rate=0.012, lam=2.9)
    found = walk(cost, AXES, START)
    assert found.settings == {"rate": 0.0125, "lam": 3.0}  # the power of two that is nearest
    assert found.cost == cost(found.settings)
    assert found.ends == ()
    told = [tuple(settings.items()) for settings in asked[:-1]]
    assert len(set(told)) == len(told) == found.tried


@pytest.mark.parametrize(("lam", "ends"), [(0.1, ("lam",)), (500.0, ("lam",)), (9.0, ())])
def test_an_end_is_named_and_rates_have_none(lam, ends):
    found = walk(cost_around(rate=1e-4, lam=lam)[0], AXES, START)
    assert found.ends == ends
    assert found.settings["rate"] == pytest.approx(1e-4, rel=math.sqrt(_tuning.RATIO) - 1)


def test_no_neighbour_is_better_where_axes_go_together():
    cost = lambda at: math.log(at["rate"] * at["lam"]) ** 2 + 0.1 * math.log(at["rate"] / 0.05) ** 2
    found = walk(cost, AXES, START)
    for name, factor in (("rate", 2), ("rate", 0.5)):
        other = found.settings | {name: found.settings[name] * factor}
        assert cost(other) >= found.cost
    for lam in AXES["lam"]:
        if abs(AXES["lam"].index(lam) - AXES["lam"].index(found.settings["lam"])) == 1:
            assert cost(found.settings | {"lam": lam}) >= found.cost


def test_what_diverges_is_never_chosen_and_ends_a_walk():
    cost = lambda at: math.nan if at["rate"] > 0.5 else 1 / at["rate"]
    assert walk(cost, {"rate": Rates(0.1)}, {"rate": 0.1}).settings == {"rate": 0.4}
    everywhere = walk(lambda at: math.nan, AXES, START)
    assert everywhere.settings == START
    assert everywhere.cost == math.inf


def test_a_walk_may_begin_where_another_one_ended():
    first = walk(cost_around(rate=0.012, lam=2.9)[0], AXES, START)
    again = walk(cost_around(rate=0.012, lam=2.9)[0], AXES, first.settings)
    assert again.settings == first.settings
    assert again.tried == 1 + 2 + 2  # itself and its neighbours


def test_seeds_that_tune_are_not_scored():
    assert list(_tuning.seeds(2)) == [1000, 1001]


def test_the_geometric_mean_is_that_of_errors_above_the_floor():
    assert geometric_mean([1.0, 100.0]) == pytest.approx(10)
    assert geometric_mean([0.0, 1.0], floor=0.01) == pytest.approx(0.1)
    assert geometric_mean([0.0, 1.0]) == 0
    assert math.isinf(geometric_mean([np.inf, 1.0]))
