"""Verdicts over many right models and wrong ones; `docs/verdicts.py` makes and counts them."""

from __future__ import annotations

import re

import numpy as np
import pytest
import verdicts as study

CAUSES = {
    "sign": 0.01,
    "drift": 0.01,
    "prior": 0.01,
    "repeated": 0.01,
    "unit": 0.01,
    "misfit": 0.01,
}
"""Largest share of right models with each verdict."""


def most(share, count):
    """Most of so many right models, three standard errors above their share, and at least one."""
    return max(1.0, share * count + 3 * (share * count) ** 0.5)


@pytest.mark.study
def test_right_models_have_no_verdict(draws, figure):
    found, seeds = [], draws(2000)
    for seed in seeds:
        model = study.RIGHT[seed % len(study.RIGHT)]
        told = study.verdicts(*model(np.random.default_rng([1, seed])))
        found += [each.kind for each in told or ()]
    count = len(seeds)
    for kind, share in CAUSES.items():
        figure(f"{kind} of {count} right models", found.count(kind) / count, f"at most {share}")
        assert found.count(kind) <= most(share, count), kind


@pytest.mark.study
@pytest.mark.parametrize("name", study.WRONG)
def test_the_first_cause_is_the_true_one(name, draws, figure):
    model, pattern = study.WRONG[name]
    seeds = draws(20)
    first = [
        study.first_cause(study.verdicts(*model(np.random.default_rng([2, seed]))))
        for seed in seeds
    ]
    named = np.mean([cause is not None and bool(re.search(pattern, cause)) for cause in first])
    figure(f"first cause of '{name}'", named, "at least 0.9")
    assert None not in first
    # Of two one may be among the tenth.
    assert named >= (0.9 if len(seeds) >= 10 else 0.5)
