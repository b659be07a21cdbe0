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
    distances    says of the places among these statements how far off each candidate is, in the
                 words of the candidate analysis, and guesses among the candidates that are least
                 off and, of these, agree with most statements
    nearest      chooses the candidate whose places differ least from the predicted ones, which
                 needs no words
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from math import dist
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.experiments.experiment import open_benchmark, print_header, print_row
from conf.failures import report_failures
from data.records import FAMILIES, SelectionItem
from data.store import Store
from teacher.deciding import UNKNOWN_PATH, UNSEEN_DISTANCE, choose_statements, list_compared
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.facts import Relation
from teacher.predicates.places import region_at
from teacher.predicates.relations import (
    Bounds,
    Places,
    describe_distance,
    find_relations,
    find_topic,
    normalize_relation,
)

ERRORS = ((0.0, 0.0), (0.02, 0.0), (0.02, 0.15), (0.02, 0.3), (0.03, 0.4))
"""Standard deviations of the seen places, and of the predicted ones as shares of the paths. Those
of the tiny base are about 0.02 and 0.3."""
READERS = ("statements", "distances", "nearest")
BOUNDS = Bounds()


class Case(NamedTuple):
    """An item as the reader meets it: the statements that the candidate analysis compares with, the
    places in its candidates, and the paths of its objects from the cut to the target."""

    item: SelectionItem
    statements: tuple[Relation, ...]
    candidates: list[Places]
    paths: dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--benchmark", default="tiny")
    parser.add_argument("--store", type=Path, default=Path("store"))
    parser.add_argument("--samples", type=int, default=3, help="samples of the errors per item")
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
        statements = list_compared(choose_statements(predicates), predicates)
        if not statements:
            continue
        candidates = [Places.of(store.scene(c.scene_id), c.frame) for c in item.candidates]
        yield Case(item, statements, candidates, predicates.paths)


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
    names = {name for statement in case.statements for name in statement.objects}
    stated = state_topics(case.statements, find_statements(expected, names))
    missed = [len(stated - find_statements(places, names)) for places in candidates]
    placed = [s.objects[0] for s in case.statements if s.kind == "region"]
    off = [
        (sum(count_steps(expected, p, name) for name in placed), m)
        for p, m in zip(candidates, missed, strict=True)
    ]
    distances = [distance(expected, places) for places in candidates]
    return (
        probability_of([m == 0 for m in missed], case.item.answer),
        probability_of([o == min(off) for o in off], case.item.answer),
        float(np.argmin(distances) == case.item.answer),
    )


def probability_of(chosen: list[bool], answer: int) -> float:
    """Return the probability of an answer if one of the chosen candidates is guessed; of all
    candidates if none is chosen."""
    return chosen[answer] / sum(chosen) if any(chosen) else 1 / len(chosen)


def count_steps(expected: Places, places: Places, name: str) -> int:
    """Return how far off an object is: 0 if it is where it is expected, then 1 slightly, 2 clearly,
    3 far, and 4 if only one of the frames shows it."""
    if (name in expected.image) != (name in places.image):
        return 4
    if name not in expected.image:
        return 0
    extent = describe_distance(dist(expected.image[name], places.image[name]), BOUNDS)
    return (None, "slightly", "clearly", "far").index(extent)


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


def distance(one: Places, other: Places) -> float:
    """Return the sum of the distances between the places of each object in two frames. An object
    that only one of them shows counts `UNSEEN_DISTANCE`."""
    names = one.image.keys() | other.image.keys()
    both = one.image.keys() & other.image.keys()
    return sum(dist(one.image[name], other.image[name]) for name in both) + UNSEEN_DISTANCE * (
        len(names) - len(both)
    )


if __name__ == "__main__":
    with report_failures():
        main()
