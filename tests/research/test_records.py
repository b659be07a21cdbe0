"""The records of experiments, and measures of them."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from dynapix.evaluation.metrics.seeds import MACRO
from research.experiments import regimes
from research.experiments.claim_likelihood import auc
from research.experiments.experiment import Experiment
from research.experiments.records import bootstrap, credit_matrix

RESULTS = Path(__file__).parents[2] / "docs" / "results.md"


@pytest.mark.parametrize("benchmark", ["comparison", "comparison_balanced"])
def test_records_of_earlier_settings_are_printed_and_not_reused(benchmark: str) -> None:
    """The results page has the accuracy of the record, whatever the present settings are."""
    args = Namespace(benchmark=benchmark, record=regimes.RECORD, table=True)
    settings = dict.fromkeys(regimes.VARIANTS, "present")
    results = Experiment(args, "present", settings).read_results(3)
    credits = credit_matrix(results[results.control == regimes.UNCHANGED], *regimes.MAIN)
    found = bootstrap(credits).accuracies(regimes.MAIN[0], credits.to_numpy())
    assert f"{100 * found[MACRO].value:.1f} [" in RESULTS.read_text()
    args.table = False
    assert Experiment(args, "present", settings).read_results(3).empty


def test_the_auc_is_the_share_of_pairs_in_which_the_true_claim_has_the_higher_score() -> None:
    rng = np.random.default_rng(0)
    scores, true = rng.integers(5, size=60), rng.random(60) < 0.4
    higher = np.sign(scores[true][:, None] - scores[~true])
    assert auc(scores, true) == pytest.approx((higher.mean() + 1) / 2)
    assert np.isnan(auc(scores, np.ones(60, bool)))
