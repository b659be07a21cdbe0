"""Write training samples as rows that the trainers of other libraries read.

    trl         prompt, completion, images                    for TRL's SFTTrainer
    sharegpt    conversations, images                         for LLaMA-Factory
    swift       messages, images                              for ms-swift
    embedding   query, positive, negative_1, negative_2, ...  for sentence-transformers

A prompt is that of a student or retriever to which a clip is shown as images, each after its time:
these trainers take no clips with the times of their frames. The rows of students are JSON lines,
whose images are in `images/`, named by the hash of their pixels; `datasets` loads those of TRL with
`load_dataset("imagefolder", data_dir=FOLDER)`. The rows of retrievers are a parquet file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from dynapix.conf.files import write_bytes
from dynapix.conf.schema import ExportCommand
from dynapix.data.checks.queries import read_queries
from dynapix.data.frames.frame_cache import FrameReader, encode_png
from dynapix.data.publish.folders import Shard, describe_file, write_folder
from dynapix.data.records import RetrievalQuery
from dynapix.data.store import Store
from dynapix.models.retriever.inputs import query_messages
from dynapix.models.student.prompts import Sample, show_frames_as_images
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train.student.dataset import SupervisedItem, supervised_items

IMAGES = "images"
ROWS_FILES = {
    "trl": "metadata.jsonl",
    "sharegpt": "train.jsonl",
    "swift": "train.jsonl",
    "embedding": "train.parquet",
}
"""The file of the rows by format."""
ROWS_VERSION = "1"
"""Changes whenever the same benchmark would give other rows."""
GROUP_ROWS = 50
"""Number of queries in a row group (about 30 MB at 336 px), which are kept in memory."""
Row = dict[str, Any]


def ensure_rows(cfg: ExportCommand, store: Store) -> list[Shard]:
    """Write the rows of a format to `cfg.folder` unless that is done, and return its only shard.

    Raises:
        UserError: See `write_folder`, `ensure_rationales` and `read_queries`.
    """
    shown = {"frames": cfg.student.frames, "image_size": cfg.student.image_size}
    if cfg.format == "embedding":
        samples = read_queries(store, "train", "future")
        settings = shown
    else:
        samples = _list_items(cfg, store)
        settings = {**shown, "regime": cfg.train.regime, "teacher": asdict(cfg.teacher)}
    plan = {
        "format": cfg.format,
        "benchmark": store.identity,
        "settings": json.loads(json.dumps(settings)),
        "version": ROWS_VERSION,
    }

    def write(unfinished: Path) -> list[Shard]:
        frames = FrameReader(store, cfg.student.image_size)
        path = unfinished / ROWS_FILES[cfg.format]
        with tqdm(samples, desc="exporting", unit="row", mininterval=1.0) as bar:
            if cfg.format == "embedding":
                _write_table(path, (query_row(query, frames, cfg.student.frames) for query in bar))
            else:
                folder = PictureFolder(unfinished)
                rows = (
                    student_row(cfg.format, item, frames, cfg.student.frames, folder)
                    for item in bar
                )
                lines = [json.dumps(row, ensure_ascii=False) + "\n" for row in rows]
                write_bytes(path, "".join(lines).encode())
        shard = {"configuration": cfg.format, "split": "train", "rows": len(samples)}
        return [shard | describe_file(unfinished, path)]

    return write_folder(Path(cfg.folder), plan, write)


def _list_items(cfg: ExportCommand, store: Store) -> list[SupervisedItem]:
    """Return the training items in all modes that a regime trains, as `train.sft` does."""
    needed = cfg.train.regime != "answer_only"
    rationales = ensure_rationales(store, cfg.teacher) if needed else []
    by_item = {r.item_id: r for r in rationales}
    items = store.training_items()
    by_mode = supervised_items(store, items, by_item, cfg.train.regime, cfg.teacher)
    return [item for supervised in by_mode.values() for item in supervised]


class PictureFolder:
    """Writes the images of an export as PNGs, each once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / IMAGES).mkdir(exist_ok=True)

    def add(self, pixels: np.ndarray) -> str:
        """Write (H, W, 3) uint8 pixels unless they are there, and return the relative path."""
        digest = hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()
        name = f"{IMAGES}/{digest[:32]}.png"
        if not (self._folder / name).exists():
            write_bytes(self._folder / name, encode_png(Image.fromarray(pixels)))
        return name

    def add_all(self, images: Iterable[np.ndarray]) -> list[str]:
        return [self.add(pixels) for pixels in images]


def student_row(
    kind: str, item: SupervisedItem, frames: FrameReader, count: int, pictures: PictureFolder
) -> Row:
    """Return the row of a training sample of a student in the format `kind`."""
    sample = show_frames_as_images(item.render(frames, count))
    images = pictures.add_all(sample.images)
    labels = {"item_id": item.item.item_id, "mode": item.mode}
    if kind == "trl":
        return {
            "prompt": [{"role": "user", "content": sample.content}],
            "completion": [
                {"role": "assistant", "content": [{"type": "text", "text": sample.response}]}
            ],
            # `datasets` reads this column as `images`.
            "images_file_names": images,
        } | labels
    prompt = write_placeholders(sample)
    if kind == "swift":
        messages = [("user", prompt), ("assistant", sample.response)]
        rows = [{"role": role, "content": text} for role, text in messages]
        return {"messages": rows, "images": images} | labels
    turns = [("human", prompt), ("gpt", sample.response)]
    rows = [{"from": speaker, "value": text} for speaker, text in turns]
    return {"conversations": rows, "images": images} | labels


def write_placeholders(sample: Sample) -> str:
    """Return the text of a prompt with `<image>` in the place of each image."""
    parts = sample.content
    return "".join(part["text"] if part["type"] == "text" else "<image>" for part in parts)


def query_row(query: RetrievalQuery, frames: FrameReader, count: int) -> Row:
    """Return the row of a training query: a chat message, the target and the hard negatives."""
    [message] = query_messages(query, frames, count)
    content: list[Row] = [{"text": None, "image": None} | part for part in message["content"]]
    for part in content:
        part["image"] = part["image"] and store_image(part["image"])
    documents = [frames.image(f.scene_id, f.frame) for f in (query.target, *query.hard_negatives)]
    names = ["positive", *(f"negative_{k}" for k in range(1, len(documents)))]
    images = dict(zip(names, map(store_image, documents), strict=True))
    return {"query": [message | {"content": content}], **images}


def store_image(image: Image.Image) -> dict[str, Any]:
    """Return an image in the form that `datasets.Image` stores."""
    return {"bytes": encode_png(image), "path": None}


def _write_table(path: Path, rows: Iterator[Row]) -> None:
    """Write the rows of queries, some at a time, as a parquet file that `datasets` reads."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from datasets import Features, List, Value
    from datasets import Image as ImageFeature

    first = next(rows)
    part = {"type": Value("string"), "text": Value("string"), "image": ImageFeature()}
    query = List({"role": Value("string"), "content": List(part)})
    documents = dict.fromkeys([name for name in first if name != "query"], ImageFeature())
    features = Features({"query": query, **documents})
    unfinished = path.with_suffix(".partial")
    with pq.ParquetWriter(unfinished, features.arrow_schema, compression="zstd") as writer:
        for group in batched(chain([first], rows), GROUP_ROWS):
            writer.write_table(pa.Table.from_pylist(group, features.arrow_schema))
    unfinished.rename(path)


def batched(rows: Iterable[Row], size: int) -> Iterator[list[Row]]:
    """Yield lists of `size` rows; the last may be shorter."""
    rows = iter(rows)
    while group := list(islice(rows, size)):
        yield group
