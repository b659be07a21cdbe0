"""What the tiny base says is measured against the oracle."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from dynapix.models.student.responses import GeneratedText
from research.tiny_base import measures
from research.tiny_base.samples import ItemSampler

CLOSEST = re.compile(r"(?<=expected place in candidate )\w")
OPPOSITE = {"north": "south", "south": "north", "east": "west", "west": "east"}
FAULTS: dict[str, Callable[[str], str]] = {
    # Another object may have the false material, and then seems to be meant.
    "name_precision/parse": lambda text: text.replace(" rubber ", " metal "),
    "name_recall/parse": lambda text: text.split(".")[0] + ".",
    "region/predict": lambda text: text.replace("near the ", "not near the "),
    "moving/parse": lambda text: re.sub(r"(is )?mov\w+ \w+ toward \w+ \w+", "is stationary", text),
    "heading/parse": lambda text: re.sub(
        "|".join(OPPOSITE), lambda found: OPPOSITE[found.group()], text
    ),
    "choice/explain": lambda text: CLOSEST.sub(
        lambda found: dict(zip("ABCD", "BCDA", strict=True))[found.group()], text
    ),
    "outcome/explain": lambda text: text.partition("Outcome")[0],
}
"""The measures that notice faults of answers."""


@pytest.mark.slow
def test_true_answers_are_right_in_every_respect_and_faults_are_noticed(
    items, frames, model, processor, student_cfg, monkeypatch
) -> None:
    sampler = ItemSampler(items[: measures.BATCH], frames, 4, 0)
    true = [
        [sampler.ask_question(item, kind, "held out")[1].answer for item in sampler.items]
        for kind in (*measures.SECTION_PREFIXES, "explain")
    ]

    def measure(change: Callable[[str], str]) -> dict[str, float]:
        batches = iter(true)
        monkeypatch.setattr(
            measures, "generate", lambda *_: [GeneratedText(change(t)) for t in next(batches)]
        )
        return measures.measure_generated_answers(
            model, processor, sampler, sampler.items, student_cfg, "fp32"
        )

    right = measure(lambda text: text)
    names = {*FAULTS, "color/parse", "name_precision/describe"}
    assert {f"generated_{name}" for name in names} <= right.keys()
    assert {name for name, value in right.items() if value < 1} == set()
    for name, change in FAULTS.items():
        assert measure(change)[f"generated_{name}"] < 0.8, name
