"""A retriever merged into its base: written, read back, and held against the trained one."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch.nn.utils.rnn import pad_sequence

from conf.errors import UserError
from conf.schema import ContrastiveCommand, ExportModelCommand, LoraConfig
from data.build import ensure_benchmark
from data.records import RetrievalQuery
from data.render.frame_cache import FrameReader
from models import loading
from models.retriever.embedder import (
    Retriever,
    frame_input,
    load_merged,
    load_retriever,
    load_trained,
    query_input,
)
from train.retriever.run import split

log = logging.getLogger(__name__)

CHECKED = 64
"""Held-out queries that the exported retriever is checked on, against the targets of all."""
LARGEST_DIFFERENCE = 0.1
"""Of embeddings, as a share of their size, and of scores, as one of a query's with itself. Of a
small retriever with adapters as heavy as its base, rounding to bf16 moves embeddings by 0.03."""

Measured = dict[str, float]


def write_merged(
    settings: ContrastiveCommand, saved: Path, cfg: ExportModelCommand, folder: Path
) -> Measured:
    """Write the merged weights, the processor and the modules after them, read them back as anyone
    reads them, and measure how far what is embedded is from what the retriever in `saved` embeds,
    adapters over the 4-bit base.

    Raises:
        UserError: it is too far.
    """
    preset, precision = settings.retriever, settings.train.precision
    store = ensure_benchmark(settings.benchmark, Path(cfg.store), cfg.workers)
    held_out = split(settings, store)[1][:CHECKED]
    frames = FrameReader(store, preset.image_size)
    log.info("asking the trained retriever")
    model = load_trained(preset, precision, saved)
    # As it was trained: packed for inference, some CPUs round 4-bit products another way.
    loading.keep_differentiable(model)
    before = outputs(model, settings, held_out, frames)
    log.info("merging")
    # Of two models of this size a GPU holds one.
    model.cpu()
    plain = replace(preset, lora=LoraConfig(rank=0))
    base = load_retriever(plain, precision, [], folder)[0].model
    model[0].model = loading.merge_adapters(base, saved, preset.quantization, cfg.format)
    model.save_pretrained(str(folder), create_model_card=False)
    del model, base
    log.info("asking the exported retriever")
    after = outputs(load_merged(folder, preset), settings, held_out, frames)
    measured = compare(before, after)
    for name in ("query_difference", "score_difference"):
        # A NaN is no small difference.
        if not (found := measured[name]) <= LARGEST_DIFFERENCE:
            raise UserError(
                f"the {name.replace('_', ' ')} of the exported retriever from {saved} is "
                f"{found:.3g} of its size, more than {LARGEST_DIFFERENCE}; nothing was exported. "
                "Try format=fp32 or format=adapter"
            )
    return measured


@dataclass(frozen=True)
class RetrieverOutputs:
    """What a retriever gives for some queries and their targets, fp32.

    Attributes:
        queries: (Q, ...) embeddings.
        scores: (Q, targets) before they are scaled.
        own: (Q,) each query's score with itself, the most that it can have: 1 of one vector, and of
            many one a token.
    """

    queries: torch.Tensor
    scores: torch.Tensor
    own: torch.Tensor


def outputs(
    model: Retriever,
    settings: ContrastiveCommand,
    queries: list[RetrievalQuery],
    frames: FrameReader,
) -> RetrieverOutputs:
    """The outputs for queries and for their targets, each of these once."""
    preset = settings.retriever
    targets = dict.fromkeys(q.target for q in queries)
    batch = {"batch_size": 8, "show_progress_bar": False}
    asked = [query_input(q, frames, preset) for q in queries]
    shown = [frame_input(f, frames) for f in targets]
    asked = model.encode_query(asked, prompt=preset.query_instruction, **batch)
    shown = model.encode_document(shown, prompt=preset.frame_instruction, **batch)
    asked, shown = (rows_of(made) for made in (asked, shown))
    own = model.similarity(asked, asked).diagonal()
    return RetrieverOutputs(asked, model.similarity(asked, shown).cpu(), own.cpu())


def rows_of(embedded: list) -> torch.Tensor:
    """(rows, ...) of what the library gives; fewer vectors are filled up with zeros."""
    rows = [torch.as_tensor(one).float().cpu() for one in embedded]
    return pad_sequence(rows, batch_first=True)


def compare(before: RetrieverOutputs, after: RetrieverOutputs) -> Measured:
    """The sizes of the differences of the queries' embeddings, as a share of their own size, and of
    the scores, as a share of those that queries have with themselves, since scores may all be near
    zero; and the share of queries whose best frame is the same."""
    same = before.scores.argmax(dim=1) == after.scores.argmax(dim=1)
    return {
        "query_difference": size(after.queries - before.queries) / size(before.queries),
        "score_difference": size(after.scores - before.scores) / size(before.own),
        "best_frame_agreement": float(same.float().mean()),
    }


def size(values: torch.Tensor) -> float:
    """The root of the mean square."""
    return float(values.square().mean().sqrt())
