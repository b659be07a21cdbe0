"""Measures how the errors of a model's perception and prediction limit its accuracy: a simulated
reader sees and predicts the places of objects with random errors, and answers without any other
mistake.

    python -m benchmarks.experiments.simulated_reader
    python -m benchmarks.experiments.simulated_reader --benchmark tiny_balanced

Each group of rows has a standard deviation of the seen places (% of the image) and one of the
predicted places (% of an object's path from the cut to the target, added to the first). There are
three readers:

    statements   states the topics of the deciding statements as it predicts them, and guesses among
                 the candidates that it sees to agree with all of them
    closest      chooses the candidate that shows the object of the first statement closest to
                 where it predicts it, as the outcome of a rationale does
    all places   chooses the candidate whose places of all objects differ least from the predicted
                 ones
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterator
from math import dist
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.arguments import positive_int
from benchmarks.experiments.experiment import open_benchmark, print_header, print_row
from conf.failures import report_failures
from conf.schema import RelationBounds
from data.records import FAMILIES, SelectionItem
from data.store import Store
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.facts import Relation
from teacher.predicates.places import region_at
from teacher.predicates.relations import (
    Places,
    find_relations,
    find_topic,
    normalize_relation,
)
from teacher.statement_choice import UNKNOWN_PATH, Decision, choose_statements

ERRORS = ((0.0, 0.0), (0.02, 0.0), (0.02, 0.15), (0.02, 0.3), (0.03, 0.4))
"""Standard deviations of the seen places, and of the predicted ones as shares of the paths. Those
of the tiny base are about 0.02 and 0.3."""
ABSENCE = 0.3
"""Distance that counts for an object that only one of two frames shows."""
READERS = ("statements", "closest", "all places")
BOUNDS = RelationBounds()


class Case(NamedTuple):
    """An item as the reader meets it: the statements that decide it, the places in its candidates,
    and the paths of its objects from the cut to the target."""

    item: SelectionItem
    decision: Decision
    candidates: list[Places]
    paths: dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--benchmark", default="tiny")
    parser.add_argument("--store", type=Path, default=Path("store"))
    parser.add_argument(
        "--samples", type=positive_int, default=3, help="samples of the errors per item"
    )
    args = parser.parse_args()
    cases = list(read_cases(open_benchmark(args.store, args.benchmark)))
    print(f"{len(cases)} test items, {args.samples} samples of the errors of each")
    print_header("seen", "predicted", "reader", *FAMILIES, "macro")
    for seen, predicted in ERRORS:
        rng = np.random.default_rng(0)
        right: dict[str, list[tuple[float, ...]]] = {family: [] for family in FAMILIES}
        for case in cases * args.samples:
            right[case.item.family].append(answer(case, seen, predicted, rng))
        means = np.array([np.mean(right[family], axis=0) for family in FAMILIES])
        for name, column in zip(READERS, means.T, strict=True):
            shares = [f"{100 * x:.1f}" for x in (*column, column.mean())]
            print_row(f"{100 * seen:.0f}%", f"{100 * predicted:.0f}%", name, *shares)


def read_cases(store: Store) -> Iterator[Case]:
    """Yield the test items that statements decide, at least in part."""
    for item in store.selection("test"):
        predicates = extract_predicates(item, store.scene(item.scene_id), store.scene, BOUNDS)
        if predicates is None:
            continue
        decision = choose_statements(predicates)
        if not decision.statements:
            continue
        candidates = [Places.from_frame(store.scene(c.scene_id), c.frame) for c in item.candidates]
        yield Case(item, decision, candidates, predicates.paths)


def answer(
    case: Case, seen: float, predicted: float, rng: np.random.Generator
) -> tuple[float, ...]:
    """Return the probability of a right answer of each of the `READERS`."""
    ground = fit_ground(case.candidates)
    target = case.candidates[case.item.answer]
    errors = {name: seen + predicted * case.paths.get(name, UNKNOWN_PATH) for name in target.image}
    expected = displace(target, errors, ground, rng)
    candidates = [
        displace(places, dict.fromkeys(places.image, seen), ground, rng)
        for places in case.candidates
    ]
    statements, place = case.decision.statements, case.decision.place
    names = {name for statement in statements for name in statement.objects}
    stated = state_topics(statements, find_statements(expected, names))
    agrees = [stated <= find_statements(places, names) for places in candidates]
    if place is None:
        closest = agrees
    else:
        off = [measure_distance(expected, places, place.objects) for places in candidates]
        closest = [distance == min(off) for distance in off]
    everything = expected.image.keys() | {n for places in candidates for n in places.image}
    off = [measure_distance(expected, places, everything) for places in candidates]
    return (
        probability_of(agrees, case.item.answer),
        probability_of(closest, case.item.answer),
        float(np.argmin(off) == case.item.answer),
    )


def probability_of(chosen: list[bool], answer: int) -> float:
    """Return the probability of an answer if one of the chosen candidates is guessed; of all
    candidates if none is chosen."""
    return chosen[answer] / sum(chosen) if any(chosen) else 1 / len(chosen)


def displace(
    places: Places, errors: dict[str, float], ground: np.ndarray, rng: np.random.Generator
) -> Places:
    """Return places with random errors.

    Args:
        errors: Standard deviation of each object's place, as a share of the image.
        ground: (2, 2) matrix that maps a displacement in the image to one on the ground.
    """
    image, on_ground = {}, {}
    for name, place in places.image.items():
        shift = rng.normal(scale=errors[name], size=2)
        image[name] = tuple((place + shift).tolist())
        on_ground[name] = tuple((places.ground[name] + shift @ ground).tolist())
    return places._replace(image=image, ground=on_ground)


def fit_ground(candidates: list[Places]) -> np.ndarray:
    """Return the (2, 2) linear map from displacements in the image to displacements on the ground
    that fits the places of the candidates best."""
    image = np.array([place for places in candidates for place in places.image.values()])
    ground = np.array([place for places in candidates for place in places.ground.values()])
    solution, *_ = np.linalg.lstsq(image - image.mean(0), ground - ground.mean(0), rcond=None)
    return solution


def find_statements(places: Places, names: set[str]) -> set[Relation]:
    """Return what is true of places: relations, the regions of visible objects, and which objects
    of `names` are not visible."""
    regions = {
        Relation("region", (name,), region_at(place)) for name, place in places.image.items()
    }
    unseen = {Relation("sight", (name,), "unseen") for name in names - places.image.keys()}
    return find_relations(places, BOUNDS) | regions | unseen


def state_topics(statements: tuple[Relation, ...], found: set[Relation]) -> set[Relation]:
    """Return what is true of a state in the respects of statements.

    Args:
        found: All statements that are true of the state.
    """
    stated = set()
    for s in statements:
        if s in found:
            stated.add(s)
        elif s.kind == "region":
            stated |= {f for f in found if f.kind == "region" and f.objects == s.objects}
        elif (topic := find_topic(s, sorted(found))) is not None:
            stated.add(normalize_relation(topic))
    return stated


def measure_distance(one: Places, other: Places, names: Collection[str]) -> float:
    """Return the sum of the distances between the places of objects in two frames. An object that
    only one of them shows counts `ABSENCE`."""
    both = one.image.keys() & other.image.keys() & {*names}
    either = (one.image.keys() | other.image.keys()) & {*names}
    return sum(dist(one.image[name], other.image[name]) for name in both) + ABSENCE * (
        len(either) - len(both)
    )


if __name__ == "__main__":
    with report_failures():
        main()
