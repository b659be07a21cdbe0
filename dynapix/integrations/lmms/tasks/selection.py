"""Selection items as a task of lmms-eval (`pip install 'dynapix[lmms]'`):

    export DYNAPIX_BENCHMARK=tiny DYNAPIX_IMAGE_SIZE=336
    lmms-eval --include_path "$(python -m dynapix.integrations.lmms)" --tasks dynapix_selection \\
        --model openai --model_args model=NAME

The variables DYNAPIX_BENCHMARK, DYNAPIX_STORE, DYNAPIX_FRAMES and DYNAPIX_IMAGE_SIZE are the
arguments of `dynapix.load`. With DYNAPIX_MODE=answer, a model is asked for the letter alone.
"""

from __future__ import annotations

import base64
import io
import os
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from datasets import Dataset, DatasetDict
from lmms_eval.api.task import ConfigurableMessagesTask
from PIL import Image

from dynapix.benchmark import Item, load
from dynapix.conf.errors import UserError
from dynapix.integrations import TOKENS
from dynapix.models.student.answer_parser import parse_choice


class SelectionTask(ConfigurableMessagesTask):
    """Choose the future frame among four candidates: a task whose items are a benchmark's."""

    def __init__(self, config: dict[str, Any], **_: Any) -> None:
        # The harness passes the YAML file, in which `class` names this class.
        settings = {name: value for name, value in config.items() if name != "class"}
        settings["generation_kwargs"]["max_new_tokens"] = TOKENS[read_mode()]
        super().__init__(config={**settings, "dataset_path": "dynapix"})

    def download(self, dataset_kwargs: Mapping[str, Any] | None = None) -> None:
        rows = [describe_item(item) for item in read_items().values()]
        self.dataset = self.dataset_no_image = DatasetDict({"test": Dataset.from_list(rows)})


@cache
def read_items() -> dict[str, Item]:
    """Return the items of the benchmark that the environment names, by id."""
    try:
        bench = load(
            os.environ.get("DYNAPIX_BENCHMARK", "tiny"),
            store=os.environ.get("DYNAPIX_STORE", "store"),
            frames=read_number("DYNAPIX_FRAMES"),
            image_size=read_number("DYNAPIX_IMAGE_SIZE"),
        )
    except UserError as error:
        sys.exit(f"error: {error}")
    return {item.item_id: item for item in bench.selection}


def describe_item(item: Item) -> dict[str, str]:
    """Return what the logs of the harness have of an item."""
    names = ("item_id", "scene_id", "family", "subtype", "question", "answer")
    return {name: getattr(item, name) for name in names}


def write_messages(doc: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the prompt of `Item.messages`, with its images in the form of the harness."""
    [message] = read_items()[doc["item_id"]].messages(read_mode())
    content = [
        part if part["type"] == "text" else {"type": "image", "url": decode_image(part)}
        for part in message["content"]
    ]
    return [message | {"content": content}]


def score(doc: Mapping[str, Any], results: Sequence[str]) -> dict[str, Any]:
    """Return what the metrics average, from the letter that `dynapix.parse_choice` reads."""
    right = float(parse_choice(results[0]).letter == doc["answer"])
    return {"macro": (doc["family"], right), "accuracy": right}


def decode_image(part: Mapping[str, Any]) -> Image.Image:
    """Return the image in a part of a chat request."""
    _, _, encoded = part["image_url"]["url"].partition(",")
    return Image.open(io.BytesIO(base64.b64decode(encoded)))


def average_families(rows: Sequence[tuple[str, float]]) -> float:
    """Return the macro accuracy: the mean of the accuracies of the item families."""
    by_family: dict[str, list[float]] = {}
    for family, right in rows:
        by_family.setdefault(family, []).append(right)
    return sum(sum(found) / len(found) for found in by_family.values()) / len(by_family)


def read_mode() -> str:
    mode = os.environ.get("DYNAPIX_MODE", "reasoning")
    if mode not in TOKENS:
        sys.exit(f"error: DYNAPIX_MODE={mode}: choose {' or '.join(TOKENS)}")
    return mode


def read_number(name: str) -> int | None:
    """Return the whole number in an environment variable; None if it is not set."""
    text = os.environ.get(name)
    if text is not None and not text.isdecimal():
        sys.exit(f"error: {name}={text}: give a whole number")
    return None if text is None else int(text)
