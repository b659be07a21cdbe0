"""Read a benchmark: its selection items, retrieval queries and database of frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.conf.files import expand_path
from dynapix.conf.schema.benchmark import INTERVENTIONS, POOLS, store_name
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import (
    FAMILIES,
    SPLITS,
    FrameRef,
    RetrievalQuery,
    SelectionItem,
    sample_prefix_frames,
)
from dynapix.data.store import MANIFEST, RATIONALES, Store, load_rows, open_store
from dynapix.models.student.chat_requests import build_messages
from dynapix.models.student.prompts import MODES, selection_sample, show_frames_as_images

Record = TypeVar("Record")


def load(
    benchmark: str | Path,
    split: str = "test",
    *,
    store: str | Path = "store",
    frames: int | None = None,
    image_size: int | None = None,
    pool: str = "future",
) -> Benchmark:
    """Open a benchmark, and build it first if it is a preset that has not been built.

    Args:
        benchmark: The name of a preset, such as `tiny`, also with the name of a world, such as
            `tiny-near`, the folder of a built benchmark, or the path or address of an archive that
            `python -m data.export archive=FILE` wrote, which is unpacked into `store`.
        split: `train` or `test`.
        store: The folder of the built benchmarks.
        frames: The number of frames of a prefix, evenly spaced. A shorter prefix has all its
            frames. None takes the benchmark's own number, `prefix_frames`.
        image_size: Frames are resized to `image_size` x `image_size` px; None keeps their size.
            Without torchvision, 0.02% of the values differ from the commands' by 1 or 2 of 255.
        pool: The retrieval queries: `future`, or `counterfactual` (where an object would be if
            another were absent).

    Raises:
        UserError: There is no such benchmark, the benchmark is damaged or of another version, or an
            argument is invalid. Building a benchmark requires the extra `simulate`.
    """
    for name, value, options in (("split", split, SPLITS), ("pool", pool, POOLS)):
        if value not in options:
            raise UserError(f"{name}={value!r}: choose {' or '.join(options)}", "unknown-option")
    for name, value in (("frames", frames), ("image_size", image_size)):
        if value is not None and value < 1:
            raise UserError(f"{name}={value}: give 1 or more", code="invalid-setting")
    name, root = expand_path(str(benchmark)), Path(expand_path(str(store)))
    opened = _open(name, root)
    count = frames or opened.manifest["config"]["prefix_frames"]
    return Benchmark(opened, split, count, image_size, pool)


def _open(name: str, root: Path) -> Store:
    """Return the benchmark of an archive, a folder, or a preset, which is built if necessary."""
    if name.endswith(".zip") or name.startswith(("http://", "https://")):
        # A progress bar needs one more package.
        from dynapix.data.publish.archive import open_archive

        return open_archive(name, root)
    folder = Path(name)
    if not (folder / MANIFEST).exists():
        folder = root / name
    return open_store(folder) if (folder / MANIFEST).exists() else _open_preset(name, root)


def preset_names(group: str = "benchmark") -> list[str]:
    """Return the names of the presets of a group of settings, such as `benchmark` or `world`."""
    return sorted(p.name.removesuffix(".yaml") for p in (files("dynapix.conf") / group).iterdir())


def _open_preset(name: str, root: Path) -> Store:
    """Return the benchmark of a preset, and build it first if it is missing."""
    presets, worlds = preset_names(), preset_names("world")
    preset, _, world = name.partition("-")
    if preset not in presets or (world and world not in worlds):
        built = sorted(path.parent.name for path in root.glob(f"*/{MANIFEST}"))
        raise UserError(
            f"there is no benchmark {name!r}: give a preset ({', '.join(presets)}), a preset and a "
            f"world such as tiny-near ({', '.join(worlds)}), a built benchmark in {root} "
            f"({', '.join(built) or 'none'}), or the folder of one",
            code="unknown-benchmark",
        )
    try:
        from dynapix.conf.compose import compose
        from dynapix.conf.schema import BuildCommand
        from dynapix.data.build import ensure_benchmark
    except ImportError as error:
        folder = root / store_name(preset, world or _preset_world(preset))
        if (folder / MANIFEST).exists():
            return open_store(folder)
        raise UserError(
            f"{folder} is not built, and building it needs {error.name}: "
            "pip install -e '.[simulate]'",
            code="missing-package",
        ) from error
    overrides = [f"benchmark={preset}", *([f"world={world}"] if world else [])]
    cfg = compose("data.build", BuildCommand, overrides)
    return ensure_benchmark(cfg.benchmark, root, cfg.workers)


def _preset_world(preset: str) -> str:
    """Return the world of a benchmark's preset, without Hydra."""
    import yaml

    text = (files("dynapix.conf") / "benchmark" / f"{preset}.yaml").read_text(encoding="utf-8")
    for default in yaml.safe_load(text).get("defaults", ()):
        if isinstance(default, dict):
            return default["override /world"]
        if default != "_self_":
            return _preset_world(default)
    return "clevrer"


class Lazy(Sequence, Generic[Record]):
    """A sequence whose elements, `kind(record, benchmark)`, are made when they are accessed. Slices
    are such sequences, too."""

    def __init__(
        self, kind: Callable[..., Record], records: Sequence[Any], benchmark: Benchmark
    ) -> None:
        self._kind, self._records, self._benchmark = kind, records, benchmark

    def __len__(self) -> int:
        return len(self._records)

    @overload
    def __getitem__(self, index: int) -> Record: ...
    @overload
    def __getitem__(self, index: slice) -> Lazy[Record]: ...
    def __getitem__(self, index: int | slice) -> Record | Lazy[Record]:
        if isinstance(index, slice):
            return Lazy(self._kind, self._records[index], self._benchmark)
        return self._kind(self._records[index], self._benchmark)

    def __iter__(self) -> Iterator[Record]:
        return (self._kind(record, self._benchmark) for record in self._records)

    def __repr__(self) -> str:
        return f"<{len(self):,} records>"


@dataclass(frozen=True, repr=False)
class PrefixQuestion:
    """A prefix with a question: the base class of `Item` and `Query`.

    Attributes:
        record: The row of the benchmark's table.
    """

    record: SelectionItem | RetrievalQuery
    _benchmark: Benchmark = field(compare=False)

    @property
    def question(self) -> str:
        return self.record.question

    @property
    def scene_id(self) -> str:
        return self.record.scene_id

    @cached_property
    def _prefix_frames(self) -> list[int]:
        start, stop = self.record.prefix_start, self.record.prefix_stop
        return sample_prefix_frames(start, stop, self._benchmark.frames)

    @property
    def prefix(self) -> np.ndarray:
        """The observed frames in the order of time: (T, H, W, 3) uint8."""
        return self._benchmark.reader.stack(self.scene_id, self._prefix_frames)

    @property
    def times(self) -> np.ndarray:
        """The time of each frame of `prefix` in seconds from the start of the scene: (T,)."""
        scene = self._benchmark.store.scene(self.scene_id)
        return np.array(self._prefix_frames) / scene.fps

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.record.name}: {self.question}>"


class Item(PrefixQuestion):
    """A selection item: an observed clip, a question and four candidate frames, one of which is
    right."""

    record: SelectionItem

    @property
    def item_id(self) -> str:
        return self.record.item_id

    @property
    def candidates(self) -> list[np.ndarray]:
        """The four candidates in the order of the letters A to D, each (H, W, 3) uint8."""
        reader = self._benchmark.reader
        return [reader.array(c.scene_id, c.frame) for c in self.record.candidates]

    def messages(self, mode: str = "reasoning") -> list[dict[str, Any]]:
        """Return the prompt as a chat request in the format of OpenAI's API, with frames as PNGs.

        The prefix is a sequence of images, each after its time, instead of a video. The prompt is
        that of the commands for a model that is not told the times of a video.

        Args:
            mode: `reasoning` asks for a rationale and the letter, `answer` for the letter alone.
        """
        if mode not in MODES:
            raise UserError(f"mode={mode!r}: choose {' or '.join(MODES)}", code="unknown-option")
        bench = self._benchmark
        sample = selection_sample(self.record, mode, "cot", bench.reader, bench.frames)
        return build_messages(show_frames_as_images(sample))

    @property
    def answer(self) -> str:
        """The letter of the right candidate, A to D."""
        return self.record.letter

    @property
    def index(self) -> int:
        """The index of the right candidate in `candidates`, 0 to 3."""
        return self.record.answer

    @property
    def family(self) -> str:
        """event, time or window."""
        return self.record.family

    @property
    def subtype(self) -> str:
        """The kind of item within its family."""
        return self.record.subtype


class Query(PrefixQuestion):
    """A retrieval query: an observed clip and a question that a frame of the database answers."""

    record: RetrievalQuery

    @property
    def query_id(self) -> str:
        return self.record.query_id

    @property
    def target(self) -> Frame:
        """The frame that answers the query."""
        return Frame(self.record.target, self._benchmark)

    @property
    def hard_negatives(self) -> list[Frame]:
        """Similar frames that do not answer the query."""
        return [Frame(ref, self._benchmark) for ref in self.record.hard_negatives]


@dataclass(frozen=True, repr=False)
class Frame:
    """A frame of a database."""

    ref: FrameRef
    _benchmark: Benchmark = field(compare=False)

    @property
    def name(self) -> str:
        """SCENE_ID/FRAME_INDEX."""
        return self.ref.name

    @property
    def image(self) -> np.ndarray:
        """(H, W, 3) uint8."""
        return self._benchmark.reader.array(self.ref.scene_id, self.ref.frame)

    def __repr__(self) -> str:
        return f"<Frame {self.name}>"


@dataclass(frozen=True, eq=False, repr=False)
class Benchmark:
    """One split of a built benchmark. `load` returns it.

    Attributes:
        store: The benchmark on the disk.
        split: train or test.
        frames: As in `load`.
        image_size: As in `load`.
        pool: As in `load`.
    """

    store: Store
    split: str
    frames: int
    image_size: int | None
    pool: str = "future"

    @property
    def name(self) -> str:
        return self.store.name

    @cached_property
    def reader(self) -> FrameReader:
        """Reads pixels, and keeps the most recently used frames in memory."""
        return FrameReader(self.store, self.image_size)

    @cached_property
    def selection(self) -> Lazy[Item]:
        """The selection items of the split."""
        return Lazy(Item, self.store.selection(self.split), self)

    @cached_property
    def interventions(self) -> Lazy[Item]:
        """The items of the split in pairs about what comes and what would have come."""
        return Lazy(Item, self.store.selection(self.split, INTERVENTIONS), self)

    @cached_property
    def retrieval(self) -> Lazy[Query]:
        """The retrieval queries of the split and the pool, whose targets are in `database`. Those
        of the split `test` and the pool `future` are the standard test."""
        return Lazy(Query, self.store.retrieval(self.split, self.pool), self)

    @cached_property
    def database(self) -> Lazy[Frame]:
        """The frames to rank for `retrieval`: the standard test's database, or, of the train split,
        the database of all future-state queries; in the counterfactual pool, frames of the split's
        scenes and of their counterfactuals."""
        return Lazy(Frame, self.store.ranked_frames(self.split, self.pool), self)

    @cached_property
    def rationales(self) -> dict[str, str]:
        """The texts that the last `python -m teacher.narrate` accepted, by the id of the item or
        query, for both splits.

        Raises:
            UserError: There has been no narration of this benchmark.
        """
        path = self.store.folder / RATIONALES
        if not path.exists():
            raise UserError(
                f"{self.store.folder} has no {RATIONALES}: write rationales with "
                "python -m teacher.narrate",
                code="no-rationales",
            )
        return {row["item_id"]: row["text"] for row in load_rows(path)}

    def __reduce__(self) -> tuple[Any, ...]:
        # A worker process opens the benchmark once, instead of receiving it with each item.
        folder = self.store.folder.absolute()
        settings = (self.split, self.frames, self.image_size, self.pool)
        return _reopen, (folder, self.store.identity, *settings)

    def __repr__(self) -> str:
        counts = ", ".join(f"{self._count(family)} {family}" for family in FAMILIES)
        return (
            f"<Benchmark {self.name}, {self.split}: {len(self.selection):,} selection items "
            f"({counts}), {len(self.retrieval):,} queries over {len(self.database):,} frames>"
        )

    def _count(self, family: str) -> int:
        return sum(item.family == family for item in self.selection)


@lru_cache(maxsize=8)
def _reopen(
    folder: Path, identity: str, split: str, frames: int, image_size: int | None, pool: str
) -> Benchmark:
    """Return the benchmark of a pickled item. Raises UserError if it is another one now."""
    store = open_store(folder)
    if store.identity != identity:
        raise UserError(
            f"{folder} was built again since its items were pickled: load them again",
            code="different-builds",
        )
    return Benchmark(store, split, frames, image_size, pool)


def refuse_repeated(names: Sequence[str], kind: str) -> None:
    """Raises UserError if an item or a query is given twice: it would count twice."""
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        more = f" ({len(repeated) - 1} more are repeated)" if len(repeated) > 1 else ""
        raise UserError(
            f"{kind} {repeated[0]} is given more than once{more}: give each {kind} once",
            code="repeated-items",
        )
