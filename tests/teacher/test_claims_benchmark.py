"""The benchmark of claims: spans, verdicts and counts."""

from __future__ import annotations

import json
import os
from itertools import islice
from pathlib import Path

import pytest

from dynapix.conf.entry import Run
from dynapix.conf.schema import BenchmarkConfig, ClaimsCommand
from dynapix.data.store import Store, load_rows
from dynapix.teacher import claims_benchmark
from dynapix.teacher.claims_benchmark import CARD, CLAIMS, FALSE_WORD, NARRATOR, TEXTS
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.validation.claim_extraction import extract_claims
from tests.user_errors import raises_user_error

COUNT = 5000


@pytest.fixture(scope="module")
def answers(micro_store: Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of two evaluations: of a student with the texts of the narrator, of which one is on
    items without a prefix and one in answer mode, and of a student on another benchmark."""
    root = tmp_path_factory.mktemp("runs") / "select"
    described = claims_benchmark.describe_test_items(micro_store)
    text = {k: write_rationale(facts, item, 0) for k, (item, facts) in described.items()}
    asked = {
        "plain": ("reasoning", None), "blind": ("reasoning", "candidate_only"),
        "short": ("answer", None),
    }  # fmt: skip
    for name, benchmark in (("mine", micro_store.identity), ("other", "elsewhere")):
        rows = [
            {"key": key, "mode": mode, "asked": {"benchmark": benchmark, "control": control}}
            for key, (mode, control) in asked.items()
        ]
        rows += [{"item_id": k, "key": key, "text": text[k]} for key in asked for k in text]
        (root / name).mkdir(parents=True)
        lines = [*map(json.dumps, rows), '{"item_id": "cut o']
        (root / name / "answers.jsonl").write_text("\n".join(lines))
    return root.parent


def write(
    micro: BenchmarkConfig, store: Store, folder: Path, checkpoints: Path, **settings: object
) -> tuple[list[dict], list[dict]]:
    cfg = ClaimsCommand(
        benchmark=micro, store=str(store.folder.parent), checkpoints=str(checkpoints),
        claims=COUNT, **settings,
    )  # fmt: skip
    folder.mkdir()
    metrics = claims_benchmark.main.__wrapped__(cfg, Run(folder.name, folder))
    texts, claims = load_rows(folder / TEXTS), load_rows(folder / CLAIMS)
    assert (metrics["texts"], metrics["claims"]) == (len(texts), len(claims))
    return texts, claims


def test_every_claim_has_its_words_and_the_verdict_of_the_oracle(
    micro: BenchmarkConfig, micro_store: Store, answers: Path, tmp_path: Path
) -> None:
    texts, claims = write(micro, micro_store, tmp_path / "run", answers, runs=["m*"])
    assert len(claims) >= COUNT
    described = claims_benchmark.describe_test_items(micro_store)
    sources = {text["source"] for text in texts}
    assert sources == {"mine", NARRATOR, FALSE_WORD}
    own = [text for text in texts if text["source"] == "mine"]
    assert sorted(text["item_id"] for text in own) == sorted(described)
    by_source = dict.fromkeys(sources, 0)
    for claim in claims:
        text = texts[claim["text_id"]]
        assert claim["words"] == text["text"][claim["start"] : claim["stop"]] != ""
        item, facts = described[claim["item_id"]]
        assert text["answer"] == item.letter
        found = {
            (c.span, c.kind, tuple(c.subjects), c.value): c.verdict
            for c in extract_claims(text["text"], facts)
        }
        span = claim["start"], claim["stop"]
        key = span, claim["kind"], tuple(claim["subjects"]), claim["value"]
        assert claim["verdict"] == found[key]
        by_source[text["source"]] += claim["verdict"] == "contradicted"
    assert by_source[FALSE_WORD] > 100
    assert by_source[NARRATOR] == by_source["mine"] == 0
    card = (tmp_path / "run" / CARD).read_text()
    assert f"{len(claims):,} claims of {len(texts):,} texts" in card
    assert f"| {FALSE_WORD} | 0 | {by_source[FALSE_WORD]:,} |" in card


def common_start(one: str, other: str) -> int:
    return len(os.path.commonprefix([one, other]))  # noqa: RUF071


def test_a_false_word_changes_one_place_of_a_true_text(micro_store: Store) -> None:
    described = claims_benchmark.describe_test_items(micro_store)
    true, changed = "", 0
    for text in islice(claims_benchmark.narrate_with_false_words(described, 0), 200):
        if text.source == NARRATOR:
            true = text.text
            continue
        changed += 1
        one, other = true, text.text
        start, tail = common_start(one, other), common_start(one[::-1], other[::-1])
        stop = len(other) - tail
        if stop - start > 60:
            # Two candidates have changed their letters, and claims follow the letter.
            continue
        for claim in text.claims:
            assert claim.verdict == "contradicted"
            assert claim.span[0] <= max(start, stop)
            assert claim.span[1] >= min(start, stop)
    assert changed > 100


def test_the_same_seed_gives_the_same_bytes(
    micro: BenchmarkConfig, micro_store: Store, tmp_path: Path
) -> None:
    for name, seed in (("one", 0), ("two", 0), ("three", 1)):
        write(micro, micro_store, tmp_path / name, tmp_path, seed=seed)
    one, two, three = ((tmp_path / name / CLAIMS).read_bytes() for name in ("one", "two", "three"))
    assert one == two != three


@pytest.mark.parametrize("name", ["nobody", "other"])
def test_a_name_without_responses_is_refused(
    micro: BenchmarkConfig, micro_store: Store, answers: Path, tmp_path: Path, name: str
) -> None:
    with raises_user_error("no-runs", contains=f"runs: {name} matches no run below"):
        write(micro, micro_store, tmp_path / "run", answers, runs=["mine", name])
    assert not list((tmp_path / "run").iterdir())
