"""What each command takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date

from omegaconf import MISSING

from conf.runs import TRAINER_FOLDERS, is_inside, is_run_name, resolve_run_name, runs_folder
from conf.schema.benchmark import BenchmarkConfig
from conf.schema.checks import is_url, too_small
from conf.schema.models import RetrieverConfig, StudentConfig
from conf.schema.servers import ServerConfig
from conf.schema.teacher import TeacherConfig
from conf.schema.training import ContrastiveTrainConfig, SftTrainConfig

EXPORT_FORMATS = ("bf16", "fp32", "adapter")
RESPONSE_MODES = ("reasoning", "answer", "record", "constrained")
PRERENDER_OPTIONS = ("named", "all", "none")
PARALLEL_BACKENDS = ("loky", "ray")
INDEXES = ("exact", "faiss")
SUITES = (None, "matched_anchor")
CONTROLS = ("candidate_only", "shuffled_prefix")
DTYPES = ("auto", "bfloat16", "float16", "float32")


@dataclass
class CommandConfig:
    """What every command takes."""

    run: str | None = None
    """Folder of the run below checkpoints/<command>/; made from the overrides when null."""
    store: str = "store"
    """Folder of the built benchmarks."""
    checkpoints: str = "checkpoints"
    """Folder of the runs."""
    workers: int = 2
    """Processes that simulate, render and narrate."""

    def check(self) -> list[str]:
        return too_small(self, "", {"workers": 1, **({"seed": 0} if hasattr(self, "seed") else {})})


@dataclass
class BuildCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    frames: str = "named"
    """Frames that are rendered ahead: named (by items, queries and databases), all or none. The
    others are drawn when they are asked for."""
    frames_gb: float | None = None
    """Disk space that rendered frames may take; null sets no bound."""
    strict: bool = False
    """Whether a bad record of a release stops the build; otherwise it is told and left out."""
    parallel: str = "loky"
    """loky spreads the work over this machine's processes, ray over a Ray cluster."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "", {"frames_gb": 0})
        for key, options in (("frames", PRERENDER_OPTIONS), ("parallel", PARALLEL_BACKENDS)):
            if getattr(self, key) not in options:
                listed = f"{', '.join(options[:-1])} and {options[-1]}"
                problems.append(f"{key}={getattr(self, key)}: the options are {listed}")
        return problems


@dataclass
class StatisticsCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING


@dataclass
class ExportCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    format: str = "huggingface"
    """huggingface writes items, queries and databases as a dataset; clevrer writes scenes as videos
    with annotations, as CLEVRER's release has them."""
    folder: str = MISSING
    """Folder of the export; must not hold another one."""
    images: bool = True
    """Whether frames are written too; without them a row names scenes and frames of the store."""
    url: str | None = None
    """Where the dataset will be published, such as https://huggingface.co/datasets/NAME/DATASET."""
    published: str | None = None
    """When, as YYYY-MM-DD."""

    def check(self) -> list[str]:
        problems = super().check()
        if self.format not in ("huggingface", "clevrer"):
            problems.append(f"format={self.format}: the options are huggingface and clevrer")
        if not self.folder:
            problems.append("folder= is empty: name a folder, such as folder=exports/tiny")
        if self.url is not None and not is_url(self.url):
            problems.append(
                f"url={self.url} is no address, such as https://huggingface.co/datasets/NAME/DATASET"
            )
        try:
            date.fromisoformat(self.published or "2026-01-31")
        except ValueError:
            problems.append(f"published={self.published} is no date, such as 2026-01-31")
        return problems


@dataclass
class GalleryCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    examples: int = 3
    """Items of a subtype and queries of a builder that are shown; counterfactual pairs and paths
    are twice as many."""
    seed: int = 0
    """Of the choice of examples."""

    def check(self) -> list[str]:
        return super().check() + too_small(self, "", {"examples": 1})


@dataclass
class NarrateCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    examples: int = 20
    """Rationales on the report's page, beside their frames; chosen by `teacher.seed`."""

    def check(self) -> list[str]:
        return super().check() + too_small(self, "", {"examples": 0})


@dataclass
class ServeCommand(CommandConfig):
    teacher: TeacherConfig = MISSING
    """Its url says where to listen, its model under which name."""
    model: str | None = None
    """Folder of the model, or its name at the hub; null takes teacher.model."""
    environment: str = ".venv-vllm"
    """Folder of the Python environment that has vLLM; `make vllm-env` makes it."""
    prompt_tokens: int = 3072
    """Tokens that a prompt may have; with teacher.max_tokens it makes the model's context."""
    dtype: str = "auto"
    """Of weights and activations: auto, bfloat16, float16 or float32."""
    gpus: int | None = None
    """GPUs that share the model; null takes the largest power of two that the machine has."""
    memory: float = 0.9
    """Share of each GPU's memory."""
    cache_gb: float = 4.0
    """GiB of the key-value cache of a server without a GPU."""
    frames: bool = False
    """Whether it is asked with frames, as evaluation.select asks, which says with each request how
    they are to be read: serve only clients that you trust."""
    adapter: str | None = None
    """Folder of a student's adapters over the model; they are asked by the name `adapter`."""

    def check(self) -> list[str]:
        least = {"prompt_tokens": 1, "gpus": 1}
        problems = super().check() + too_small(self, "", least)
        if len(self.teacher.urls) != 1:
            problems.append(
                f"teacher.url={self.teacher.url}: a server needs one address, such as "
                "teacher.url=http://127.0.0.1:8000/v1"
            )
        if self.dtype not in DTYPES:
            problems.append(f"dtype={self.dtype}: the options are {', '.join(DTYPES)}")
        if not 0 < self.memory <= 1:
            problems.append(f"memory={self.memory} must be above 0 and at most 1")
        if not self.cache_gb > 0:
            problems.append(f"cache_gb={self.cache_gb} must be above 0")
        return problems


@dataclass
class SftCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    student: StudentConfig = MISSING
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    seed: int = 0
    """Of the order of samples and of new adapters."""


@dataclass
class ExportModelCommand(CommandConfig):
    product: str = "student"
    """What is exported: a student of train.sft or a retriever of train.contrastive."""
    run: str = "default"
    """The run that trained it: its name or its folder."""
    format: str = "bf16"
    """bf16 or fp32 merges the adapters into the dequantised base, whose weights are then written in
    that precision; adapter writes the adapters alone."""

    def check(self) -> list[str]:
        problems = super().check()
        if self.product not in TRAINER_FOLDERS:
            problems.append(f"product={self.product}: the options are student and retriever")
        if self.format not in EXPORT_FORMATS:
            problems.append(f"format={self.format}: the options are bf16, fp32 and adapter")
        for other in TRAINER_FOLDERS:
            if other != self.product and is_inside(self.run, runs_folder(self.checkpoints, other)):
                problems.append(f"run={self.run} trained a {other}: give product={other}")
                return problems
        runs = runs_folder(self.checkpoints, self.product)
        if not is_run_name(resolve_run_name(self.run, runs)):
            problems.append(
                f"run={self.run} is no run below {runs}: name one that is there, and give "
                "checkpoints=FOLDER where the runs are elsewhere"
            )
        return problems


@dataclass
class ContrastiveCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    seed: int = 0
    """Of the order of queries and of new adapters."""

    def check(self) -> list[str]:
        problems = super().check()
        if self.train.hard_negatives > self.benchmark.retrieval.hard_negatives:
            problems.append(
                f"train.hard_negatives={self.train.hard_negatives} is more than "
                f"benchmark.retrieval.hard_negatives={self.benchmark.retrieval.hard_negatives}"
            )
        if self.retriever.encoder != "qwen3_vl":
            problems.append(
                f"retriever.encoder={self.retriever.encoder} is measured, not trained: choose "
                "retriever=qwen3_vl_emb_8b or another one of Qwen3-VL's kind"
            )
        weights, widths = self.train.width_weights, self.retriever.widths
        if weights is not None and (
            len(weights) != len(widths) or min(weights) < 0 or max(weights) == 0
        ):
            problems.append(
                f"train.width_weights={weights} must give each of the {len(widths)} "
                f"retriever.widths={list(widths)} a weight of 0 or more, one of them above 0"
            )
        if weights is not None and self.retriever.late is not None:
            problems.append(
                "train.width_weights with retriever.late: its vectors have one width, leave the "
                "weights null"
            )
        if self.train.reuse_features and not self.retriever.lora.rank:
            problems.append(
                "train.reuse_features=true: without adapters the vision tower is trained, and what "
                "it makes of a frame changes; give retriever.lora.rank above 0, or leave it false"
            )
        return problems


@dataclass
class SelectCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    server: ServerConfig = field(default_factory=ServerConfig)
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """The preset's recipe; a measurement of a base takes its precision and its regime's prompt."""
    model: str | None = None
    """A run folder of train.sft or what train.export wrote, with its own student and recipe; null
    takes the student's base."""
    modes: list[str] | None = None
    """reasoning (rationale, then answer), answer (at once), record (the structured record) and
    constrained (the record, held to its JSON schema), each measured by itself; null takes those
    that the student was trained in, and both kinds of record of a base."""
    batch: int = 16
    """Items that pass the model at once."""
    limit: int | None = None
    """Test items at most, spread over the families; null takes all."""
    seed: int = 0
    """Of the items that `limit` leaves, of answers that are drawn, and of the scenes that are drawn
    for intervals."""
    suite: str | None = None
    """matched_anchor for the pairs that differ in their anchor alone; null takes the benchmark's
    own items."""
    control: str | None = None
    """candidate_only hides the prefix, shuffled_prefix shows its frames out of order, both beside
    the same items as they are; null shows them so alone."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "", {"batch": 1, "limit": 1})
        problems += suite_problems(self)
        if self.control not in (None, *CONTROLS):
            problems.append(
                f"control={self.control}: the options are {', '.join(CONTROLS)} and null"
            )
        given = ["record"] if self.modes is None else self.modes
        if not given or len(set(given)) < len(given) or set(given) - set(RESPONSE_MODES):
            problems.append(
                f"modes={self.modes}: give one or more of {', '.join(RESPONSE_MODES)}, each once"
            )
        return problems


@dataclass
class RetrieveCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """The preset's recipe; a measurement takes its precision alone."""
    model: str | None = None
    """A run folder of train.contrastive or what train.export wrote, with its own retriever and
    recipe; null takes the retriever's base."""
    batch: int = 64
    """Queries or frames that pass the model at once."""
    index: str = "exact"
    """exact holds every frame of the database against every query; faiss asks an approximate index
    (extra `index`), for databases of millions, and says what that loses."""
    probes: int = 16
    """Lists that a query looks through in an approximate index, which has about as many as the
    square root of the frames."""
    seed: int = 0
    """Of the scenes that are drawn for the intervals, and of the queries by which an approximate
    index is held against exact ranks."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "", {"batch": 1, "probes": 1})
        if self.index not in INDEXES:
            problems.append(f"index={self.index}: the options are exact and faiss")
        return problems


@dataclass
class SimilarityCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """The preset's recipe; a measurement takes its precision alone."""
    model: str | None = None
    """A run folder of train.contrastive or what train.export wrote, with its own retriever and
    recipe; null takes the preset's model as it was released."""
    batch: int = 64
    """Prefixes or frames that pass the model at once."""
    limit: int | None = None
    """Test items at most, spread over the families; null takes all."""
    seed: int = 0
    """Of the items that `limit` leaves, and of the scenes that are drawn for intervals."""
    suite: str | None = None
    """matched_anchor for the pairs that differ in their anchor alone; null takes the benchmark's
    own items."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "", {"batch": 1, "limit": 1})
        problems += suite_problems(self)
        return problems


@dataclass
class ReportCommand(CommandConfig):
    runs: list[str] | None = None
    """Run folders below `checkpoints`, or patterns of them, such as [select/cot,retrieve/*]; null
    takes every finished one."""
    items: int = 120
    """Items of a benchmark that the page shows at most: as many subtypes as there is room for, with
    right and wrong answers of each."""
    seed: int = 0
    """Of the choice of these items."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "", {"items": 0})
        if self.runs is not None and (not self.runs or not all(r.strip("/. ") for r in self.runs)):
            problems.append(
                f"runs={self.runs}: name folders below {self.checkpoints}, such as "
                "runs=[select/cot,retrieve/*], or leave it null for every finished run"
            )
        return problems


def suite_problems(cfg: SelectCommand | SimilarityCommand) -> list[str]:
    if cfg.suite not in SUITES:
        return [f"suite={cfg.suite}: the options are matched_anchor and null"]
    if cfg.suite is not None and cfg.limit == 1:
        return [f"limit=1: suite={cfg.suite} asks pairs of items, give 2 or more"]
    return []
