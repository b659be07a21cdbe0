"""A benchmark in memory, with any number of scenes and items."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import Scene, SelectionItem
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.prompts import build_messages
from tests.teacher import synthetic


@dataclass
class MemoryStore:
    """The parts of a `data.store.Store` that the teacher reads; rationales go to `folder`."""

    folder: Path
    scenes: dict[str, Scene]
    items: list[SelectionItem]

    def scene(self, scene_id: str) -> Scene:
        return self.scenes[scene_id]

    def selection(self, split: str | None = None) -> list[SelectionItem]:
        return [i for i in self.items if split in (None, i.split)]

    def training_items(self) -> list[SelectionItem]:
        return self.selection("train")


def make_store(folder: Path, count: int) -> MemoryStore:
    """Return a store with `count` items, each with its own scene. The prefix of item-5 is too short
    for predicates; the last item is a test item."""
    rng = np.random.default_rng(4)
    scenes, items = {}, []
    for k in range(count):
        scenes[f"s{k}"] = synthetic.scene(
            rng.uniform(-2, -1, (1, 2)).tolist() + rng.uniform(1, 2, (1, 2)).tolist(),
            [(0.3, 0.1), (0, 0)],
            scene_id=f"s{k}",
        )
        items.append(
            synthetic.item(
                (60, 80, 100, 120),
                answer=k % 4,
                start=30 if k == 5 else 10,
                stop=33 if k == 5 else 30,
                item_id=f"item-{k}",
                scene_id=f"s{k}",
                split="test" if k == count - 1 else "train",
            )
        )
    return MemoryStore(folder, scenes, items)


def prompts_and_rationales(store: MemoryStore) -> list[tuple[str, str, str]]:
    """Return the system prompt, user prompt and rationale of each item that has predicates."""
    texts = []
    for item in store.selection():
        predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
        if predicates:
            paper = predicates.without_relations()
            system, user = build_messages(paper, item, TeacherConfig(name="template"))
            rationale = write_rationale(paper, item, 0)
            texts.append((system["content"], user["content"], rationale))
    return texts
