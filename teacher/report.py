"""Report on a teacher's responses: their statistics, and random rationales with their frames."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dynapix.conf.files import write_json, write_text
from dynapix.data.records import Rationale, SelectionItem
from dynapix.teacher.predicates.grounding import Grounding
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, name_vocabulary
from dynapix.teacher.prompts import format_facts
from dynapix.teacher.validation.validator import WORD

if TYPE_CHECKING:
    import pandas as pd

    from dynapix.conf.schema import TeacherConfig
    from dynapix.data.store import Store

Figures = dict[str, Any]

EXAMPLES = 3
"""Maximum number of rejected responses that are quoted for each reason."""
IDLE_SECONDS = 60.0
"""Time (s) without any response from which the servers count as idle."""


def summarize(
    items: Sequence[SelectionItem],
    responses: Mapping[str, Sequence[Rationale]],
    unanswered: Collection[str] = (),
    sample: str | None = None,
) -> Figures:
    """Return statistics of the responses to each item, which are in the order of their attempts.

    - `sample`: the sample that the items are; None if they are all training items.
    - Numbers of items: `accepted`; `fallback`, the accepted ones whose rationale the built-in
      narrator wrote instead of the teacher; `unanswered`, whose last request the servers did not
      answer; `set_aside`, others without an accepted response; `too_short`, without any response
      because the prefix is too short.
    - `constraints`: numbers of responses by the grammar or schema that constrained them.
    - `responses` and `accepted_responses`: numbers of the teacher's responses, by attempt.
    - `rejected`: number of responses by kind of reason; `examples`: items and details of some.
    - `lengths`: number of words of each accepted rationale.
    - `sufficiency`: mean sufficiency of the accepted rationales, and share of those with
      sufficiency 1, over all items, by family and by difficulty. `undecided`: number of items with
      a response that the statements about the target's frame do not decide.
    - `claims`: numbers of supported, contradicted and unknown claims, by kind.
    - `hours`: time in which the servers were in use. Multiply it by their GPUs to get GPU hours.
    """
    every = [r for item in items for r in responses.get(item.item_id, ())]
    accepted = select_accepted(items, responses)
    narrated = {r.item_id for r in every}
    open_items = narrated - {r.item_id for r in accepted} - set(unanswered)
    by_attempt = Counter(r.attempt for r in every if not r.fallback)
    accepted_by_attempt = Counter(r.attempt for r in every if r.accepted and not r.fallback)
    rejections: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for r in every:
        for kind, detail in rejection_reasons(r).items():
            rejections[kind].append((r.item_id, detail))
    rejections = dict(sorted(rejections.items(), key=lambda pair: (-len(pair[1]), pair[0])))
    claims: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))
    for r in every:
        for kind, counts in r.claims.items():
            claims[kind] += counts
    gaps = np.diff(np.sort([r.finished for r in every if r.finished is not None]))
    return {
        "sample": sample,
        "items": len(items),
        "accepted": len(accepted),
        "fallback": sum(r.fallback for r in accepted),
        "unanswered": len(unanswered),
        "set_aside": len(open_items),
        "too_short": len(items) - len(narrated.union(unanswered)),
        "constraints": dict(Counter(name_constraint(r) for r in every if not r.fallback)),
        "responses": [by_attempt[k] for k in sorted(by_attempt)],
        "accepted_responses": [accepted_by_attempt[k] for k in sorted(by_attempt)],
        "rejected": {kind: len(details) for kind, details in rejections.items()},
        "examples": {kind: details[:EXAMPLES] for kind, details in rejections.items()},
        "lengths": [len(WORD.findall(r.text)) for r in accepted],
        "sufficiency": _summarize_sufficiency(items, accepted),
        "undecided": len({r.item_id for r in every if r.undecided}),
        "claims": {kind: counts.tolist() for kind, counts in sorted(claims.items())},
        "requests": sum(bool(r.prompt_tokens) for r in every),
        "prompt_tokens": sum(r.prompt_tokens or 0 for r in every),
        "completion_tokens": sum(r.completion_tokens or 0 for r in every),
        "hours": float(gaps[gaps < IDLE_SECONDS].sum()) / 3600,
    }


def _summarize_sufficiency(
    items: Sequence[SelectionItem], accepted: Sequence[Rationale]
) -> dict[str, list[float]]:
    """Return the mean sufficiency, the share of 1 and the number of rationales, by category."""
    by_id = {item.item_id: item for item in items}
    found: dict[str, list[float]] = defaultdict(list)
    for r in accepted:
        item = by_id[r.item_id]
        names = ["all", item.family]
        if item.difficulty is not None:
            names.append(f"{item.family}, {item.difficulty}")
        for name in names if r.sufficiency is not None else ():
            found[name].append(r.sufficiency)
    return {
        name: [float(np.mean(values)), float(np.mean(np.array(values) == 1)), len(values)]
        for name, values in sorted(found.items())
    }


def describe_sufficiency(figures: Figures) -> str:
    """Return the sufficiency of the accepted rationales, and the undecided items, in words."""
    undecided = f"{figures['undecided']} items that no statement decides"
    if "all" not in figures["sufficiency"]:
        return f"sufficiency none ({undecided})"
    mean, ones, _ = figures["sufficiency"]["all"]
    return f"sufficiency {mean:.3f} ({ones:.1%} decide their item; {undecided})"


def select_accepted(
    items: Sequence[SelectionItem], responses: Mapping[str, Sequence[Rationale]]
) -> list[Rationale]:
    """Return the first accepted rationale of each item that has any, in item order."""
    firsts = (
        next((r for r in responses.get(item.item_id, ()) if r.accepted), None) for item in items
    )
    return [r for r in firsts if r is not None]


def rejection_reasons(rationale: Rationale) -> dict[str, str]:
    """Return the kinds of reasons for which a response was rejected, each with its first detail. A
    response with several numbers, for example, has one entry, "number"."""
    reasons = (reason.partition(":") for reason in reversed(rationale.reasons))
    return {kind: detail.strip() for kind, _, detail in reasons}


def format_figures(figures: Figures) -> str:
    """Format the statistics of `summarize` as plain text."""
    import pandas as pd

    f = figures
    sufficiency = pd.DataFrame.from_dict(
        f["sufficiency"], orient="index", columns=["mean", "decided", "rationales"]
    )
    counts = {
        "training items": f["items"],
        "accepted": f["accepted"],
        "of them by the built-in narrator": f["fallback"],
        "unanswered": f["unanswered"],
        "set aside": f["set_aside"],
        "prefix too short": f["too_short"],
        "undecided items": f["undecided"],
    }
    attempts = pd.DataFrame({"responses": f["responses"], "accepted": f["accepted_responses"]})
    attempts.index = pd.RangeIndex(1, len(attempts) + 1, name="attempt")
    attempts["share"] = attempts["accepted"] / attempts["responses"]
    rejected = pd.DataFrame({"responses": f["rejected"]}).rename_axis("rejected for")
    rejected["share"] = rejected["responses"] / sum(f["responses"])
    verdicts = ["supported", "contradicted", "unknown"]
    claims = pd.DataFrame.from_dict(f["claims"], orient="index", columns=verdicts)
    totals = claims.sum(axis=1)
    claims = claims.div(totals, axis=0)
    claims.insert(0, "total", totals)
    examples = [
        f"    {kind}, {item}: {detail}"
        for kind, details in f["examples"].items()
        for item, detail in details
        if detail
    ]
    constraints = ", ".join(f"{name} ({n:,} responses)" for name, n in f["constraints"].items())
    parts = [
        f"sample: {f['sample'] or 'none, all training items'}\nconstraint: {constraints or 'none'}",
        pd.Series(counts).to_string(),
        *(_format_table(table) for table in (attempts, rejected)),
        "\n".join(examples),
        _format_lengths(f["lengths"]) if f["accepted"] else "",
        _format_table(sufficiency.astype({"rationales": int}).rename_axis("sufficiency")),
        _format_table(claims.rename_axis("claims")),
        _format_cost(f) if f["requests"] else "",
    ]
    return "\n\n".join(filter(None, parts))


def _format_table(table: pd.DataFrame) -> str:
    return "" if table.empty else table.to_string(float_format="{:.1%}".format, na_rep="none")


def _format_lengths(lengths: Sequence[int]) -> str:
    low, median, high = np.percentile(lengths, [5, 50, 95])
    return (
        f"words per rationale: {min(lengths)} to {max(lengths)}, mean {np.mean(lengths):.0f}, "
        f"median {median:.0f}, 5% to 95% {low:.0f} to {high:.0f}"
    )


def _format_cost(figures: Figures) -> str:
    tokens, hours = figures["completion_tokens"], figures["hours"]
    per_rationale = tokens / max(figures["accepted"] - figures["fallback"], 1)
    rate = tokens / (3600 * hours) if hours else 0.0
    return (
        f"cost: {figures['requests']:,} requests, {figures['prompt_tokens']:,} prompt tokens, "
        f"{tokens:,} completion tokens ({per_rationale:,.0f} per accepted rationale), {hours:.2f} "
        f"hours of the servers, {rate:,.0f} tokens/s"
    )


def write_report(
    store: Store,
    responses: Mapping[str, Sequence[Rationale]],
    figures: Figures,
    count: int,
    cfg: TeacherConfig,
    folder: Path,
) -> Path:
    """Write report.json, report.txt and report.html, which shows the accepted and the rejected
    responses to `count` items. Return the path of report.html."""
    import jinja2

    from dynapix.conf.files import write_bytes
    from dynapix.data.publish.contact_sheets import SheetRows, draw_sheet

    teacher = name_teacher(cfg)
    text = f"teacher: {teacher}\npredicates: {name_vocabulary(cfg)}\n{format_figures(figures)}"
    write_json(folder / "report.json", {"teacher": teacher, **figures})
    write_text(folder / "report.txt", text + "\n")
    rows, grounding, examples = SheetRows(store), Grounding(store, cfg), []
    for item in choose_examples(store.training_items(), responses, count, cfg.seed):
        write_bytes(folder / "images" / f"{item.item_id}.png", draw_sheet([rows.make(item)]))
        predicates = grounding.describe(item)
        facts = predicates and choose_vocabulary(predicates, cfg)
        shown = sorted(responses[item.item_id], key=lambda r: not r.accepted)
        examples.append((item, shown, json.dumps(facts and format_facts(facts), indent=1)))
    template = (files("dynapix.teacher") / "templates" / "report.html").read_text()
    page = jinja2.Template(template, autoescape=True).render(
        teacher=teacher,
        name_constraint=name_constraint,
        text=text,
        narrated=sum(map(bool, responses.values())),
        benchmark=store.name,
        examples=examples,
    )
    write_text(folder / "report.html", page)
    return folder / "report.html"


def name_constraint(rationale: Rationale) -> str:
    """Return what constrained the server: "grammar VERSION", "cited VERSION" or "none"."""
    version = rationale.grammar or "none"
    return f"grammar {version}" if version.isdecimal() else version


def name_teacher(cfg: TeacherConfig) -> str:
    """Return the name of a teacher with its model and its servers."""
    if cfg.url is None:
        return f"{cfg.name} (the built-in narrator)"
    return f"{cfg.name} ({cfg.model} at {', '.join(cfg.urls)})"


def choose_examples(
    items: Sequence[SelectionItem],
    responses: Mapping[str, Sequence[Rationale]],
    count: int,
    seed: int,
) -> list[SelectionItem]:
    """Return a random sample of `count` items with responses, in their order. Up to half of them
    have a rejected response, if there are any, so that rejected texts are shown too."""
    narrated = [item for item in items if responses.get(item.item_id)]
    order = np.random.default_rng(seed).permutation(len(narrated)).tolist()
    rejected = [k for k in order if not all(r.accepted for r in responses[narrated[k].item_id])]
    chosen = dict.fromkeys([*rejected[: count // 2], *order])
    return [narrated[k] for k in sorted([*chosen][:count])]
