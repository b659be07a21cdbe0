"""Settings of each command."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING

from conf.runs import TRAINER_FOLDERS, is_inside, runs_folder
from conf.schema.benchmark import BenchmarkConfig
from conf.schema.checks import (
    check_choices,
    check_minimum,
    check_options,
    check_positive,
    check_run,
    check_share,
)
from conf.schema.models import RetrieverConfig, StudentConfig
from conf.schema.servers import ServerConfig
from conf.schema.teacher import TeacherConfig
from conf.schema.training import ContrastiveTrainConfig, SftTrainConfig

EXPORT_FORMATS = ("bf16", "fp32", "adapter")
RESPONSE_MODES = ("reasoning", "answer", "record", "constrained")
PRERENDER_OPTIONS = ("named", "all", "none")
PARALLEL_BACKENDS = ("loky", "ray")
INDEXES = ("exact", "faiss")
SUITES = ("matched_anchor", None)
CONTROLS = ("candidate_only", "shuffled_prefix", None)
DTYPES = ("auto", "bfloat16", "float16", "float32")


@dataclass
class CommandConfig:
    """Settings that every command has."""

    run: str | None = None
    """Name of the run's folder below checkpoints/<command>/; null derives it from the overrides."""
    store: str = "store"
    """Folder of the built benchmarks."""
    checkpoints: str = "checkpoints"
    """Folder of the runs."""
    workers: int = 2
    """Worker processes for simulation, rendering and narration."""

    def check(self) -> list[str]:
        seed = {"seed": 0} if hasattr(self, "seed") else {}
        return check_minimum(self, "", {"workers": 1, **seed})


@dataclass
class BuildCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    frames: str = "named"
    """Frames to render during the build: named (those that items, queries and databases use), all
    or none. Other frames are rendered on demand."""
    frames_gb: float | None = None
    """Maximum disk space (GB) of rendered frames; null sets no limit."""
    strict: bool = False
    """Stop the build at a bad record of a release instead of logging and skipping it."""
    parallel: str = "loky"
    """loky runs the work in processes of this machine, ray on a Ray cluster."""

    def check(self) -> list[str]:
        options = {"frames": PRERENDER_OPTIONS, "parallel": PARALLEL_BACKENDS}
        problems = super().check() + check_minimum(self, "", {"frames_gb": 0})
        return problems + check_options(self, "", options)


@dataclass
class StatisticsCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING


@dataclass
class ExportCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    format: str = "huggingface"
    """huggingface writes items, queries and databases as a dataset; clevrer writes scenes as videos
    and annotations in the layout of CLEVRER's release."""
    folder: str = MISSING
    """Folder to write; it must not contain an earlier export."""
    images: bool = True
    """Include the frames; without them, a row only names its scenes and frames."""

    def check(self) -> list[str]:
        problems = super().check()
        problems += check_options(self, "", {"format": ("huggingface", "clevrer")})
        if not self.folder:
            problems.append("folder= is empty: name a folder, such as folder=exports/tiny")
        return problems


@dataclass
class GalleryCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    examples: int = 3
    """Items per subtype and queries per builder; twice as many counterfactual pairs and object
    paths."""
    seed: int = 0
    """Seed of the sample of examples."""

    def check(self) -> list[str]:
        return super().check() + check_minimum(self, "", {"examples": 1})


@dataclass
class NarrateCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    examples: int = 20
    """Rationales on the report's page, with their frames; sampled with `teacher.seed`."""

    def check(self) -> list[str]:
        return super().check() + check_minimum(self, "", {"examples": 0})


@dataclass
class ServeCommand(CommandConfig):
    teacher: TeacherConfig = MISSING
    """The server listens at teacher.url and serves the model under the name teacher.model."""
    model: str | None = None
    """Folder of the model, or its name on the Hugging Face hub; null uses teacher.model."""
    environment: str = ".venv-vllm"
    """Folder of the Python environment with vLLM, which `make vllm-env` creates."""
    prompt_tokens: int = 3072
    """Maximum length of a prompt (tokens); the context is this plus teacher.max_tokens."""
    dtype: str = "auto"
    """Data type of weights and activations: auto, bfloat16, float16 or float32."""
    gpus: int | None = None
    """GPUs to split the model over; null uses the largest power of two that the machine has."""
    memory: float = 0.9
    """Share of each GPU's memory that the server may use."""
    cache_gb: float = 4.0
    """Size (GiB) of the key-value cache of a server without a GPU."""
    frames: bool = False
    """Accept requests with frames, which evaluation.select sends. Each request sets how its frames
    are preprocessed, so serve only clients that you trust."""
    adapter: str | None = None
    """Folder of a student's adapters to serve under the model name `adapter`."""

    def check(self) -> list[str]:
        problems = super().check() + check_minimum(self, "", {"prompt_tokens": 1, "gpus": 1})
        if len(self.teacher.urls) != 1:
            problems.append(
                f"teacher.url={self.teacher.url}: a server needs one address, such as "
                "teacher.url=http://127.0.0.1:8000/v1"
            )
        problems += check_options(self, "", {"dtype": DTYPES})
        problems += check_share(self, "", ["memory"])
        return problems + check_positive(self, "", ["cache_gb"])


@dataclass
class SftCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    student: StudentConfig = MISSING
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    seed: int = 0
    """Seed of the order of the samples and of the initial adapter weights."""


@dataclass
class ContrastiveCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    seed: int = 0
    """Seed of the order of the queries and of the initial adapter weights."""

    def check(self) -> list[str]:
        problems = super().check()
        if self.train.hard_negatives > self.benchmark.retrieval.hard_negatives:
            problems.append(
                f"train.hard_negatives={self.train.hard_negatives} is more than "
                f"benchmark.retrieval.hard_negatives={self.benchmark.retrieval.hard_negatives}"
            )
        if self.retriever.encoder != "qwen3_vl":
            problems.append(
                f"retriever.encoder={self.retriever.encoder} can be measured but not trained: "
                "choose a Qwen3-VL retriever, such as retriever=qwen3_vl_emb_8b"
            )
        weights, widths = self.train.width_weights, self.retriever.widths
        if weights is not None and (
            len(weights) != len(widths) or min(weights) < 0 or max(weights) == 0
        ):
            problems.append(
                f"train.width_weights={weights}: give each of the {len(widths)} widths in "
                f"retriever.widths={list(widths)} a weight of 0 or more, at least one above 0"
            )
        if weights is not None and self.retriever.late is not None:
            problems.append(
                "train.width_weights with retriever.late: a late-interaction retriever has one "
                "width; leave train.width_weights=null"
            )
        if self.train.reuse_features and not self.retriever.lora.rank:
            problems.append(
                "train.reuse_features=true with retriever.lora.rank=0: training without adapters "
                "changes the vision tower and so its features; set train.reuse_features=false or "
                "retriever.lora.rank above 0"
            )
        return problems


@dataclass
class ExportModelCommand(CommandConfig):
    product: str = "student"
    """Model to export: a student (of train.sft) or a retriever (of train.contrastive)."""
    run: str = "default"
    """Training run to export: its name or its folder."""
    format: str = "bf16"
    """bf16 or fp32 merges the adapters into the dequantised base and writes the weights in that
    precision; adapter writes only the adapters."""
    verify: bool = True
    """Compare the merged model with the trained one on held-out items of the run's benchmark; false
    needs no benchmark."""

    def check(self) -> list[str]:
        options = {"product": tuple(TRAINER_FOLDERS), "format": EXPORT_FORMATS}
        problems = super().check() + check_options(self, "", options)
        for other in TRAINER_FOLDERS:
            if other != self.product and is_inside(self.run, runs_folder(self.checkpoints, other)):
                return [*problems, f"run={self.run} trained a {other}: give product={other}"]
        return problems + check_run(self.run, runs_folder(self.checkpoints, self.product))


@dataclass
class SelectCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    server: ServerConfig = field(default_factory=ServerConfig)
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """The preset's training recipe. A base uses only its precision and its regime's prompt."""
    model: str | None = None
    """Run folder of train.sft or folder that train.export wrote, with its own student and recipe;
    null measures the student's base."""
    modes: list[str] | None = None
    """Response modes to measure: reasoning (rationale, then answer), answer (only the answer),
    record (structured record) and constrained (record, with decoding constrained to its JSON
    schema). null uses the modes that the student was trained in; for a base, record and
    constrained."""
    batch: int = 16
    """Items per forward pass."""
    limit: int | None = None
    """Maximum number of test items, spread evenly over the families; null uses all."""
    seed: int = 0
    """Seed of the items that `limit` samples, of sampled responses and of the bootstrap."""
    suite: str | None = None
    """matched_anchor measures the pairs of items that differ only in the question's anchor (event
    or time); null measures the benchmark's standard items."""
    control: str | None = None
    """candidate_only leaves out the prefix, shuffled_prefix shuffles its frames; each control is
    measured beside the unchanged items. null measures only the unchanged items."""

    def check(self) -> list[str]:
        problems = super().check() + check_minimum(self, "", {"batch": 1, "limit": 1})
        problems += check_suite(self) + check_options(self, "", {"control": CONTROLS})
        return problems + check_choices("modes", self.modes, RESPONSE_MODES)


@dataclass
class EmbeddingCommand(CommandConfig):
    """Settings of the commands that measure a retriever."""

    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """The preset's training recipe, of which only the precision is used."""
    model: str | None = None
    """Run folder of train.contrastive or folder that train.export wrote, with its own retriever and
    recipe; null measures the preset's released model."""
    batch: int = 64
    """Queries, prefixes or frames per forward pass."""
    seed: int = 0
    """Seed of every sample, including the bootstrap's."""

    def check(self) -> list[str]:
        return super().check() + check_minimum(self, "", {"batch": 1})


@dataclass
class RetrieveCommand(EmbeddingCommand):
    index: str = "exact"
    """exact compares each query with every frame; faiss uses an approximate index (extra `index`)
    for databases of millions of frames, and reports its recall against exact search."""
    probes: int = 16
    """Lists of the approximate index that a query searches, of about sqrt(number of frames)."""

    def check(self) -> list[str]:
        problems = super().check() + check_minimum(self, "", {"probes": 1})
        return problems + check_options(self, "", {"index": INDEXES})


@dataclass
class SimilarityCommand(EmbeddingCommand):
    limit: int | None = None
    """Maximum number of test items, spread evenly over the families; null uses all."""
    suite: str | None = None
    """matched_anchor measures the pairs of items that differ only in the question's anchor (event
    or time); null measures the benchmark's standard items."""

    def check(self) -> list[str]:
        return super().check() + check_minimum(self, "", {"limit": 1}) + check_suite(self)


@dataclass
class ReportCommand(CommandConfig):
    runs: list[str] | None = None
    """Run folders below `checkpoints`, or patterns of them, such as [select/cot,retrieve/*]; null
    reports every finished run."""
    items: int = 120
    """Maximum number of items of a benchmark on the page, spread over the subtypes and over right
    and wrong answers."""
    seed: int = 0
    """Seed of the sample of these items."""

    def check(self) -> list[str]:
        problems = super().check() + check_minimum(self, "", {"items": 0})
        if self.runs is not None and (not self.runs or not all(r.strip("/. ") for r in self.runs)):
            problems.append(
                f"runs={self.runs}: name folders below {self.checkpoints}, such as "
                "runs=[select/cot,retrieve/*], or leave runs=null for every finished run"
            )
        return problems


def check_suite(cfg: SelectCommand | SimilarityCommand) -> list[str]:
    """An unknown suite, or a limit that leaves no pair of a suite of pairs."""
    if cfg.suite == "matched_anchor" and cfg.limit == 1:
        return ["limit=1 with suite=matched_anchor: a pair has two items; give limit=2 or more"]
    return check_options(cfg, "", {"suite": SUITES})
