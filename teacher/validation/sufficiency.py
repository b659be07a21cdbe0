"""Sufficiency: whether a rationale's prediction decides its item.

A reader knows only the state that a rationale predicts, and sees the true state of each candidate
in the same words. The reader leaves out the candidates of which a statement of the prediction is
false, and guesses among the others. The sufficiency of the rationale is the probability that this
reader picks the target. A text that predicts nothing, or whose prediction fits no candidate, has
the sufficiency of a guess among all candidates.
"""

from __future__ import annotations

from collections.abc import Sequence

from dynapix.teacher.predicates.facts import Relation, RelationalPredicates, View
from dynapix.teacher.predicates.relations import VALUES, normalize_relation
from dynapix.teacher.reading.claims import BETWEEN, OBJECT_CHECKS, TARGET, Claim
from dynapix.teacher.sections import split_sections

SECTION = "Prediction"
"""The section whose claims are the predicted state."""


def measure_sufficiency(
    text: str, claims: Sequence[Claim], predicates: RelationalPredicates
) -> float:
    """Return the probability that a reader who knows only the predicted state picks the target.

    Args:
        claims: The claims of the text, as `extract_claims` reads them with these predicates.
    """
    predicted = find_predicted(text, claims)
    fitting = [view.letter for view in predicates.views if is_consistent(predicted, view)]
    if not predicted or not fitting:
        return 1 / len(predicates.views)
    return (predicates.answer in fitting) / len(fitting)


def find_predicted(text: str, claims: Sequence[Claim]) -> list[Claim]:
    """Return the claims of the predicted state that a candidate's frame can contradict."""
    spans = [(start, stop) for name, start, stop in split_sections(text) if name == SECTION]
    return [
        claim
        for claim in claims
        if claim.subjects
        and claim.candidate is None
        and claim.when in (TARGET, BETWEEN)
        and (claim.kind in VALUES or claim.kind in OBJECT_CHECKS or claim.kind == "close")
        and any(start <= claim.span[0] < stop for start, stop in spans)
    ]


def is_consistent(predicted: Sequence[Claim], view: View) -> bool:
    """Return whether no claim of a predicted state is false of a candidate."""
    unseen = {c.subjects[0] for c in predicted if c.kind == "sight" and c.affirmed}
    for claim in predicted:
        if claim.kind == "region" and claim.subjects[0] in unseen:
            # "The red cube will be hidden near the left": no frame shows its place.
            continue
        truth = _truth(claim, view)
        if truth is not None and truth != claim.affirmed:
            return False
    return True


def _truth(claim: Claim, view: View) -> bool | None:
    if claim.kind in VALUES:
        relation = Relation(claim.kind, claim.subjects, claim.value)
        return normalize_relation(relation) in view.statements
    if claim.kind == "close":
        return any({*claim.subjects} == {*pair.objects} for pair in view.close)
    facts = {o.object: o for o in view.objects}.get(claim.subjects[0])
    if facts is None:
        return None
    if claim.kind == "region" and facts.target_sight != "shown":
        return False
    return OBJECT_CHECKS[claim.kind](facts, claim.value, claim.when)
