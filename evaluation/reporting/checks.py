"""What the page needs of items and answers: whether runs belong together, and what it shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from conf.errors import UserError
from data.store import Store, open_store
from data.tracks.controls import MATCHED_ANCHOR
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting import item_browser, plots
from evaluation.reporting.comparisons import apart
from evaluation.reporting.measurements import Measured, once
from evaluation.reporting.run_responses import (
    Asked,
    Said,
    Scored,
    answers_of,
    check_rows_share_items,
)

RunAnswers = Mapping[Path, Mapping[Asked, Mapping[str, Said | Scored]]]
"""What was said in each run's folder."""


@dataclass
class Browser:
    """The items that the page shows, their frames as data addresses by name, and in sentences what
    it shows of each benchmark and what it cannot.

    `confusions` are of all answered items, by benchmark and model, as `plots.confusion` counts;
    `apart` are the models of a benchmark that are held against each other.
    """

    entries: list[dict[str, Any]] = field(default_factory=list)
    frames: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    confusions: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    apart: dict[str, list[list[PairedComparison]]] = field(default_factory=dict)


def browser_of(choices: Sequence[Measured], stores: Path, bound: int, seed: int) -> Browser:
    """Of each benchmark with answers at most `bound` items, chosen by `seed`.

    Raises:
        UserError: two runs measured different items, or builds, of one benchmark.
    """
    said = {run.folder: answers_of(run) for run in {m.run.folder: m.run for m in choices}.values()}
    opened = {name: _open(stores / name) for name in dict.fromkeys(m.benchmark for m in choices)}
    check_rows_share_items(choices, [_answers(m, said) or None for m in choices])
    browser = Browser()
    for name, store in opened.items():
        answered = [m for m in once(choices) if m.benchmark == name and _answers(m, said)]
        builds = {m.run.report["build"] for m in answered}
        if isinstance(store, Store) and builds - {store.identity}:
            # By the same names it may have other items.
            store = f"{store.folder} was built anew since they were answered"
        if answered and isinstance(store, str):
            browser.notes.append(f"The items of {name} cannot be shown: {store}.")
        elif answered:
            _add(browser, store, answered, said, bound, seed)
    return browser


def _add(
    browser: Browser,
    store: Store,
    answered: Sequence[Measured],
    said: RunAnswers,
    bound: int,
    seed: int,
) -> None:
    """Add a benchmark's items and what `answered` models said to them."""
    every = {
        i.item_id: i for suite in (None, MATCHED_ANCHOR) for i in store.selection("test", suite)
    }
    answers: dict[str, Mapping[str, Said | Scored]] = {}
    models: dict[str, dict[str, tuple[Measured, Mapping[str, Said | Scored]]]] = {}
    for m in answered:
        label = ", ".join([m.label, *m.ways])
        answers[label] = given = _answers(m, said)
        models.setdefault(m.items, {})[label] = (m, given)
        pairs = [(every[k].letter, s.choice.letter) for k, s in given.items() if k in every]
        browser.confusions.setdefault(m.items, {})[label] = plots.confusion(pairs)
    # A control is held against the items as they are where it is measured.
    if plain := models.get(store.name):
        browser.apart[store.name] = apart(plain, every, seed)
    asked = set().union(*answers.values())
    known = [item for name, item in every.items() if name in asked]
    shown = item_browser.spread(known, answers, bound, seed)
    browser.entries += item_browser.entries(shown, answers, store)
    frames, gone = item_browser.pictures(shown, store)
    browser.frames |= frames
    browser.notes.append(
        f"{store.name}: {len(shown):,} of {len(known):,} answered items, a spread over subtypes "
        "and over right and wrong answers; items=N shows more or fewer."
    )
    if gone:
        more = f"; and of {len(gone) - 1:,} more scenes" if gone[1:] else ""
        browser.notes.append(f"Frames are missing: {gone[0]}{more}.")


def _answers(m: Measured, said: RunAnswers) -> Mapping[str, Said | Scored]:
    of_run = said.get(m.run.folder, {})
    return of_run.get((m.known_by, m.row.control), {})


def _open(folder: Path) -> Store | str:
    """A benchmark's store, or in a sentence why there is none."""
    try:
        return open_store(folder)
    except UserError as error:
        return f"{error} benchmark={folder.name}"
