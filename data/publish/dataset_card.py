"""The dataset card of an export: what is in it, how it was made, how to load it, and its limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from data.publish.columns import MEANING
from data.records import FAMILIES, POOLS, SPLITS
from data.store import Store, component_versions

if TYPE_CHECKING:
    from datasets import Features

    from data.export import Shard

SIZES = {1e3: "n<1K", 1e4: "1K<n<10K", 1e5: "10K<n<100K", 1e6: "100K<n<1M"}


def text(
    store: Store, columns: dict[str, Features], shards: Sequence[Shard], plan: dict[str, Any]
) -> str:
    """README.md of the export that `plan` describes, written as `shards`."""
    used = {s.configuration: columns[s.configuration] for s in shards}
    sections = [
        f"---\n{front_matter(used, shards)}\n---",
        f"# DynaPix, {store.name}",
        "Which of four frames shows what a physical scene will look like, and which frame of a "
        "database? Each question comes with the frames observed before it. Scenes are simulated "
        "collisions of cubes, spheres and cylinders; every answer is the simulator's own.",
        "## What is in it",
        *_contents(store, shards),
        "## Load it",
        _loading(shards, plan),
        "## Columns",
        *(_columns(name, kinds) for name, kinds in used.items()),
        "## How it was made",
        _making(store),
        "## Limits",
        _limits(store, plan),
    ]
    return "\n\n".join(sections) + "\n"


def front_matter(columns: dict[str, Features], shards: Sequence[Shard]) -> str:
    """The card's metadata as YAML: licence, sizes, and the files and columns of each split."""
    from datasets import DatasetInfo, SplitDict, SplitInfo
    from datasets.info import DatasetInfosDict
    from huggingface_hub import DatasetCardData

    infos = DatasetInfosDict()
    configs = []
    for name, kinds in columns.items():
        mine = [s for s in shards if s.configuration == name]
        sizes: dict[str, list[Shard]] = {}
        for shard in mine:
            sizes.setdefault(shard.split, []).append(shard)
        infos[name] = DatasetInfo(
            features=kinds,
            splits=SplitDict(
                {
                    split: SplitInfo(
                        split, sum(s.uncompressed for s in of), sum(s.rows for s in of)
                    )
                    for split, of in sizes.items()
                }
            ),
            download_size=sum(s.bytes for s in mine),
            dataset_size=sum(s.uncompressed for s in mine),
        )
        files = [{"split": split, "path": f"{name}/{split}-*.parquet"} for split in sizes]
        configs.append({"config_name": name, "data_files": files})
    configs[0]["default"] = True
    rows = sum(s.rows for s in shards)
    data = DatasetCardData(
        license="apache-2.0",
        language="en",
        pretty_name="DynaPix",
        task_categories=["visual-question-answering", "multiple-choice"],
        size_categories=next((name for size, name in SIZES.items() if rows < size), "1M<n<10M"),
        annotations_creators="machine-generated",
        source_datasets=["original"],
        tags=["physics", "simulation", "video", "future-frame-selection", "image-retrieval"],
        configs=configs,
    )
    infos.to_dataset_card_data(data)
    return data.to_yaml()


def _contents(store: Store, shards: Sequence[Shard]) -> Iterable[str]:
    written = {s.configuration for s in shards}
    scenes = ", ".join(f"{len(store.scene_ids(split)):,} to {split} on" for split in SPLITS)
    yield f"{sum(len(store.scene_ids(s)) for s in SPLITS):,} scenes, {scenes}."
    if "selection" in written:
        items = store.selection()
        found = Counter(((i.family, i.subtype), i.split) for i in items)
        every = Counter(((i.family, "all"), i.split) for i in items)
        order = dict.fromkeys((i.family, i.subtype) for i in items)
        rows = [
            (*key, *(counts[key, split] for split in SPLITS))
            for family in FAMILIES
            for counts, keys in ((every, [(family, "all")]), (found, order))
            for key in keys
            if key[0] == family
        ]
        yield "Selection items:"
        yield _table(("family", "subtype", *SPLITS), rows)
    if "retrieval" in written:
        queries = [q for pool in POOLS for q in store.retrieval(pool=pool)]
        found = Counter(((q.pool, q.builder or "", q.anchor), q.split) for q in queries)
        order = sorted({key for key, _ in found}, key=lambda key: (POOLS.index(key[0]), str(key)))
        yield "Retrieval queries:"
        rows = [(*key, *(found[key, split] for split in SPLITS)) for key in order]
        yield _table(("pool", "builder", "anchor", *SPLITS), rows)
    if "database" in written:
        frames = Counter()
        for shard in shards:
            if shard.configuration == "database":
                frames[shard.split] += shard.rows
        yield "Databases, from which a test query's target is retrieved:"
        yield _table(("database", "frames"), frames.items())


def _loading(shards: Sequence[Shard], plan: dict[str, Any]) -> str:
    lines = ["```python", "from datasets import load_dataset", ""]
    for name in dict.fromkeys(s.configuration for s in shards):
        splits = dict.fromkeys(s.split for s in shards if s.configuration == name)
        split = "test" if "test" in splits else next(iter(splits))
        lines.append(f'{name} = load_dataset("FOLDER", "{name}", split="{split}")')
    lines += ["```", ""]
    told = (
        "FOLDER is this folder, or the dataset's name on a hub; it needs `datasets` 4 or later. "
        "`streaming=True` reads row by row without a copy in the cache."
    )
    if not plan["images"]:
        told += (
            " Rows name frames by scene and index, without their pixels: these are in the store "
            "that this was exported from, or can be drawn anew from its scenes."
        )
    return "\n".join([*lines, told])


def _columns(name: str, kinds: Features) -> str:
    rows = [(f"`{column}`", MEANING[column]) for column in kinds]
    return f"`{name}`:\n\n" + _table(("column", "meaning"), rows)


def _making(store: Store) -> str:
    settings = store.manifest["config"]
    made_by = component_versions(
        settings["simulator"], settings["renderer"], settings.get("standin")
    )
    told = ", ".join(f"{name} {version}" for name, version in made_by.items())
    config = OmegaConf.to_yaml(OmegaConf.create(settings))
    return (
        "Scenes are simulated by Bullet and rendered from the simulator's record; items and "
        "queries are drawn from that record alone. Versions of the parts that make it: "
        f"{told}. The store that this was exported from is `{store.identity}`. The same "
        "settings and versions give the same scenes, items and frames again:\n\n"
        f"<details><summary>Settings</summary>\n\n```yaml\n{config}```\n\n</details>"
    )


def _limits(store: Store, plan: dict[str, Any]) -> str:
    scene = store.scene(store.scene_ids("test")[0])
    limits = [
        "The answers are in the files, those of the test split too: keep that split out of "
        "training, and out of prompts.",
        "Scenes are simple: rigid objects of one size and three shapes on a plane, one fixed "
        f"camera, {scene.frames} frames at {scene.fps:g} a second. Results say little about real "
        "footage.",
        "A candidate of another scene (`cross_scene`) shows other objects, so it can be ruled out "
        "without foresight. Report such subtypes apart.",
        "Two candidates of an item differ in some object by `min_displacement` px or more, which "
        "need not be the object that a person looks at first.",
        "Questions of the event and window families do not say how far ahead the target lies: a "
        "wrong candidate of the same scene may be a true frame of another moment.",
        "Hard negatives are named, not shown: their frames are in the store.",
    ]
    if not plan["url"] or not plan["published"]:
        limits.append(
            "`croissant.json` lacks what only a published dataset has, its address and date."
        )
    for cell, found in store.manifest["shortfalls"].items():
        limits.append(f"`{cell}` has {found}: more could not be found in these scenes.")
    return "\n".join(f"- {limit}" for limit in limits)


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(c) for c in line) + " |" for line in lines)


def _cell(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value)
