"""Retrieval queries as a task of MTEB (`pip install 'dynapix[mteb]'`):

    import dynapix, mteb
    from dynapix.integrations.mteb_task import ClipEncoder, RetrievalTask

    bench = dynapix.load("tiny", image_size=336)
    task = RetrievalTask(bench)
    mteb.evaluate(mteb.get_model("openai/clip-vit-base-patch32"), task)
    mteb.evaluate(ClipEncoder(bench, "checkpoints/contrastive/RUN"), task)

MTEB has no clips with the times of their frames. A query is the question and one image: the frames
of the prefix in a grid, in the order of time from left to right. `ClipEncoder` looks up the clips
and embeds them as `evaluation.retrieve` does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from datasets import Dataset, Features, Value
from datasets import Image as ImageFeature
from mteb import TaskMetadata
from mteb.abstasks import AbsTaskRetrieval
from mteb.models import ModelMeta
from mteb.models.abs_encoder import AbsEncoder
from mteb.models.model_meta import ScoringFunction
from mteb.types import PromptType
from PIL import Image

from dynapix.benchmark import Benchmark
from dynapix.conf.errors import UserError
from dynapix.conf.files import expand_path
from dynapix.conf.schema import ContrastiveCommand
from dynapix.data.frames.frame_cache import encode_png
from dynapix.models.fingerprints import model_id, weights_digest
from dynapix.models.resolved_settings import resolve_precision
from dynapix.models.retriever.embedder import load_trained
from dynapix.models.retriever.inputs import embed
from dynapix.models.trained_runs import product_folder, read_trained_settings, run_title


class RetrievalTask(AbsTaskRetrieval):
    """Find the future frame in the database of a benchmark.

    The predictions that MTEB saves contain the score of every frame, from which
    `RetrievalScores.from_mteb` computes the measures of `evaluation.retrieve`.
    """

    # The base class builds its prompts from the metadata of the class.
    metadata = TaskMetadata(
        name="DynaPixRetrieval",
        description="Find the exact future frame of a physical scene.",
        dataset={"path": "dynapix", "revision": "none"},
        type="Any2AnyRetrieval",
        category="it2i",
        modalities=["text", "image"],
        eval_splits=["test"],
        eval_langs=["eng-Latn"],
        main_score="recall_at_10",
        prompt={"query": "Find the frame that answers the question."},
        domains=["Constructed"],
        annotations_creators="derived",
        sample_creation="created",
        is_public=True,
    )

    def __init__(self, benchmark: Benchmark) -> None:
        # Results of other benchmarks, splits and sizes are not reused from MTEB's cache.
        revision = f"{benchmark.store.identity}-{benchmark.frames}-{benchmark.image_size}"
        name = f"DynaPixRetrieval-{benchmark.name}-{benchmark.pool}"
        changes = {
            "name": name,
            "dataset": {"path": str(benchmark.store.folder), "revision": revision},
            "eval_splits": [benchmark.split],
        }
        self.metadata = self.metadata.model_copy(update=changes)
        self.benchmark = benchmark
        self.k_values = (1, 3, 5, 10, 20, 100, len(benchmark.database))
        super().__init__()

    def load_data(self, num_proc: int | None = None, **_: Any) -> None:
        """Read the queries and the database."""
        queries = list(self.benchmark.retrieval)
        grids = ((q.query_id, q.question, draw_grid(q.prefix)) for q in queries)
        frames = ((frame.name, Image.fromarray(frame.image)) for frame in self.benchmark.database)
        data = {
            "queries": write_rows(("id", "text", "image"), grids),
            "corpus": write_rows(("id", "image"), frames),
            "relevant_docs": {q.query_id: {q.target.name: 1} for q in queries},
            "top_ranked": None,
        }
        self.dataset = {"default": {self.benchmark.split: data}}
        self.data_loaded = True


def write_rows(names: tuple[str, ...], rows: Iterable[tuple[Any, ...]]) -> Dataset:
    """Return rows as a dataset whose images are decoded when they are read."""
    types = {name: Value("string") for name in names} | {"image": ImageFeature()}
    columns: dict[str, list[Any]] = {name: [] for name in names}
    for row in rows:
        for name, value in zip(names, row, strict=True):
            columns[name].append(
                {"bytes": encode_png(value)} if isinstance(value, Image.Image) else value
            )
    return Dataset.from_dict(columns, Features(types))


def draw_grid(frames: np.ndarray) -> Image.Image:
    """Return frames (T, H, W, 3) uint8 as one image, row by row."""
    count, height, width, channels = frames.shape
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    grid = np.zeros((rows * columns, height, width, channels), np.uint8)
    grid[:count] = frames
    grid = grid.reshape(rows, columns, height, width, channels).transpose(0, 2, 1, 3, 4)
    return Image.fromarray(grid.reshape(rows * height, columns * width, channels))


class ClipEncoder(AbsEncoder):
    """A trained retriever, which embeds the clips of a benchmark instead of grids.

    Args:
        benchmark: The benchmark of the task.
        run: Folder of a run of `train.contrastive` or of an export of it. Its settings choose the
            number and the size of frames.
        batch: Number of inputs in a batch.

    Raises:
        UserError: The folder contains no finished retriever, or a multi-vector one.
    """

    def __init__(self, benchmark: Benchmark, run: str | Path, batch: int = 32) -> None:
        folder = Path(expand_path(str(run)))
        settings = read_trained_settings(folder, ContrastiveCommand, "retriever")
        self._preset, self._batch = settings.retriever, batch
        if self._preset.late is not None:
            raise UserError(
                f"{folder} is a multi-vector retriever, which this encoder does not rank: use "
                "python -m evaluation.retrieve",
                code="unsupported-model",
            )
        self._frames = Benchmark(
            benchmark.store, benchmark.split, self._preset.frames, self._preset.image_size
        ).reader
        self._records = {
            record.name: record
            for record in (
                *(query.record for query in benchmark.retrieval),
                *(frame.ref for frame in benchmark.database),
            )
        }
        saved = product_folder(folder, "retriever")
        precision = resolve_precision(settings.train.precision)
        self.model = load_trained(self._preset, precision, saved)
        self.mteb_model_meta = ModelMeta.create_empty(
            {
                "name": f"dynapix/{run_title(folder)}",
                # MTEB keeps results by name and revision, and a run may be trained again.
                "revision": weights_digest(
                    model_id(self._preset.model, self._preset.revision), saved
                ),
                "modalities": ["text", "image"],
                "similarity_fn_name": ScoringFunction.COSINE,
            }
        )

    def encode(
        self, inputs: Any, *, prompt_type: PromptType | None = None, **_: Any
    ) -> torch.Tensor:
        """Embed the queries or frames whose ids are in `inputs`: (inputs, width), on the CPU."""
        records = [self._records[name] for batch in inputs for name in batch["id"]]
        return torch.stack(embed(self.model, records, self._frames, self._preset, self._batch))
