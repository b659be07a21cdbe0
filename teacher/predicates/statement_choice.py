"""Chooses the statements that decide an item: those that are true of the target and, together,
false of every distractor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import dist, erf, hypot, sqrt

import numpy as np

from dynapix.teacher.predicates.facts import OUT_OF_VIEW, Relation, RelationalPredicates, View
from dynapix.teacher.predicates.margins import measure_margin
from dynapix.teacher.predicates.relations import CHANGES

SEEN_ERROR, PREDICTED_ERROR = 0.02, 0.3
"""Standard deviations, along each axis, of a reader's errors in the places of objects. `SEEN_ERROR`
is for places that it sees (share of the image's width or height). `PREDICTED_ERROR` is added for
places that it predicts (share of the object's path from the cut). The errors of the tiny base are
about as large."""
RELATION_FACTOR = 3.0
"""Factor on these errors for statements about relations, because readers judge relations less
accurately than places. Of the statements of a tiny base about candidates, 88% of those about
regions were right, and 26 to 63% of those about sides, heights and gaps."""
UNSEEN_DISTANCE = 0.1
"""Distance between two candidates of which one does not show an object, as a share of the image.
With a larger value, the narrator more often chooses an object that the target does not show, which
a student cannot know. It does so in 1% of the tiny test items with 0.1, and in 2% with 0.3."""
UNKNOWN_PATH = 1.0
"""Path that is assumed for an object that is not visible both at the cut and at the target."""


@dataclass(frozen=True)
class Decision:
    """Statements that decide an item.

    Attributes:
        statements: Statements that exclude as many distractors as possible. The first one says
            where an object is if any object is in view both at the cut and at the target. The last
            ones are changes since the cut, if nothing else excludes a distractor.
        rivals: Letters of the distractors of which all statements about the target's frame are
            true.
    """

    statements: tuple[Relation, ...]
    rivals: tuple[str, ...]

    @property
    def place(self) -> Relation | None:
        """The first statement if it gives the region of an object, otherwise None. A reader finds
        the target by the place of this object."""
        first = self.statements[:1]
        return first[0] if first and first[0].kind == "region" else None


def choose_statements(
    predicates: RelationalPredicates, shown: Sequence[View] | None = None
) -> Decision:
    """Choose the place of an object by which a reader finds the target, and a smallest set of
    further statements that excludes the other distractors.

    Of the objects that the target shows, the object is the one whose places distinguish the
    candidates best: the two closest of its places are the farthest apart. A reader compares these
    places with the one that it predicts, and chooses the closest. A student can learn this choice
    from what the candidates show, without knowing which of them is the target.

    Of the sets of further statements of a size, the one is chosen with which a reader most likely
    finds every statement true of the predicted state and of the target, and one statement false of
    each distractor. This reader sees the places of objects with normally distributed errors,
    `SEEN_ERROR`, and predicts the target with further errors, `PREDICTED_ERROR`. For relations, the
    errors count `RELATION_FACTOR` times. The probabilities of these events are multiplied, as if
    they were independent.

    A change since the cut is harder to read off one frame than a state. So changes are chosen only
    for the distractors that no other statement excludes.

    Args:
        shown: The frames that the reader sees, if they are not the item's candidates. The target is
            not one of them.
    """
    target = predicates.target
    shown = predicates.views if shown is None else shown
    wrong = [view for view in shown if view is not target]
    statements = [
        s
        for s in sorted(target.statements)
        if s.kind not in CHANGES and not all(s in view.statements for view in wrong)
    ]
    holds = np.array([_probability_of_truth(s, predicates) for s in statements])
    # A statement that is true of a distractor does not exclude it.
    excludes = [
        [0.0 if s in view.statements else _probability_of_sight(s, view) for view in wrong]
        for s in statements
    ]
    excludes = np.array(excludes).reshape(len(statements), len(wrong))
    possible = excludes.any(axis=0)
    place = _choose_place(predicates, shown)
    left = possible & [place is None or place in view.statements for view in wrong]
    chosen = [statements[k] for k in _choose_set(holds, excludes[:, left])] if left.any() else []
    alike = [view for view, excluded in zip(wrong, possible, strict=True) if not excluded]
    changes, rivals = _choose_changes(target, alike)
    statements = (*filter(None, [place]), *chosen, *changes)
    return Decision(statements, tuple(view.letter for view in rivals))


def _choose_changes(
    target: View, distractors: Sequence[View]
) -> tuple[list[Relation], Sequence[View]]:
    """Choose changes that are true of the target, each of which excludes as many of the remaining
    distractors as possible. Also return the distractors that no change excludes."""
    changes = [s for s in sorted(target.statements) if s.kind in CHANGES]
    chosen: list[Relation] = []
    while distractors and changes:
        change = max(changes, key=lambda s: sum(s not in v.statements for v in distractors))
        left = [view for view in distractors if change in view.statements]
        if len(left) == len(distractors):
            break
        chosen.append(change)
        distractors = left
    return chosen, distractors


def _choose_place(predicates: RelationalPredicates, shown: Sequence[View]) -> Relation | None:
    """Return where the target shows the object whose places distinguish the shown frames best; of
    several, the leftmost at the cut. None if no object is in view both at the cut and at the
    target."""
    seen = {o.object for o in predicates.objects if o.sight != OUT_OF_VIEW}
    places = [
        s
        for s in sorted(predicates.target.statements)
        if s.kind == "region" and s.objects[0] in seen
    ]

    def rank(place: Relation) -> tuple[float, int]:
        (name,) = place.objects
        separation = measure_separation([v.places.image.get(name) for v in shown])
        return separation, -predicates.left_to_right.index(name)

    return max(places, key=rank, default=None)


def measure_separation(places: Sequence[tuple[float, float] | None]) -> float:
    """Return the smallest distance between the places of an object in two frames, as a share of the
    image. If one of two frames does not show the object (None), their distance is
    `UNSEEN_DISTANCE`; if neither does, it is 0. The separation of fewer than two places is 0."""
    return min((_place_distance(*pair) for pair in combinations(places, 2)), default=0.0)


def _place_distance(one: tuple[float, float] | None, other: tuple[float, float] | None) -> float:
    if one is None or other is None:
        return 0.0 if one is other else UNSEEN_DISTANCE
    return dist(one, other)


def _choose_set(holds: np.ndarray, excludes: np.ndarray) -> tuple[int, ...]:
    """Return the indices of a smallest set of statements that excludes all distractors.

    Args:
        holds: (S,) probability that a reader finds each statement true of the target.
        excludes: (S, W) probability that a reader finds each statement false of each distractor.
            At least one of each distractor's is positive.
    """
    # (S,) and (S, S): probabilities of a right answer with one statement, and with two.
    with_one = holds * excludes.prod(axis=1)
    if with_one.max():
        return (int(with_one.argmax()),)
    missed = 1 - excludes
    with_two = np.outer(holds, holds) * (1 - missed[:, None] * missed[None]).prod(axis=2)
    np.fill_diagonal(with_two, 0)
    if with_two.max():
        first, second = divmod(int(with_two.argmax()), len(holds))
        return first, second
    # Each statement excludes one distractor only.
    return tuple(int(k) for k in (holds[:, None] * excludes).argmax(axis=0))


def _probability_of_sight(statement: Relation, view: View) -> float:
    """Return the probability that a reader finds a statement true of a candidate if it is true, or
    false if it is false."""
    margin = abs(measure_margin(statement, view.places))
    return _normal_cdf(margin / _error(statement, [SEEN_ERROR] * len(_involved(statement, view))))


def _probability_of_truth(statement: Relation, predicates: RelationalPredicates) -> float:
    """Return the probability that a reader finds a true statement true, both of the state that it
    predicts and of the target."""
    target = predicates.target
    paths = [predicates.paths.get(name, UNKNOWN_PATH) for name in _involved(statement, target)]
    error = _error(statement, [SEEN_ERROR + PREDICTED_ERROR * path for path in paths])
    predicted = _normal_cdf(measure_margin(statement, target.places) / error)
    return predicted * _probability_of_sight(statement, target)


def _error(statement: Relation, errors: Sequence[float]) -> float:
    """Return the standard deviation of what a reader compares with the bound of a statement's
    words, for the errors of the places of the involved objects."""
    return hypot(*errors) * (1 if statement.kind in ("region", "sight") else RELATION_FACTOR)


def _involved(statement: Relation, view: View) -> Sequence[str]:
    """Return the objects whose places decide whether a statement is true of a frame."""
    if statement.kind == "extreme":
        return [*view.places.image] or statement.objects
    return statement.objects


def _normal_cdf(z: float) -> float:
    return (1 + erf(z / sqrt(2))) / 2
