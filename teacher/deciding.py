"""Chooses the statements that decide an item: those that are true of the target and, together,
false of every distractor."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from teacher.predicates.facts import Relation, RelationalPredicates

CLEARNESS = 0.5
"""A statement is preferred if its objects' offsets in the candidates that it excludes are at least
this share of the largest offsets of all statements that exclude as many."""
SIMPLICITY = (
    ("region", "sight"),
    ("side", "height", "gap", "cover"),
    ("between", "extreme", "nearer"),
)
"""Kinds of statements that a single frame shows, the simplest first. Changes since the cut are not
among them."""
LEVELS = {kind: level for level, kinds in enumerate(SIMPLICITY) for kind in kinds}


@dataclass(frozen=True)
class Decision:
    """Statements that decide an item.

    Attributes:
        statements: The smallest set of statements that excludes as many distractors as possible.
        rivals: Letters of the distractors of which all statements about the target's frame are
            true.
    """

    statements: tuple[Relation, ...]
    rivals: tuple[str, ...]


def choose_statements(predicates: RelationalPredicates, seed: int | str) -> Decision:
    """Choose the fewest statements that exclude as many distractors as possible.

    Statements are added one by one; each excludes as many of the remaining distractors as possible.
    With three distractors, no smaller set exists: either a statement excludes all, or two do, or
    each excludes one. Ties are broken in this order:

    1. All objects are visible at the cut, because others can hardly be predicted.
    2. The clearness is at least `CLEARNESS` of the largest. It is the smallest offset, over the
       excluded candidates, of the objects from their places in the target.
    3. The kind is the simplest of `SIMPLICITY`.
    4. The clearness is the largest.
    5. At random.
    """
    rng = Random(seed)
    views = [view for view in predicates.views if view.letter != predicates.answer]
    excluded_by = {
        statement: {view.letter for view in views if statement not in view.statements}
        for statement in sorted(predicates.target.statements)
        if statement.kind in LEVELS
    }
    seen = {o.object for o in predicates.objects if o.sight == "shown"}
    left, chosen = {view.letter for view in views}, []
    while left:
        most = max((len(excluded & left) for excluded in excluded_by.values()), default=0)
        if not most:
            break
        best = [s for s, excluded in excluded_by.items() if len(excluded & left) == most]
        best = [s for s in best if seen.issuperset(s.objects)] or best
        clearness = {
            statement: min(
                max(view.offsets[name] for name in statement.objects)
                for view in views
                if view.letter in excluded_by[statement] & left
            )
            for statement in best
        }
        least = CLEARNESS * max(clearness.values())
        clear = [statement for statement, value in clearness.items() if value >= least]
        simplest = min(LEVELS[statement.kind] for statement in clear)
        options = [statement for statement in clear if LEVELS[statement.kind] == simplest]
        clearest = max(clearness[statement] for statement in options)
        chosen.append(rng.choice([s for s in options if clearness[s] == clearest]))
        left -= excluded_by[chosen[-1]]
    return Decision(tuple(chosen), tuple(sorted(left)))
