"""Score a rationale by what the oracle knows about its item."""

from __future__ import annotations

from dataclasses import dataclass

from dynapix.benchmark import Item
from dynapix.conf.errors import UserError
from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.numbers.detection import find_numbers
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.teacher.reading.claims import VERDICTS, Claim
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.sufficiency import measure_sufficiency


@dataclass(frozen=True)
class RationaleScore:
    """What a rationale states.

    Attributes:
        numbers: The numbers in the text, such as "two", as they are written.
        claims: The statements that predicates can confirm or refute, each with its verdict.
    """

    numbers: tuple[str, ...]
    claims: tuple[Claim, ...]

    @property
    def supported(self) -> list[Claim]:
        """The claims that the predicates confirm."""
        return self._with_verdict("supported")

    @property
    def contradicted(self) -> list[Claim]:
        """The claims that the predicates refute."""
        return self._with_verdict("contradicted")

    @property
    def unknown(self) -> list[Claim]:
        """The claims that the predicates neither confirm nor refute."""
        return self._with_verdict("unknown")

    def _with_verdict(self, verdict: str) -> list[Claim]:
        return [claim for claim in self.claims if claim.verdict == verdict]

    def __str__(self) -> str:
        counts = ", ".join(f"{len(self._with_verdict(name))} {name}" for name in VERDICTS)
        parts = [f"claims: {counts}", f"numbers: {', '.join(self.numbers) or 'none'}"]
        if self.contradicted:
            parts.append(f"contradicted: {', '.join(map(str, self.contradicted))}")
        return "; ".join(parts)


def score_rationale(item: Item, text: str) -> RationaleScore:
    """Find the numbers and the claims of a rationale, and compare the claims with the oracle.

    Args:
        item: The selection item that the rationale is about.
        text: The rationale. Claims are read in sections with headings such as "Prediction:", as
            the teacher writes them. A text without headings has no claims.

    Raises:
        UserError: The item has no predicates, because its prefix is too short.
    """
    predicates = _extract_predicates(item)
    numbers = tuple(text[start:stop] for start, stop in find_numbers(text))
    return RationaleScore(numbers, extract_claims(text, predicates))


def sufficiency(item: Item, text: str) -> float:
    """Return the probability that a reader who knows only the prediction picks the target.

    The reader sees each candidate's true state in the words of the relational vocabulary, leaves
    out the candidates of which a statement of the prediction is false, and guesses among the
    others. A text that predicts nothing, or whose prediction fits no candidate, has the
    sufficiency of a guess, 1/4.

    Args:
        item: The selection item that the rationale is about.
        text: The rationale, with the heading "Prediction:".

    Raises:
        UserError: The item has no predicates, because its prefix is too short.
    """
    predicates = _extract_predicates(item)
    return measure_sufficiency(text, extract_claims(text, predicates), predicates)


def _extract_predicates(item: Item) -> RelationalPredicates:
    store = item._benchmark.store
    predicates = describe_item(item.record, store, TeacherConfig())
    if predicates is None:
        raise UserError(
            f"{item.item_id} has no predicates: its prefix is too short",
            code="no-predicates",
        )
    return predicates
