"""What the page shows that depends on the items of a benchmark, not only on the reports of runs."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from dynapix.conf.errors import UserError
from dynapix.conf.schema.benchmark import PAIRED
from dynapix.data.checks.intervals import Interval
from dynapix.data.checks.observer import SIMULATES, load_observers
from dynapix.data.checks.observer_curve import CEILING_ERROR, ObserverCurve, observer_curves
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.oracle.events import collisions_in
from dynapix.data.records import FAMILIES, LETTERS, FrameRef, SelectionItem, sample_prefix_frames
from dynapix.data.seeded_order import interleave
from dynapix.data.store import Store, open_store
from dynapix.evaluation.metrics.future_moment import FutureMoment, measure_future_moment
from dynapix.evaluation.metrics.reasons import item_predicates, read_reasons
from dynapix.evaluation.metrics.results import SelectionResult
from dynapix.evaluation.metrics.selection import baseline_results
from dynapix.evaluation.metrics.significance import PairedComparison
from dynapix.evaluation.reporting.measurements import (
    Measurement,
    SeededResult,
    combine_seeds,
    compare_models,
)
from dynapix.evaluation.reporting.run_responses import ItemResponse, Responses
from dynapix.teacher.cited_rationales import list_facts
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.sections import SECTIONS

PREFIX_FRAMES = 6
"""Number of frames of the prefix that are shown, evenly spread."""
FRAME_WIDTH = 160
"""Width of the shown frames, in pixels."""
WEBP_QUALITY = 70


@dataclass
class ItemResults:
    """Results that need the items of a benchmark: comparisons of models over all items, and some of
    the items with their frames and the responses of the models.

    Attributes:
        entries: The shown items, in the form that page.js reads.
        frames: Data URLs of the items' frames, by name.
        notes: Sentences that say which items and frames are shown and which are missing.
        comparisons: Paired comparisons of models, by `Measurement.group`.
        seeds: Trainings with several seeds, and differences between them (see `combine_seeds`), by
            `Measurement.group`.
        baselines: Results of the baselines on the same items, by `Measurement.group`.
        observers: Curves of the observers on the same items, by `Measurement.item_set`; empty for
            items that no observer has seen.
        future_moment: By `Measurement.group` and label of a model: the shares of its answers that
            show the true future and the true moment of balanced time items.
    """

    entries: list[dict[str, Any]] = field(default_factory=list)
    frames: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    comparisons: dict[str, list[PairedComparison]] = field(default_factory=dict)
    seeds: dict[str, tuple[list[SeededResult], dict[str, dict[str, Interval]]]] = field(
        default_factory=dict
    )
    baselines: dict[str, list[SelectionResult]] = field(default_factory=dict)
    observers: dict[str, dict[str, ObserverCurve]] = field(default_factory=dict)
    future_moment: dict[str, dict[str, FutureMoment]] = field(default_factory=dict)

    def add_group(
        self,
        name: str,
        store: Store,
        models: Mapping[str, Measurement],
        limit: int,
        seed: int,
    ) -> None:
        """Compare the models of a group with each other, measure the baselines on the same items,
        and add at most `limit` of these.

        Args:
            name: The group's name (`Measurement.group`).
            models: The models' results, by label.
        """
        suites = (None, *PAIRED)
        items = {i.item_id: i for suite in suites for i in store.selection("test", suite)}
        by_label = {label: m.responses for label, m in models.items()}
        # The comparisons with controls are in the reports of the runs that measured them.
        unchanged = {label: m for label, m in models.items() if not m.variants}
        self.comparisons[name] = compare_models(unchanged, items, seed)
        self.seeds[name] = combine_seeds(unchanged, items)
        answered = [i for k, i in items.items() if any(k in r for r in by_label.values())]
        standard = [item for item in answered if item.suite == store.suite]
        if standard:
            self.baselines[name] = baseline_results(standard, store, seed)
            letters = {label: {k: a.letters for k, a in r.items()} for label, r in by_label.items()}
            self.future_moment[name] = measure_future_moment(standard, letters, seed)
        ceilings: Mapping[str, float] = {}
        if observed := self._load_observers(store):
            ceilings = observed[SIMULATES][CEILING_ERROR].to_dict()
            for m in models.values():
                own = [items[k] for k in m.responses if k in ceilings]
                # A curve is of the items of a result, so all of them must be observed.
                if len(own) == m.result.n and m.item_set not in self.observers:
                    self.observers[m.item_set] = observer_curves(observed, own, seed)
        shown = choose_items(answered, by_label, limit, seed)
        entries = page_entries(shown, by_label, store, name, ceilings)
        frames, errors = encode_frames(shown, store)
        self.entries += entries
        self.frames |= frames
        self.notes.append(
            f"{name}: {len(shown):,} of {len(answered):,} answered items, spread over "
            "subtypes and over correct and wrong answers. Set items=N to show another number."
        )
        if errors:
            more = f" (and of {len(errors) - 1:,} other scenes)" if errors[1:] else ""
            self.notes.append(f"Frames are missing: {errors[0]}{more}.")

    def _load_observers(self, store: Store) -> dict[str, pd.DataFrame] | None:
        """Return the results of the observers on the test items, if the store has them."""
        config, results = store.manifest["config"], load_observers(store, "test")
        if results is None and config["simulator"] == "bullet":
            self.notes.append(
                f"No observers have seen {store.name}: run python -m data.statistics "
                f"benchmark={config['name']} world={config['world']['name']} observer=true "
                "to report accuracies as errors in px."
            )
        return results


def read_item_results(
    selections: Sequence[Measurement], stores: Path, limit: int, seed: int
) -> ItemResults:
    """Return at most `limit` items of each group of results whose benchmark is in `stores`."""
    by_item = ItemResults()
    for group in dict.fromkeys(m.group for m in selections):
        of_group = [m for m in selections if m.group == group]
        name, build = of_group[0].benchmark, of_group[0].run.report.build
        models = {", ".join([m.label, *m.variants]): m for m in of_group}
        try:
            store = open_store(stores / name)
            if build == store.identity:
                by_item.add_group(group, store, models, limit, seed)
                continue
            # Items of two builds can differ although they have the same ids.
            problem = f"{store.folder} has another build"
        except UserError as error:
            problem = str(error).replace("benchmark=NAME", f"benchmark={name}")
        by_item.notes.append(f"The items of {group} cannot be shown: {problem}.")
    return by_item


def choose_items(
    items: Sequence[SelectionItem], responses: Mapping[str, Responses], limit: int, seed: int
) -> list[SelectionItem]:
    """Return at most `limit` random items, sorted by family and subtype.

    The items are spread evenly over the subtypes. Within a subtype, they are spread evenly over the
    combinations of models that answered correctly.
    """

    def subtype(item: SelectionItem) -> tuple[int, str]:
        return FAMILIES.index(item.family), item.subtype

    def subtype_and_verdicts(item: SelectionItem) -> tuple:
        to_item = [r.get(item.item_id) for r in responses.values()]
        return *subtype(item), *(r and r.letter == item.letter for r in to_item)

    order = np.random.default_rng(seed).permutation(len(items))
    interleaved = interleave([items[k] for k in order], subtype_and_verdicts)
    return sorted(interleave(interleaved, subtype)[:limit], key=subtype)


def page_entries(
    items: Sequence[SelectionItem],
    responses: Mapping[str, Responses],
    store: Store,
    group: str,
    ceilings: Mapping[str, float],
) -> Iterator[dict[str, Any]]:
    """Yield the data of each item for the page, with frames by the names in `encode_frames`.
    `ceilings` has the chance of an observer by item id, for the items that it has seen."""
    for item in items:
        yield {
            "id": item.item_id,
            "benchmark": group,
            "family": item.family,
            "subtype": item.subtype,
            "question": item.question,
            "prefix": [f"{store.name}/{frame.name}" for frame in _prefix(item)],
            "observed": f"frames {item.prefix_start} to {item.prefix_stop} of {item.scene_id}",
            "candidates": [
                {
                    "letter": letter,
                    "frame": f"{store.name}/{c.name}",
                    "caption": f"{c.source.replace('_', ' ')}: frame {c.frame}"
                    + (f" of {c.scene_id}" if c.scene_id != item.scene_id else ""),
                }
                for letter, c in zip(LETTERS, item.candidates, strict=True)
            ],
            "answer": item.letter,
            "truth": describe_truth(item, store, ceilings.get(item.item_id)),
            "facts": list_oracle_facts(item, store),
            "responses": [
                _response_entry(label, r[item.item_id], item, store)
                for label, r in responses.items()
                if item.item_id in r
            ],
        }


def describe_truth(item: SelectionItem, store: Store, ceiling: float | None) -> list[str]:
    """Return sentences about the target, about the collisions between the prefix and it, and about
    the chance of an observer, if one has seen the item."""
    scene = store.scene(item.scene_id)
    sentences = [
        f"{item.letter} is correct: frame {item.target_frame}, "
        f"{item.target_frame - item.prefix_stop} frames after the prefix. Between any two "
        f"candidates, an object is displaced by {item.min_displacement:.0f} px or more."
    ]
    for collision in collisions_in(scene, item.prefix_stop + 1, item.target_frame):
        first, second = (scene.objects[k].noun_phrase for k in collision.objects)
        sentences.append(f"The {first} and the {second} collide at frame {collision.frame}.")
    if ceiling is not None:
        sentences.append(
            f"An observer who sees the objects with an error of {CEILING_ERROR:g} px and simulates "
            f"the scene is right in {100 * ceiling:.0f}% of its draws."
        )
    return sentences


def list_oracle_facts(item: SelectionItem, store: Store) -> list[str]:
    """Return in words the main facts of the oracle with which the claims about an item are
    compared; none if the item has no predicates."""
    predicates = item_predicates(item, store)
    return [] if predicates is None else [*list_facts(predicates, item).values()]


def _response_entry(
    label: str, response: ItemResponse, item: SelectionItem, store: Store
) -> dict[str, Any]:
    letter = response.letter
    verdict = "correct" if letter == item.letter else "wrong" if letter else "unparsed"
    return {
        "model": label, "letter": letter, "verdict": verdict, "reason": response.reason,
        "text": response.text, "truncated": response.truncated,
        "claims": mark_claims(item, response, store),
    }  # fmt: skip


def mark_claims(item: SelectionItem, response: ItemResponse, store: Store) -> list[dict[str, Any]]:
    """Return the spans of the claims of a rationale that count as reasons, in text order, each with
    the verdicts on the claims that it states, and with these claims in words. Of overlapping
    spans, the first is returned."""
    if SECTIONS[0] not in response.text:
        return []
    reasons = read_reasons(item, response.text, response.letter, store)
    claims = [c for part in reasons.claims.values() for c in part] if reasons else []
    by_span: dict[tuple[int, int], list[Claim]] = {}
    for claim in claims:
        by_span.setdefault(claim.span, []).append(claim)
    marks, end = [], 0
    for (start, stop), stated in sorted(by_span.items()):
        if start < end:
            continue
        verdicts = {c.verdict for c in stated}
        worst = next(v for v in ("contradicted", "unknown", "supported") if v in verdicts)
        title = "; ".join(f"{c}: {c.verdict}" for c in stated)
        marks.append({"start": start, "stop": stop, "verdict": worst, "title": title})
        end = stop
    return marks


def _prefix(item: SelectionItem) -> list[FrameRef]:
    frames = sample_prefix_frames(item.prefix_start, item.prefix_stop, PREFIX_FRAMES)
    return [FrameRef(item.scene_id, frame) for frame in frames]


def encode_frames(items: Sequence[SelectionItem], store: Store) -> tuple[dict[str, str], list[str]]:
    """Return the frames of the items, and an error message for each scene whose frames cannot be
    read. Frames are WebP data URLs by name: benchmark, scene and frame index."""
    wanted: dict[str, set[int]] = {}
    for item in items:
        for frame in (*_prefix(item), *item.candidates):
            wanted.setdefault(frame.scene_id, set()).add(frame.frame)
    reader, frames, errors = FrameReader(store), {}, []
    for scene_id, indices in tqdm(wanted.items(), desc=f"frames of {store.name}", unit="scene"):
        ordered = sorted(indices)
        try:
            stack = reader.stack(scene_id, ordered)
        except (UserError, OSError) as error:
            errors.append(str(error))
            continue
        for index, pixels in zip(ordered, stack, strict=True):
            frames[f"{store.name}/{FrameRef(scene_id, index).name}"] = encode_webp(pixels)
    return frames, errors


def encode_webp(pixels: np.ndarray) -> str:
    """Return pixels (height, width, 3) as the data URL of an image that is `FRAME_WIDTH` wide."""
    from PIL import Image

    height, width = pixels.shape[:2]
    size = (FRAME_WIDTH, round(height * FRAME_WIDTH / width))
    buffer = io.BytesIO()
    image = Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)
    image.save(buffer, "WEBP", quality=WEBP_QUALITY, method=6)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
