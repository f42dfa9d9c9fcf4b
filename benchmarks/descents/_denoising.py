"""What filters make of one noisy gradient, beside the gradient without noise (Fig. 4 of the paper).

Source: Chang et al. 2024, section 4.2.1.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.descents._pictures import panels
from benchmarks.descents._variants import Filter

SHOWN = 99  # percentile of the exact gradient's magnitude beyond which pictures saturate


def denoising(
    draw: Callable[[jax.Array], jax.Array],
    exact: jax.Array,
    guide: jax.Array,
    filters: Mapping[str, Mapping[str, Filter]],
    path: Path,
) -> dict[str, Any]:
    """Filters a gradient, draws it, and says how far it is from the exact one.

    Args:
        draw: key -> a noisy gradient.
        exact: The gradient without noise.
        guide: The parameters where it was taken.
        filters: By title the variants of a filter by name. The best one is chosen on another draw.
        path: Of the picture.

    Returns:
        For each title the variant, the relative error and the share of wrong signs.
    """
    tuning, noisy = draw(jax.random.key(1)), draw(jax.random.key(0))
    columns = {"Noisy gradient": noisy}
    found = {"Noisy gradient": {"variant": ""} | _scores(noisy, exact)}
    for title, choices in filters.items():
        name = min(choices, key=lambda name: _scores(choices[name](tuning, guide), exact)["error"])
        columns[title] = choices[name](noisy, guide)
        found[title] = {"variant": name} | _scores(columns[title], exact)
    limit = float(np.percentile(np.abs(exact), SHOWN))
    titles = {title: f"{title}, error {found[title]['error']:.2f}" for title in columns}
    shown = {titles[title]: {"gradient": gradient} for title, gradient in columns.items()}
    # the last column has the scale for all
    panels(shown | {"Exact": {"gradient": np.clip(exact, -limit, limit)}}, path)
    return found


def _scores(gradient: jax.Array, exact: jax.Array) -> dict[str, float]:
    off = float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))
    return {"error": off, "wrong_signs": float(np.mean(np.sign(gradient) != np.sign(exact)))}
