"""Measures how well a student's own likelihood finds false claims.

    python -m teacher.claims_benchmark benchmark=comparison run=comparison
    python -m research.experiments.claim_likelihood checkpoints/sft/RUN \
        checkpoints/claims_benchmark/comparison

The student reads the item and the text. A claim gets two scores, the mean and the smallest
log-probability of its tokens. The table has, by source of the texts, the probability that a
supported claim gets a higher score than a contradicted one (AUC: 50% for a guess).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.stats import rankdata
from tqdm import tqdm

from benchmarks.arguments import positive_int
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import SftCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.parallel import batched
from dynapix.data.records import SelectionItem
from dynapix.data.store import Store
from dynapix.models import loading
from dynapix.models.resolved_settings import resolve_precision
from dynapix.models.student.collator import IGNORED, Collator
from dynapix.models.student.prompts import selection_sample
from dynapix.models.trained_runs import product_folder, read_trained_settings
from dynapix.teacher.claims_benchmark import CLAIMS, TEXTS
from dynapix.train.on_policy.claim_credit import find_spans
from research.experiments.experiment import open_benchmark, print_header, print_row

SCORES = ("mean", "smallest")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("student", type=Path, help="folder of a run of train.sft")
    parser.add_argument("claims", type=Path, help="folder of a run of teacher.claims_benchmark")
    parser.add_argument("--benchmark", default="comparison", help="of the claims")
    parser.add_argument("--store", type=Path, default=Path("store"))
    parser.add_argument("--texts", type=positive_int, default=2000, help="number of texts, sampled")
    parser.add_argument("--batch", type=positive_int, default=16)
    args = parser.parse_args()
    texts = pd.read_parquet(args.claims / TEXTS)
    texts = texts.sample(min(args.texts, len(texts)), random_state=0)
    claims = pd.read_parquet(args.claims / CLAIMS)
    claims = claims[claims.text_id.isin(texts.text_id)].merge(texts[["text_id", "source"]])
    store = open_benchmark(args.store, args.benchmark)
    student = Student(args.student, store)
    scores: dict[int, list[tuple[float, float]]] = {}
    for batch in tqdm([*batched([*texts.itertuples()], args.batch)], unit="batch"):
        for row, (starts, stops, logs) in zip(batch, student.read(batch), strict=True):
            own = claims[claims.text_id == row.text_id]
            for index, start, stop in zip(own.index, own.start, own.stop, strict=True):
                inside = logs[(starts < stop) & (stops > start)]
                scores[index] = (inside.mean().item(), inside.min().item())
    claims[list(SCORES)] = pd.DataFrame.from_dict(scores, orient="index")
    print_header("source", "supported", "contradicted", *(f"AUC, {name}" for name in SCORES))
    for source, rows in [*claims.groupby("source"), ("all", claims)]:
        true = (rows.verdict == "supported").to_numpy()
        found = [auc(rows[name].to_numpy(), true) for name in SCORES]
        cells = ["-" if np.isnan(share) else f"{100 * share:.1f}" for share in found]
        print_row(source, true.sum(), (~true).sum(), *cells)


def auc(scores: np.ndarray, true: np.ndarray) -> float:
    """Return the probability that a true claim has a higher score than a false one; NaN without
    claims of both kinds."""
    positive, negative = true.sum(), (~true).sum()
    if not positive or not negative:
        return np.nan
    ranks = rankdata(scores)[true].sum() - positive * (positive + 1) / 2
    return ranks / (positive * negative)


class Student:
    """A trained student that reads texts about items."""

    def __init__(self, folder: Path, store: Store) -> None:
        self._settings = read_trained_settings(folder, SftCommand, "student")
        student = self._settings.student
        self._precision = resolve_precision(self._settings.train.precision)
        weights = product_folder(folder, "student")
        self._model, processor = loading.load_trained(student, self._precision, weights)
        self._collate = Collator(processor, student.max_length)
        self._tokenizer = processor.tokenizer
        self._frames = FrameReader(store, student.image_size)
        self._items = {item.item_id: item for item in store.selection("test")}

    def read(
        self, rows: Sequence[pd.Series]
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Yield, for each text, where its tokens start and stop, and their log-probabilities."""
        samples = [self._sample(self._items[row.item_id], row.text) for row in rows]
        device = next(self._model.parameters()).device
        batch = {name: value.to(device) for name, value in self._collate(samples).items()}
        labels = batch.pop("labels")[:, 1:].cpu()
        autocast = torch.autocast(device.type, torch.bfloat16, enabled=self._precision == "bf16")
        with torch.no_grad(), autocast:
            logits = self._model(**batch, use_cache=False).logits[:, :-1].float().cpu()
        logs = torch.log_softmax(logits, dim=-1)
        logs = logs.gather(-1, labels.clamp(min=0)[..., None])[..., 0]
        for row, kept, own, values in zip(rows, labels != IGNORED, labels, logs, strict=True):
            starts, stops = find_spans(row.text, own[kept].tolist(), self._tokenizer)
            yield starts, stops, values[kept]

    def _sample(self, item: SelectionItem, text: str) -> object:
        settings = self._settings
        regime, frames = settings.train.regime, settings.student.frames
        return selection_sample(item, "reasoning", regime, self._frames, frames, response=text)


if __name__ == "__main__":
    with report_failures():
        main()
