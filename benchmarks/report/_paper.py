"""Table 2 of Stochastic Gradient Estimation for Higher-order Differentiable Rendering.

Seconds to 90 % and 99 % of the image error, over those of OurHVPA on the same task; None where the
table is blank. Where a row of the table has gaps, which of them they are cannot always be told from
the text: only what is certain is here. Tasks and methods have our names.
"""

from collections.abc import Mapping

Ratios = tuple[float | None, float | None]

TITLES = {
    "mitsuba_ad": "Mitsuba's AD",
    "fr22": "FR22",
    "cma_es": "CMA-ES",
    "our_gradient": "OurG",
    "our_h": "OurH",
    "our_hvp": "OurHVP",
    "our_hvpa": "OurHVPA",
}
LEVELS = ("90", "99")
AVERAGE = 2.71  # "on average across tasks and methods", by the paper

TABLE_2: Mapping[str, Mapping[str, Ratios]] = {
    "quad": {
        "fr22": (1.80, 2.38),
        "cma_es": (0.15, 0.13),
        "our_gradient": (3.98, 5.13),
        "our_h": (1.17, 1.17),
        "our_hvp": (0.76, 0.62),
    },
    "box2": {
        "fr22": (3.24, 2.49),
        "cma_es": (5.51, 3.45),
        "our_gradient": (2.88, 2.16),
        "our_h": (0.93, 0.95),
        "our_hvp": (0.81, 0.64),
    },
    "box10": {
        "fr22": (1.49, 1.20),
        "cma_es": (3.10, 2.27),
        "our_gradient": (2.18, 1.77),
        "our_h": (5.97, 5.33),
        "our_hvp": (1.51, 1.44),
    },
    "mug": {
        "fr22": (5.92, 5.69),
        "cma_es": (2.95, 1.97),
        "our_gradient": (3.99, 3.91),
        "our_h": (1.57, 1.09),
        "our_hvp": (1.15, 1.14),
    },
    "shadow": {
        "fr22": (1.94, 1.40),
        "cma_es": (1.96, 1.15),
        "our_gradient": (1.37, 1.18),
        "our_h": (1.67, 1.44),
        "our_hvp": (1.14, 0.91),
    },
    "bunny": {
        "mitsuba_ad": (0.90, 1.29),
        "fr22": (0.75, 0.75),
        "cma_es": (1.16, 0.95),
        "our_gradient": (0.76, 0.89),
        "our_h": (1.29, 1.23),
        "our_hvp": (0.68, 0.68),
    },
    "texture32": {
        "fr22": (4.04, 2.27),
        "cma_es": (7.08, 4.60),
        "our_gradient": (3.03, 2.86),
        "our_h": (40.12, 39.78),
        "our_hvp": (4.01, 4.00),
    },
    "cnn": {
        "fr22": (2.11, None),
        "cma_es": (2.08, None),
        "our_gradient": (1.14, None),
        "our_h": (0.77, 0.77),
        "our_hvp": (0.87, None),
    },
    "cnn5": {
        "our_gradient": (18.68, None),
        "our_h": (19.00, None),
        "our_hvp": (3.64, None),
    },
}
