"""Settings of the commands that build and export benchmarks, write rationales, and train."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dynapix.conf.runs import TRAINER_FOLDERS, is_inside, runs_folder
from dynapix.conf.schema.benchmark import BenchmarkConfig
from dynapix.conf.schema.models import RetrieverConfig, StudentConfig
from dynapix.conf.schema.servers import SamplingServerConfig, TeacherConfig, TeacherServerConfig
from dynapix.conf.schema.settings import MISSING, Settings, check_run, path, setting
from dynapix.conf.schema.training import (
    ContrastiveTrainConfig,
    DistillTrainConfig,
    ReinforceTrainConfig,
    SftTrainConfig,
)


@dataclass
class CommandConfig(Settings):
    """Settings that every command has."""

    run: str | None = None
    """Name of the run's folder below checkpoints/<command>/; null derives it from the overrides."""
    store: str = path("store")
    """Folder of the built benchmarks."""
    checkpoints: str = path("checkpoints")
    """Folder of the runs."""
    workers: int = setting(2, least=1)
    """Worker processes for simulation and rendering."""

    def check(self, group: str = "") -> list[str]:
        folders = {"store": self.store, "checkpoints": self.checkpoints}
        empty = [f"{key}= is empty: name a folder" for key, folder in folders.items() if not folder]
        return [*empty, *self.find_run_problems(), *super().check(group)]

    def find_run_problems(self) -> list[str]:
        """Return a message if `run` does not name a folder below that of the command's runs."""
        if self.run is None:
            return []
        if self.run.startswith(f"{self.checkpoints.rstrip('/')}/"):
            return [f"run={self.run} is a path: give the name only, run={Path(self.run).name}"]
        if {"", ".", ".."} & {*self.run.split("/")} or self.run.startswith("~"):
            return [f"run={self.run}: give a name, such as run=first"]
        return []


@dataclass
class BuildCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    frames: str = setting("named", ("named", "all", "none"))
    """Frames to render during the build: named (frames that an item, query or database uses), all
    or none. Missing frames are rendered on demand."""
    strict: bool = False
    """Stop the build at an invalid record of a release instead of logging and skipping it."""
    verify: bool = False
    """Hash every file of a built benchmark. Otherwise, only files whose size or modification time
    differs from the last check are hashed."""
    parallel: str = setting("loky", ("loky", "ray"))
    """loky runs the work in processes of this machine, ray on a Ray cluster."""


@dataclass
class StatisticsCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    blind: bool = False
    """Also train two small models that do not see the prefix, and report their accuracy. This takes
    minutes and needs the extra `train`."""
    observer: bool = False
    """Also simulate observers who see the objects with errors of 0.25 to 32 px, and report their
    accuracy. This takes minutes, once per benchmark, which must be simulated."""


@dataclass
class ExportCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    also: list[str] = field(default_factory=list)
    """Further benchmarks in the same dataset, by the names of their presets, each in the world of
    its preset. The name of a table then begins with that of its benchmark, such as
    tiny-selection."""
    folder: str = path(MISSING)
    """Folder to write to; it must not contain another export."""
    images: bool = True
    """Include the images of the frames; otherwise a row only names its scenes and frames."""
    format: str = setting("dataset", ("dataset", "trl", "sharegpt", "swift", "embedding"))
    """dataset (all tables as parquet files), or training samples as rows for other trainers: trl,
    sharegpt (LLaMA-Factory), swift (ms-swift) or embedding (sentence-transformers)."""
    archive: str | None = path(None)
    """Zip file to write the built benchmark to, which `dynapix.load(FILE)` opens, instead of an
    export."""
    push: str | None = None
    """Dataset repository on the Hugging Face hub, ORGANISATION/NAME, to which the export is
    uploaded; null does not upload it."""
    student: StudentConfig = MISSING
    """Model to train on the rows, of which student.frames and student.image_size are used."""
    teacher: TeacherConfig = MISSING
    """Settings of the rationales in the rows."""
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """Training settings of the preset, of which only train.regime is used."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.format != "dataset" and (self.also or not self.images):
            yield (
                f"{group}format={self.format}: rows are of one benchmark and have images; leave "
                f"{group}also and {group}images out"
            )
        changed = self.also or self.push or self.format != "dataset" or not self.images
        if self.archive is not None and changed:
            yield (
                f"{group}archive={self.archive}: an archive is a whole benchmark; leave "
                f"{group}also, {group}push, {group}format and {group}images out"
            )
        if not self.folder:
            yield f"{group}folder= is empty: name a folder, such as folder=exports/tiny"
        names = [self.benchmark.name, *self.also]
        for name in sorted({name for name in names if names.count(name) > 1}):
            yield f"{group}also: {name} is named twice; leave it out"


@dataclass
class GalleryCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    examples: int = setting(3, least=1)
    """Number of examples of each kind: items of each subtype, queries of each builder,
    counterfactual queries, and pairs of matched-anchor items."""
    seed: int = setting(0, least=0)
    """Seed of the sample of examples."""


@dataclass
class NarrateCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    examples: int = setting(20, least=0)
    """Items shown with their frames and texts on the report's page; sampled with `teacher.seed`."""
    limit: int | None = setting(None, least=1)
    """Number of items to narrate, sampled with `teacher.seed` evenly over the families; null
    narrates all. A later narration of more items goes on from this one."""


@dataclass
class ClaimsCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    runs: list[str] = field(default_factory=list)
    """Names of evaluations of students below checkpoints/select/, whose responses in reasoning mode
    are judged; `*` stands for any text."""
    claims: int = setting(50_000, least=1)
    """Minimum number of claims. Rationales of the built-in narrator, with and without a false word,
    are added until it is reached."""
    seed: int = setting(0, least=0)
    """Seed of the rationales and of the false words."""


@dataclass
class ServeCommand(CommandConfig):
    teacher: TeacherConfig = MISSING
    """The server listens at `teacher.url` and serves the model under the name `teacher.model`."""
    model: str | None = path(None)
    """Folder of the model, or its name on the Hugging Face hub; null uses `teacher.model`."""
    environment: str = path(".venv-vllm")
    """Folder of the Python environment with vLLM, which `make vllm-env` creates."""
    prompt_tokens: int = setting(3072, least=1)
    """Maximum length of a prompt (tokens). The context length is this value plus
    `teacher.max_tokens`."""
    dtype: str = setting("auto", ("auto", "bfloat16", "float16", "float32"))
    """Data type of weights and activations: auto, bfloat16, float16 or float32."""
    gpus: int | None = setting(None, least=1)
    """Number of GPUs to split the model over; null uses the largest possible power of two."""
    memory: float = setting(0.9, above=0, most=1)
    """Share of each GPU's memory that the server may use."""
    cache_gb: float = setting(4.0, above=0)
    """Size (GiB) of the key-value cache if the server has no GPU."""
    frames: bool = False
    """Accept requests with frames, such as those of evaluation.select. A request chooses how its
    frames are preprocessed, so give access only to clients that you trust."""
    adapter: str | None = path(None)
    """Folder of a student's adapters to serve under the model name `adapter`."""
    adapter_rank: int | None = setting(None, least=1)
    """Maximum LoRA rank of the adapters that clients load while the server runs, such as
    train.distill with sampling_server.url; null allows none. Such clients name folders of this
    machine, so give access only to clients that you trust."""

    def find_problems(self, group: str) -> Iterator[str]:
        if len(self.teacher.urls) != 1:
            yield (
                f"teacher.url={self.teacher.url}: a server needs one address, such as "
                "teacher.url=http://127.0.0.1:8000/v1"
            )


@dataclass
class SftCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    student: StudentConfig = MISSING
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    seed: int = setting(0, least=0)
    """Seed of the order of the samples and of the initial adapter weights."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.student.thinking:
            yield (
                "student.thinking=true: students are trained to respond without thinking; set "
                "student.thinking=false, so that the prompts of a thinking model end with an empty "
                "thought"
            )


@dataclass
class ContinuationCommand(CommandConfig):
    """Settings of the commands that train the student of another run further."""

    model: str | None = path(None)
    """Folder of the run of train.sft whose student is trained further. It determines the benchmark,
    the narrator's settings and the student."""
    sampling_server: SamplingServerConfig = field(default_factory=SamplingServerConfig)
    seed: int = setting(0, least=0)
    """Seed of the order of the items and of the sampled responses."""


@dataclass
class DistillCommand(ContinuationCommand):
    teacher_model: str | None = path(None)
    """Folder of the run that trained the teacher, for example with train.sft train.facts=true; null
    uses the student itself, as it is at the start. The teacher reads the facts of an item as text
    instead of its frames, and needs the student's tokenizer."""
    teacher_server: TeacherServerConfig = field(default_factory=TeacherServerConfig)
    train: DistillTrainConfig = field(default_factory=DistillTrainConfig)

    def find_problems(self, group: str) -> Iterator[str]:
        if self.teacher_server.url is None:
            return
        if self.teacher_model is not None:
            yield (
                f"teacher_model={self.teacher_model} and teacher_server.url="
                f"{self.teacher_server.url} are two teachers: give one of them"
            )
        if self.train.temperature != 1:
            yield (
                f"train.temperature={self.train.temperature:g} with teacher_server.url: the "
                "estimate of the divergence is right for tokens that are sampled at "
                "train.temperature=1 only"
            )


@dataclass
class ReinforceCommand(ContinuationCommand):
    train: ReinforceTrainConfig = field(default_factory=ReinforceTrainConfig)


@dataclass
class ContrastiveCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    seed: int = setting(0, least=0)
    """Seed of the order of the queries and of the initial adapter weights."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.train.hard_negatives > self.benchmark.retrieval.hard_negatives:
            yield (
                f"train.hard_negatives={self.train.hard_negatives} is more than "
                f"benchmark.retrieval.hard_negatives={self.benchmark.retrieval.hard_negatives}"
            )
        if self.retriever.encoder != "sentence_transformers":
            yield (
                f"retriever.encoder={self.retriever.encoder} can be evaluated but not trained: set "
                "retriever.encoder=sentence_transformers, or choose another retriever, such as "
                "retriever=qwen3_vl_emb_8b"
            )
        if self.train.reuse_features and not self.retriever.lora.rank:
            yield (
                "train.reuse_features=true with retriever.lora.rank=0: without adapters, training "
                "changes the vision tower and thus its features; set train.reuse_features=false or "
                "retriever.lora.rank above 0"
            )


@dataclass
class ExportModelCommand(CommandConfig):
    product: str = setting("student", tuple(TRAINER_FOLDERS))
    """Model to export: student (of train.sft, train.distill or train.reinforce) or retriever (of
    train.contrastive)."""
    run: str = path("default")
    """Training run to export: its name or its folder. Runs of train.distill and
    train.reinforce need their folder."""
    format: str = setting("bf16", ("bf16", "fp32", "adapter"))
    """bf16 and fp32 merge the adapters into the dequantised base and write the weights in that
    precision; adapter writes only the adapters."""

    def find_run_problems(self) -> list[str]:
        for other in TRAINER_FOLDERS:
            if other != self.product and is_inside(self.run, runs_folder(self.checkpoints, other)):
                return [f"run={self.run} trained a {other}: give product={other}"]
        return check_run(self.run, runs_folder(self.checkpoints, self.product, self.run))
