"""The studies of published methods and of peers: what their numbers say, in tables and pictures."""

import pytest

from benchmarks.studies import papers, peers


def took(median, solved=6):
    return {"solved": solved, "median": median, "lower": median, "upper": median}


def task(ours, **others):
    lines = {
        name: {
            "title": name.upper(),
            "one setting": took(one),
            "best": took(best),
            "settings": {"rate": 0.3},
            "at the edge": [],
        }
        for name, (one, best) in others.items()
    }
    return {
        "title": "A task",
        "plateau": True,
        "peers": lines | {"unable": {"not able": "needs residuals"}},
        "ours": took(ours),
    }


def test_the_best_peer_is_the_best_of_both_settings_of_all():
    found = task(10, a=(40, 30), b=(20, 25), c=(None, None))
    assert peers.best_peer(found, "best") == ("b", took(20))
    assert peers.ratio(found, "best") == 2
    assert peers.ratio(task(10, a=(40, 30)), "one setting") == 4
    assert peers.ratio(task(None, a=(40, 30)), "best") is None
    assert peers.ratio(task(10, a=(None, None)), "best") is None


def test_wins_ties_and_losses_are_all_said(tmp_path):
    tasks = {"x": task(10, a=(40, 40)), "y": task(10, a=(11, 10)), "z": task(10, a=(5, 2.5))}
    results = {"starts": 6, "tasks": tasks | {"w": task(None, a=(5, 5))}}
    *_, last = peers.tables(results)
    assert "geometric mean 1, 1 won, 1 tied, 1 lost, 1 without a ratio" in last.caption
    assert [row.cells[-1] for row in last.rows] == ["4", "1", "0.25", "-"]
    peers.draw(results, tmp_path)
    assert (tmp_path / "peers.png").exists()


def test_ratios_are_to_wang_hvpa_of_the_same_kind(tmp_path):
    levels = lambda a, b: {"90": took(a), "99": took(b)}
    row = {"paper": [2.0, 3.0], "logs": [100, None]}
    methods = {
        "fischer_fr22": row | {"published": levels(60, 90), "best": levels(10, 20)},
        "wang_hvpa": {"paper": [1, 1], "logs": [50, 60], "published": levels(30, None)},
        "cma_es": {"paper": [1.0, 2.0], "best": levels(5, 6), "at the edge": ["first"]},
        "shortest_call": {"published": levels(4, 5)},
    }
    faster = [{"times": k, "took": levels(60 / k, 90)} for k in papers.FASTER]
    found = {"title": "A task", "lines": methods, "faster": faster}
    assert papers.ratio(found, "fischer_fr22", "90") == 2
    assert papers.ratio(found, "fischer_fr22", "99") is None
    results = {"starts": 6, "tasks": {"a": found}}
    first, second = papers.tables(results)
    cells = {row.name.strip(): row.cells for row in first.rows}
    assert cells["Fischer-FR22"] == ("2 / 3", "2 / -", "2 / -", "60 / 90", "10 / 20")
    assert cells["CMA-ES (pycma)"][-1] == "5 / 6*"
    assert second.rows[0].cells == ("60", "15", "3.8", "0.94", "30")
    papers.draw(results, tmp_path)
    assert (tmp_path / "papers.png").exists()


@pytest.mark.parametrize("study", [papers, peers])
def test_unknown_tasks_are_named(study, tmp_path):
    from argparse import Namespace

    options = Namespace(names=["nothing"], full=False, seeds=None, fresh=False, methods=None)
    with pytest.raises(SystemExit, match="choose from"):
        study.measure(options, tmp_path)
