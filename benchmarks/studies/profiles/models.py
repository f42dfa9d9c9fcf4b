"""Settings of scikit-learn's models: minus the score of cross-validation, over a unit cube.

A function here is what a user has who seeks the settings of a model: it jumps where a number is
rounded or a choice changes, is level where nothing does, and may have several valleys.
"""

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import smoothdiff as sd
from benchmarks.methods._flat import package

# a setting of the solver was chosen on the first ones
CHOSEN_ON = "svr", "svc", "boosting", "network", "ridge"
OTHERS = "elastic-net", "trees", "process", "other-svr", "logistic"
STARTS = 10
WIDTH = 0.2  # as a share of each range
MIDDLE = 0.05, 0.95  # of a range, where starts are

log = partial(sd.Range, log=True)


class Model(NamedTuple):
    """How it is built from its settings, what these may be, and its data: their name, how many."""

    build: Callable[..., Any]
    settings: dict[str, sd.AbstractSpace]
    data: str
    rows: int = 0
    scored: str = "neg_mean_squared_error"


def models() -> dict[str, Model]:
    """By name."""
    sk = _scikit_learn()
    whole = lambda x: round(float(x))
    return {
        "svr": Model(
            sk.svm.SVR,
            {"C": log(1e-1, 1e5), "gamma": log(1e-3, 1e3), "epsilon": log(1e-2, 1e2)},
            "diabetes",
            120,
        ),
        "svc": Model(
            sk.svm.SVC, {"C": log(1e-2, 1e4), "gamma": log(1e-5, 1e2)}, "digits", 300, "accuracy"
        ),
        "boosting": Model(
            lambda trees, depth, leaf, **rest: sk.ensemble.GradientBoostingRegressor(
                n_estimators=whole(trees),
                max_depth=whole(depth),
                min_samples_leaf=whole(leaf),
                random_state=0,
                **rest,
            ),
            {
                "learning_rate": log(1e-3, 1.0),
                "trees": log(5.0, 120.0),
                "depth": sd.Range(1.0, 7.0),
                "subsample": sd.Range(0.3, 1.0),
                "leaf": sd.Range(1.0, 20.0),
            },
            "friedman1",
        ),
        "network": Model(
            lambda hidden, **rest: sk.neural_network.MLPClassifier(
                (whole(hidden),), solver="sgd", max_iter=30, random_state=0, **rest
            ),
            {
                "learning_rate_init": log(1e-4, 1.0),
                "alpha": log(1e-6, 1e2),
                "hidden": log(2.0, 60.0),
                "momentum": sd.Range(0.0, 0.99),
            },
            "wine",
            scored="neg_log_loss",
        ),
        "ridge": Model(
            partial(sk.kernel_ridge.KernelRidge, kernel="rbf"),
            {"alpha": log(1e-8, 1e2), "gamma": log(1e-4, 1e3)},
            "friedman2",
        ),
        "elastic-net": Model(
            sk.linear_model.ElasticNet,
            {"alpha": log(1e-5, 1e2), "l1_ratio": sd.Range(0.01, 1.0)},
            "diabetes",
            200,
        ),
        "trees": Model(
            lambda trees, depth, leaf, **rest: sk.ensemble.ExtraTreesRegressor(
                whole(trees),
                max_depth=whole(depth),
                min_samples_leaf=whole(leaf),
                random_state=0,
                **rest,
            ),
            {
                "trees": sd.Range(2.0, 40.0),
                "depth": sd.Range(1.0, 12.0),
                "leaf": sd.Range(1.0, 30.0),
                "max_features": sd.Range(0.05, 1.0),
            },
            "friedman2",
        ),
        "process": Model(
            lambda length, size, **rest: sk.gaussian_process.GaussianProcessRegressor(
                size**2 * sk.gaussian_process.kernels.RationalQuadratic(length),
                optimizer=None,
                normalize_y=True,
                **rest,
            ),
            {"length": log(1e-2, 1e3), "alpha": log(1e-8, 1e2), "size": log(1e-2, 1e3)},
            "friedman1",
        ),
        "other-svr": Model(
            sk.svm.SVR,
            {"C": log(1e-2, 1e4), "gamma": log(1e-4, 1e2), "epsilon": log(1e-3, 1e1)},
            "friedman1",
        ),
        "logistic": Model(
            partial(sk.linear_model.LogisticRegression, solver="saga", max_iter=60),
            {"C": log(1e-4, 1e4), "l1_ratio": sd.Range(0.0, 1.0)},
            "cancer",
            scored="neg_log_loss",
        ),
    }


def error(model: Model) -> Callable[[np.ndarray], float]:
    """Minus the score of a model, threefold, as a function of the shares of its ranges."""
    sk = _scikit_learn()
    inputs, targets = _data(sk, model.data, model.rows)
    spaces, score = model.settings.items(), sk.model_selection.cross_val_score

    def fun(shares: np.ndarray) -> float:
        at = {name: float(of.to_natural(u)) for (name, of), u in zip(spaces, shares, strict=True)}
        how: Any = {"cv": 3, "scoring": model.scored}
        # some settings overflow, in others a fit is cut short
        with warnings.catch_warnings(action="ignore"):
            try:
                return -float(np.mean(score(model.build(**at), inputs, targets, **how)))
            except ValueError as failed:
                if "fits failed" not in str(failed):
                    raise
                return np.nan

    return fun


def starts(model: Model, count: int) -> Iterator[np.ndarray]:
    """Anywhere in the middle nine tenths of the ranges."""
    for seed in range(count):
        yield np.random.default_rng(100 + seed).uniform(*MIDDLE, len(model.settings))


def _data(sk: SimpleNamespace, name: str, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs of mean zero and variance one but for the diabetes data, which are scaled already."""
    made = {
        "friedman1": lambda: sk.datasets.make_friedman1(150, noise=0.5, random_state=0),
        "friedman2": lambda: sk.datasets.make_friedman2(150, noise=5, random_state=1),
        "diabetes": lambda: sk.datasets.load_diabetes(return_X_y=True),
        "digits": lambda: sk.datasets.load_digits(return_X_y=True),
        "wine": lambda: sk.datasets.load_wine(return_X_y=True),
        "cancer": lambda: sk.datasets.load_breast_cancer(return_X_y=True),
    }
    inputs, targets = made[name]()
    inputs, targets = inputs[: rows or None], targets[: rows or None]
    if name == "digits":
        inputs = inputs / 16
    elif name != "diabetes":
        inputs = sk.preprocessing.StandardScaler().fit_transform(inputs)
    if name == "friedman2":
        targets = (targets - targets.mean()) / targets.std()
    return inputs, targets


def _scikit_learn() -> SimpleNamespace:
    """Its modules that are needed here."""
    names = (
        *("datasets", "ensemble", "gaussian_process", "kernel_ridge", "linear_model"),
        *("model_selection", "neural_network", "preprocessing", "svm"),
    )
    return SimpleNamespace(**{name: package(f"sklearn.{name}", "scikit-learn") for name in names})
