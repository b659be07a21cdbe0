"""Write a benchmark of claims: statements about physical scenes, each with the oracle's verdict.

A model that judges the steps of a reasoning, such as a process reward model, reads the item and the
text, and says of each claim whether it is true. The claims come from the responses of students, and
from rationales of the built-in narrator with and without a false word.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.resources import files
from itertools import count
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json_lines, write_text
from dynapix.conf.schema import ClaimsCommand, TeacherConfig
from dynapix.data.records import SelectionItem
from dynapix.data.seeded_order import named_rng
from dynapix.teacher.narrator import NARRATOR_VERSION, write_rationale
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.vocabulary import describe_item, name_vocabulary
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.mutations import MUTATIONS, RELATION_MUTATIONS
from dynapix.teacher.validation.reasons import CONTRADICTED, SUPPORTED
from dynapix.teacher.validation.validator import VALIDATOR_VERSION

if TYPE_CHECKING:
    from dynapix.data.store import Store

log = logging.getLogger(__name__)

TEXTS, CLAIMS, CARD = "texts.parquet", "claims.parquet", "README.md"
NARRATOR, FALSE_WORD = "narrator", "false word"
"""Sources of texts that no student has written."""
RELATIONAL = TeacherConfig(name="template", predicates="relational")
"""The vocabulary in which all claims are judged, and in which the narrator writes."""


@dataclass(frozen=True)
class JudgedText:
    """A text about an item, with the claims that the oracle supports or contradicts.

    Attributes:
        source: `NARRATOR`, `FALSE_WORD`, or the name of a student's run.
    """

    item: SelectionItem
    source: str
    text: str
    claims: tuple[Claim, ...]


@command("teacher.claims_benchmark", ClaimsCommand)
def main(cfg: ClaimsCommand, run: Run) -> dict[str, float]:
    from tqdm import tqdm

    from dynapix.data.build import ensure_benchmark
    from dynapix.data.store import save_rows

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    described = describe_test_items(store)
    responses = gather_responses(Path(cfg.checkpoints) / "select", cfg.runs, store, described)
    texts = [
        judge_text(*described[i], source, text) for (_, i), (source, text) in responses.items()
    ]
    judged = sum(len(text.claims) for text in texts)
    with tqdm(total=max(cfg.claims, judged), initial=judged, unit="claim", mininterval=1.0) as bar:
        for text in narrate_with_false_words(described, cfg.seed):
            if judged >= cfg.claims:
                break
            texts.append(text)
            judged += len(text.claims)
            bar.update(len(text.claims))

    rows = [row for number, text in enumerate(texts) for row in claim_rows(number, text)]
    save_rows([text_row(*each) for each in enumerate(texts)], run.folder / TEXTS)
    save_rows(rows, run.folder / CLAIMS)
    write_text(run.folder / CARD, write_card(store, texts, rows))
    verdicts = Counter(row["verdict"] for row in rows)
    log.info("%d claims of %d texts: %s", len(rows), len(texts), run.folder / CLAIMS)
    return {"claims": float(len(rows)), "texts": float(len(texts))} | {
        verdict: float(number) for verdict, number in sorted(verdicts.items())
    }


def describe_test_items(
    store: Store,
) -> dict[str, tuple[SelectionItem, RelationalPredicates]]:
    """Return the test items that have predicates, with them, by item id.

    Raises:
        UserError: There are none.
    """
    items = ((item, describe_item(item, store, RELATIONAL)) for item in store.selection("test"))
    described = {item.item_id: (item, found) for item, found in items if found is not None}
    if not described:
        raise UserError(
            f"{store.name} has no test items with predicates: choose another benchmark",
            code="no-items",
        )
    return described


def gather_responses(
    root: Path, names: Sequence[str], store: Store, described: Collection[str]
) -> dict[tuple[str, str], tuple[str, str]]:
    """Return the responses of students to described items: by the key of the model and its
    settings and the id of the item, the name of the run and the text. An evaluation under a control
    has the responses to unchanged items too, which count once.

    Args:
        names: Names of evaluations below `root`, with `*` for any text.

    Raises:
        UserError: A name matches no run with such responses.
    """
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for name in names:
        matched = False
        for folder in (f for f in sorted(root.glob("*")) if fnmatch(f.name, name)):
            for key, item_id, text in read_responses(folder, store.identity):
                if item_id in described:
                    matched = True
                    found.setdefault((key, item_id), (folder.name, text))
        if not matched:
            raise UserError(
                f"runs: {name} matches no run below {root} with responses in reasoning mode to "
                f"test items of {store.name}: evaluate a student with python -m evaluation.select, "
                "or leave it out",
                code="no-runs",
            )
    return found


def read_responses(folder: Path, benchmark: str) -> Iterator[tuple[str, str, str]]:
    """Yield the keys, item ids and texts of a run's responses in reasoning mode to unchanged items.

    Args:
        benchmark: Identity of the benchmark of the items.
    """
    path, keys = folder / "answers.jsonl", set()
    for row in read_json_lines(path) if path.exists() else ():
        asked = row.get("asked")
        if asked is None:
            if row.get("key") in keys:
                yield row["key"], row["item_id"], row["text"]
        elif (row["mode"], asked["control"], asked["benchmark"]) == ("reasoning", None, benchmark):
            keys.add(row["key"])


def narrate_with_false_words(
    described: dict[str, tuple[SelectionItem, RelationalPredicates]], seed: int
) -> Iterator[JudgedText]:
    """Yield rationales of the built-in narrator, each followed by copies with one false word, of
    which only the claims about this word are kept; without end, in other words each time."""
    order = named_rng(seed, "claims").permutation(len(described))
    entries = [[*described.values()][k] for k in order]
    for attempt in count():
        for item, predicates in entries:
            rationale = write_rationale(predicates, item, seed, attempt)
            true = judge_text(item, predicates, NARRATOR, rationale)
            if any(claim.verdict == CONTRADICTED for claim in true.claims):
                continue
            yield true
            rng = Random(f"{seed}/{item.item_id}/{attempt}")
            for mutate in {**MUTATIONS, **RELATION_MUTATIONS}.values():
                options = [*mutate(rationale, predicates, rng)]
                if options:
                    false, (start, stop) = rng.choice(options)
                    judged = judge_text(item, predicates, FALSE_WORD, false)
                    about = tuple(
                        claim
                        for claim in judged.claims
                        if claim.verdict == CONTRADICTED
                        and claim.span[0] < stop
                        and claim.span[1] > start
                    )
                    if about:
                        yield JudgedText(item, FALSE_WORD, false, about)


def judge_text(
    item: SelectionItem, predicates: RelationalPredicates, source: str, text: str
) -> JudgedText:
    """Return a text with its claims that the oracle supports or contradicts, but not the mentions
    of objects that the scene has."""
    claims = extract_claims(text, predicates)
    kept = (
        claim
        for claim in claims
        if claim.verdict == CONTRADICTED or (claim.verdict == SUPPORTED and claim.kind != "mention")
    )
    return JudgedText(item, source, text, tuple(kept))


def text_row(number: int, text: JudgedText) -> dict[str, Any]:
    item = text.item
    return {
        "text_id": number, "source": text.source, "item_id": item.item_id, "family": item.family,
        "scene_id": item.scene_id, "answer": item.letter, "text": text.text,
    }  # fmt: skip


def claim_rows(number: int, text: JudgedText) -> Iterator[dict[str, Any]]:
    for claim in text.claims:
        start, stop = claim.span
        yield {
            "text_id": number, "item_id": text.item.item_id, "start": start, "stop": stop,
            "words": text.text[start:stop], "kind": claim.kind, "subjects": [*claim.subjects],
            "value": claim.value, "affirmed": claim.affirmed, "moment": claim.when,
            "candidate": claim.candidate, "verdict": claim.verdict,
        }  # fmt: skip


def write_card(store: Store, texts: Sequence[JudgedText], rows: Sequence[dict[str, Any]]) -> str:
    """Return the card of the dataset, whose numbers are counted from the rows."""
    by_source = {text.source: Counter() for text in texts}
    for row in rows:
        by_source[texts[row["text_id"]].source][row["verdict"]] += 1
    lines = [
        f"| {source} | {counts[SUPPORTED]:,} | {counts[CONTRADICTED]:,} |"
        for source, counts in by_source.items()
    ]
    template = (files("dynapix.teacher") / "templates" / "claims_card.md").read_text()
    return template.format(
        benchmark=store.name,
        identity=store.identity,
        texts=len(texts),
        claims=len(rows),
        table="\n".join(lines),
        narrator=NARRATOR_VERSION,
        validator=VALIDATOR_VERSION,
        vocabulary=name_vocabulary(RELATIONAL),
        texts_file=TEXTS,
        claims_file=CLAIMS,
        narrator_source=NARRATOR,
        false_source=FALSE_WORD,
    )


if __name__ == "__main__":
    main()
