"""Queries that share a prefix, in one pass: the prefix's tokens, and after them each question's.

Attention is causal, so a prefix is the same whatever question follows it. In a row of the batch a
question sees the prefix and itself, at the positions that it would have alone; what comes out is
what each query gives by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from sentence_transformers import SentenceTransformer

from conf.schema import RetrieverConfig
from data.records import RetrievalQuery
from data.render.frame_cache import FrameReader
from models.retriever.embedder import query_input

OWN = "own"
"""Where in a batch's rows each query's tokens stand, its last one last: (Q, 1 + L) its row and the
columns; what is left of them on the left is -1."""
HIDDEN = torch.finfo(torch.bfloat16).min
"""What is added to the score of a token that is not seen: finite in every precision, so that a row
of padding has a softmax."""


@dataclass(frozen=True)
class Row:
    """A prefix and its questions: (L,) ids and token types, (3, L) positions, (L, L) who sees whom,
    and where each query's tokens stand."""

    ids: torch.Tensor
    types: torch.Tensor
    positions: torch.Tensor
    sees: torch.Tensor
    own: list[torch.Tensor]


def shared_input(
    model: SentenceTransformer,
    groups: Sequence[Sequence[RetrievalQuery]],
    frames: FrameReader,
    cfg: RetrieverConfig,
) -> dict[str, Any]:
    """What the retriever's forward takes for queries in groups of one prefix each."""
    first = [query_input(group[0], frames, cfg) for group in groups]
    made = model.preprocess(first, prompt=cfg.query_instruction)
    if all(len(group) == 1 for group in groups):
        return made
    rotary, _ = model[0].model.get_rope_index(
        input_ids=made["input_ids"],
        mm_token_type_ids=made["mm_token_type_ids"],
        video_grid_thw=made["video_grid_thw"],
        attention_mask=made["attention_mask"],
    )
    rows = [
        branched(
            made["input_ids"][k][kept],
            made["mm_token_type_ids"][k][kept],
            rotary[:, k, kept],
            [told(model, query) for query in group],
        )
        for k, (group, kept) in enumerate(zip(groups, made["attention_mask"].bool(), strict=True))
    ]
    return {**made, **stacked(rows)}


def told(model: SentenceTransformer, query: RetrievalQuery) -> torch.Tensor:
    """The tokens of a question. Special tokens stand around it, so they are the same anywhere."""
    ids = model.tokenizer(query.question, add_special_tokens=False).input_ids
    return torch.tensor(ids)


def branched(
    ids: torch.Tensor, types: torch.Tensor, positions: torch.Tensor, told: Sequence[torch.Tensor]
) -> Row:
    """A row from the first query's own and the questions, hers first."""
    question = len(told[0])
    # It follows the video and what closes that.
    start = int(types.nonzero().max()) + 1
    start += ids[start:].unfold(0, question, 1).eq(told[0]).all(dim=1).nonzero()[0].item()
    ending = ids[start + question :]
    branches = [torch.cat([text, ending]) for text in told]
    lengths = [len(branch) for branch in branches]
    begin = int(positions[:, :start].max()) + 1
    # The prefix is 0, its questions are 1, 2, ...
    owner = torch.repeat_interleave(
        torch.arange(len(branches) + 1), torch.tensor([start, *lengths])
    )
    sees = (owner[:, None] == owner) | (owner == 0)
    return Row(
        ids=torch.cat([ids[:start], *branches]),
        types=torch.cat([types[:start], *(torch.zeros(n, dtype=types.dtype) for n in lengths)]),
        positions=torch.cat(
            [positions[:, :start], *(begin + torch.arange(n).expand(3, -1) for n in lengths)], dim=1
        ),
        sees=sees.tril(),
        own=[((owner == 0) | (owner == k)).nonzero()[:, 0] for k in range(1, len(branches) + 1)],
    )


def stacked(rows: Sequence[Row]) -> dict[str, torch.Tensor]:
    """Rows of one batch, padded on the right; what pads sees itself."""
    length = max(len(row.ids) for row in rows)
    ids = torch.zeros(len(rows), length, dtype=torch.long)
    types = torch.zeros_like(ids)
    positions = torch.zeros(3, len(rows), length, dtype=torch.long)
    sees = torch.eye(length, dtype=torch.bool).repeat(len(rows), 1, 1)
    for k, row in enumerate(rows):
        size = len(row.ids)
        ids[k, :size], types[k, :size] = row.ids, row.types
        positions[:, k, :size] = row.positions
        sees[k, :size, :size] = row.sees
    return {
        "input_ids": ids,
        "mm_token_type_ids": types,
        "position_ids": positions,
        "attention_mask": torch.where(sees, 0.0, HIDDEN)[:, None],
        OWN: own_places(rows),
    }


def own_places(rows: Sequence[Row]) -> torch.Tensor:
    length = max(len(own) for row in rows for own in row.own)
    return torch.stack(
        [
            torch.cat([torch.tensor([k]), torch.full((length - len(own),), -1), own])
            for k, row in enumerate(rows)
            for own in row.own
        ]
    )


def give_own(module: Any, _: Any, features: dict[str, Any], *, last: bool) -> dict[str, Any]:
    """After the transformer, as a hook of its forward: give what follows it a row a query, of the
    tokens that the query would have alone, or of its `last` one."""
    if (own := features.pop(OWN, None)) is not None:
        rows, columns = own[:, :1], own[:, -1:] if last else own[:, 1:]
        for name in ("token_embeddings", "input_ids"):
            features[name] = features[name][rows, columns.clamp(min=0)]
        features["attention_mask"] = (columns >= 0).long()
    return features
