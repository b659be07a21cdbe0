"""Every setting of every command: one dataclass a command and a group, with its unit and default.

Defaults here are the paper's values; a preset (`conf/<group>/<name>.yaml`) states what differs.
`check()` returns one sentence for each combination of values that cannot work, naming the keys as
a user types them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date
from typing import Any
from urllib.parse import urlsplit

from omegaconf import MISSING


@dataclass
class Quota:
    """How many items or queries a cell gets in each split."""

    train: int = 0
    test: int = 0


RENDERERS = ("bullet", "egl", "blender")
SIMULATORS = ("bullet", "clevrer", "movi_a", "physion")
FRAMES_AHEAD = ("named", "all", "none")
ENGINES = ("loky", "ray")
LOOKS = 48
"""Objects that can be told apart by their names: 3 shapes, 8 colours, 2 materials."""


@dataclass
class SelectionConfig:
    """Cells of the selection track and their quotas. A cell's name is its item's `subtype`."""

    min_displacement: float = 12.0
    """Least displacement (px at 336 x 336) between any two candidates, in some object."""
    event: dict[str, Quota] = field(default_factory=dict)
    time: dict[str, Quota] = field(default_factory=dict)
    window: dict[str, Quota] = field(default_factory=dict)
    matched: Quota = field(default_factory=Quota)
    """Pairs of items that differ in their question's anchor alone, a suite of their own."""

    def check(self) -> list[str]:
        problems = _too_small(self, "benchmark.selection.", {"min_displacement": 0})
        for family in ("event", "time", "window"):
            problems += _quota_problems(f"benchmark.selection.{family}", getattr(self, family))
        return problems + _quota_problems("benchmark.selection", {"matched": self.matched})


@dataclass
class RetrievalTrackConfig:
    """Builders of the retrieval track (spec names 1 to 6) and the test database."""

    builders: dict[str, Quota] = field(default_factory=dict)
    counterfactual: Quota = field(default_factory=Quota)
    """Queries about scenes that are simulated again with an object absent."""
    hard_negatives: int = 3
    """Same-scene wrong-time frames a query."""
    standard: int = 2_002
    """Of the builders' test queries, those of the standard test; as many of each builder."""
    database: int = 10_000
    """Frames of the standard test's database; it holds every target of its queries."""
    source: int = 30_000
    """Frames that the builders' queries have for a source; it holds every target of theirs."""
    counterfactual_source: int = 26_995
    """Frames that the counterfactual queries have for a source."""

    def check(self) -> list[str]:
        sizes = ("standard", "database", "source", "counterfactual_source")
        return [
            *_too_small(self, "benchmark.retrieval.", {"hard_negatives": 1}),
            *_too_small(self, "benchmark.retrieval.", dict.fromkeys(sizes, 0)),
            *_quota_problems("benchmark.retrieval.builders", self.builders),
            *_quota_problems("benchmark.retrieval", {"counterfactual": self.counterfactual}),
        ]


@dataclass
class BenchmarkConfig:
    name: str = MISSING
    """Name of the folder below `store`."""
    simulator: str = "bullet"
    """bullet simulates scenes; clevrer, movi_a and physion read a release of that simulator."""
    folder: str | None = None
    """Folder of the release, where one is read."""
    fps: float = 30.0
    """Frames a second of Physion's trials, which do not record it."""
    seed: int = 0
    scenes: int = 10_000
    """Scenes, of a release at most."""
    test_share: float = 0.2
    min_objects: int = 4
    max_objects: int = 6
    max_collisions: int = 3
    renderer: str = "bullet"
    """bullet draws everywhere, egl through a graphics driver, blender as CLEVRER looks (extra
    blender)."""
    width: int = 480
    height: int = 320
    prefix_frames: int = 12
    """Frames of a prefix that are rendered ahead, evenly spread."""
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    retrieval: RetrievalTrackConfig = field(default_factory=RetrievalTrackConfig)

    def check(self) -> list[str]:
        problems = _too_small(
            self, "benchmark.", {"seed": 0, "scenes": 4, "max_collisions": 1, "prefix_frames": 2}
        )
        if not 0 < self.test_share <= 1:
            problems.append(f"benchmark.test_share={self.test_share} must be above 0 and at most 1")
        if self.fps <= 0:
            problems.append(f"benchmark.fps={self.fps} must be above 0")
        if self.renderer not in RENDERERS:
            problems.append(
                f"benchmark.renderer={self.renderer}: the options are {', '.join(RENDERERS)}"
            )
        absent = self.retrieval.counterfactual
        if self.simulator not in SIMULATORS:
            problems.append(
                f"benchmark.simulator={self.simulator}: the options are {', '.join(SIMULATORS)}"
            )
        elif self.simulator != "bullet" and absent.train + absent.test > 0:
            problems.append(
                f"benchmark.retrieval.counterfactual with benchmark.simulator={self.simulator}: "
                "scenes of a release cannot be simulated again, set both of its quotas to 0"
            )
        if not 2 <= self.min_objects <= self.max_objects <= LOOKS:
            problems.append(
                f"benchmark.min_objects={self.min_objects} and "
                f"benchmark.max_objects={self.max_objects}: need 2 <= min <= max <= {LOOKS}, as "
                "no two objects of a scene look alike"
            )
        if self.width < 48 or self.width * 2 != self.height * 3:
            problems.append(
                f"benchmark.width={self.width} and benchmark.height={self.height}: frames are "
                "3 wide to 2 high and 48 x 32 px at least, such as 480 x 320"
            )
        return problems


@dataclass
class TeacherConfig:
    name: str = MISSING
    """Recorded with every rationale."""
    url: str | None = None
    """An OpenAI-compatible server, such as http://127.0.0.1:8000/v1; null for the built-in
    narrator."""
    model: str | None = None
    """The model's name at the server."""
    seed: int = 0
    """Of the built-in narrator's phrasings; with a server, a label of one narration."""
    min_words: int = 80
    max_words: int = 250
    attempts: int = 4
    """Answers asked for at most for an item before it is set aside."""
    temperature: float = 0.7
    top_p: float = 0.8
    top_k: int = 20
    max_tokens: int = 640
    concurrency: int = 128
    """Requests in flight."""
    timeout: float = 120.0
    """Seconds that one request may take."""
    patience: float = 600.0
    """Seconds to wait for a server that is down before giving up."""

    def check(self) -> list[str]:
        problems = _too_small(
            self,
            "teacher.",
            {
                "seed": 0,
                "attempts": 1,
                "temperature": 0,
                "max_tokens": 1,
                "concurrency": 1,
                "timeout": 1,
                "patience": 0,
            },
        )
        if (self.url is None) != (self.model is None):
            problems.append("teacher.url and teacher.model go together: set both or neither")
        if not 0 < self.min_words <= self.max_words:
            problems.append(
                f"teacher.min_words={self.min_words} and teacher.max_words={self.max_words}: "
                "need 0 < min <= max"
            )
        if self.url is not None and not _is_url(self.url):
            problems.append(
                f"teacher.url={self.url} is no address of a server, such as "
                "http://127.0.0.1:8000/v1"
            )
        if not 0 < self.top_p <= 1:
            problems.append(f"teacher.top_p={self.top_p} must be above 0 and at most 1")
        return problems


@dataclass
class ArchitectureConfig:
    """Sizes of a Qwen3-VL built offline from a seed, with its tokenizer and processor."""

    seed: int = 0
    vocabulary: int = 1024
    hidden: int = 192
    layers: int = 4
    heads: int = 6
    kv_heads: int = 6
    head: int = 32
    """Size of one attention head; half of it is split over time, height and width."""
    feed_forward: int = 512
    vision_hidden: int = 128
    vision_layers: int = 3
    vision_heads: int = 4
    vision_feed_forward: int = 384


@dataclass
class LoraConfig:
    rank: int = 16
    """0 adds no adapters and trains the whole model."""
    alpha: int = 32
    dropout: float = 0.0
    targets: str = (
        r"(model\.)*language_model\.layers\.\d+\."
        r"(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
    )
    """Anchored pattern over module names: the language tower's projections only."""


@dataclass
class StudentConfig:
    name: str = MISSING
    model: str | None = None
    """A folder, or a hub name that is in the local cache; null builds `architecture`."""
    revision: str | None = None
    trust_remote_code: bool = False
    """Whether code that a model ships may run."""
    architecture: ArchitectureConfig | None = None
    quantization: str = "nf4"
    """nf4 or none."""
    lora: LoraConfig = field(default_factory=LoraConfig)
    image_size: int = 336
    """Frames reach the model at image_size x image_size px, before the processor's grid."""
    frames: int = 12
    """Frames a prefix, evenly spread."""
    max_length: int = 3072
    """Tokens a sample; a longer one is refused, never cut."""
    max_new_tokens: int = 512

    def check(self) -> list[str]:
        return _backbone_problems("student", self) + _too_small(
            self, "student.", {"max_new_tokens": 1}
        )


@dataclass
class RetrieverConfig:
    name: str = MISSING
    model: str | None = None
    revision: str | None = None
    trust_remote_code: bool = False
    architecture: ArchitectureConfig | None = None
    quantization: str = "nf4"
    lora: LoraConfig = field(default_factory=LoraConfig)
    image_size: int = 336
    frames: int = 12
    max_length: int = 3072
    widths: list[int] = field(default_factory=lambda: [4096, 2048, 1024, 512, 256, 128, 64])
    """Matryoshka widths, widest first."""
    query_instruction: str = "Retrieve images or text relevant to the user's query."
    frame_instruction: str = "Represent the user's input."

    def check(self) -> list[str]:
        problems = _backbone_problems("retriever", self)
        falling = sorted(set(self.widths), reverse=True) == list(self.widths)
        if not self.widths or not falling or self.widths[-1] < 1:
            problems.append(
                f"retriever.widths={self.widths} must be one or more widths that fall strictly, "
                "widest first"
            )
        return problems


def _backbone_problems(group: str, cfg: StudentConfig | RetrieverConfig) -> list[str]:
    problems = _too_small(cfg, f"{group}.", {"image_size": 32, "frames": 2, "max_length": 1})
    problems += _too_small(cfg.lora, f"{group}.lora.", {"rank": 0, "dropout": 0})
    if (cfg.model is None) == (cfg.architecture is None):
        problems.append(
            f"{group}.model and {group}.architecture: give exactly one, a model to load or sizes "
            "to build"
        )
    if cfg.quantization not in ("nf4", "none"):
        problems.append(f"{group}.quantization={cfg.quantization}: the options are nf4 and none")
    if cfg.quantization == "nf4" and cfg.lora.rank == 0:
        problems.append(
            f"{group}.quantization=nf4 with {group}.lora.rank=0: 4-bit weights cannot be trained "
            f"whole, set {group}.quantization=none or raise {group}.lora.rank"
        )
    if cfg.architecture is not None and (cfg.quantization == "nf4" or cfg.lora.rank > 0):
        problems.append(
            f"{group}.quantization={cfg.quantization} and {group}.lora.rank={cfg.lora.rank} with "
            f"{group}.architecture: a model built from a seed is trained whole, set "
            f"{group}.quantization=none and {group}.lora.rank=0"
        )
    return problems


@dataclass
class TrainConfig:
    """Settings that both trainers share."""

    lr: float = 2e-5
    schedule: str = "cosine"
    """cosine, linear or constant, after the warm-up."""
    warmup: float = 0.03
    """Share of the steps."""
    weight_decay: float = 0.0
    max_grad_norm: float = 1.0
    epochs: float = 3.0
    max_steps: int = -1
    """Optimizer steps; -1 leaves it to `epochs`."""
    micro_batch: int = 1
    accumulation: int = 16
    precision: str = "bf16"
    """bf16 or fp32: what the passes compute in; adapters and optimizer stay fp32."""
    gradient_checkpointing: bool = True
    evaluations: int = 10
    """Evaluations, evenly spread over the run, each followed by a checkpoint."""
    keep: int = 2
    """Checkpoints kept."""
    workers: int = 0
    """Processes that prepare batches."""
    report_to: list[str] = field(default_factory=list)
    """Trackers of transformers' Trainer, such as tensorboard, wandb or trackio."""

    def check(self) -> list[str]:
        problems = _too_small(
            self,
            "train.",
            {
                "warmup": 0,
                "weight_decay": 0,
                "max_grad_norm": 0,
                "micro_batch": 1,
                "accumulation": 1,
                "evaluations": 1,
                "keep": 1,
                "workers": 0,
            },
        )
        if self.lr <= 0:
            problems.append(f"train.lr={self.lr} must be above 0")
        if self.schedule not in ("cosine", "linear", "constant"):
            problems.append(
                f"train.schedule={self.schedule}: the options are cosine, linear and constant"
            )
        if self.precision not in ("bf16", "fp32"):
            problems.append(f"train.precision={self.precision}: the options are bf16 and fp32")
        if self.max_steps < 1 and (self.max_steps != -1 or self.epochs <= 0):
            problems.append(
                f"train.max_steps={self.max_steps} and train.epochs={self.epochs}: give one or "
                "more steps, or -1 and epochs above 0"
            )
        return problems


@dataclass
class SftTrainConfig(TrainConfig):
    regime: str = "cot"
    """cot (rationale and answer), answer_only, or describe (the recipe of the tiny base)."""
    validation_items: int = 64
    """Training-split items of held-out training scenes that measure the run."""

    def check(self) -> list[str]:
        problems = super().check() + _too_small(self, "train.", {"validation_items": 1})
        if self.regime not in ("cot", "answer_only", "describe"):
            problems.append(
                f"train.regime={self.regime}: the options are cot, answer_only and describe"
            )
        return problems


@dataclass
class ContrastiveTrainConfig(TrainConfig):
    batch: int = 512
    """Queries a step; each is contrasted with every target and hard negative of the batch."""
    mini_batch: int = 8
    """Samples that pass the model at once in the cached loss; moves memory, not the gradient."""
    hard_negatives: int = 1
    """Same-scene wrong-time frames a query."""
    scale: float = 50.0
    """Inverse temperature of the cosine similarities."""
    validation_queries: int = 128
    """Queries of held-out training scenes that measure the run."""

    def check(self) -> list[str]:
        problems = super().check() + _too_small(
            self, "train.", {"hard_negatives": 0, "validation_queries": 1}
        )
        if self.accumulation != 1:
            problems.append(
                f"train.accumulation={self.accumulation}: the cached loss already splits "
                "train.batch into train.mini_batch, leave train.accumulation=1"
            )
        if self.micro_batch != 1:
            problems.append(
                f"train.micro_batch={self.micro_batch}: a retriever's step is train.batch queries, "
                "of which train.mini_batch pass the model at once; leave train.micro_batch=1"
            )
        if self.scale <= 0:
            problems.append(f"train.scale={self.scale} must be above 0")
        if not 1 <= self.mini_batch <= self.batch:
            problems.append(
                f"train.mini_batch={self.mini_batch} must lie between 1 and "
                f"train.batch={self.batch}"
            )
        return problems


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
        return _too_small(
            self, "", {"workers": 1, **({"seed": 0} if hasattr(self, "seed") else {})}
        )


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
        problems = super().check() + _too_small(self, "", {"frames_gb": 0})
        for key, options in (("frames", FRAMES_AHEAD), ("parallel", ENGINES)):
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
        if self.url is not None and not _is_url(self.url):
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
        return super().check() + _too_small(self, "", {"examples": 1})


@dataclass
class NarrateCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING


@dataclass
class SftCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    teacher: TeacherConfig = MISSING
    student: StudentConfig = MISSING
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    seed: int = 0
    """Of the order of samples and of new adapters."""


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
        return problems


@dataclass
class SelectCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """The preset's recipe; a measurement takes its precision alone."""
    model: str | None = None
    """A run folder of train.sft, with its own student and recipe; null takes the student's base."""
    modes: list[str] = field(default_factory=lambda: ["reasoning", "answer"])
    """reasoning (rationale, then answer) and answer (at once), each measured by itself."""
    batch: int = 16
    """Items that pass the model at once."""
    limit: int | None = None
    """Test items at most, spread over the cells; null takes all."""
    seed: int = 0
    """Of the items that `limit` leaves."""
    suite: str | None = None
    """matched_anchor for the pairs that differ in their anchor alone; null takes the benchmark's
    own items."""
    control: str | None = None
    """candidate_only hides the prefix, shuffled_prefix shows its frames out of order; null shows
    it as it is."""

    def check(self) -> list[str]:
        problems = super().check() + _too_small(self, "", {"batch": 1, "limit": 1})
        if self.suite not in (None, "matched_anchor"):
            problems.append(f"suite={self.suite}: the options are matched_anchor and null")
        if self.control not in (None, "candidate_only", "shuffled_prefix"):
            problems.append(
                f"control={self.control}: the options are candidate_only, shuffled_prefix and null"
            )
        if sorted(self.modes) not in (["answer"], ["reasoning"], ["answer", "reasoning"]):
            problems.append(f"modes={self.modes}: give reasoning, answer or both, each once")
        return problems


@dataclass
class RetrieveCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """The preset's recipe; a measurement takes its precision alone."""
    model: str | None = None
    """A run folder of train.contrastive, with its own retriever and recipe; null takes the
    retriever's base."""
    batch: int = 64
    """Queries or frames that pass the model at once."""

    def check(self) -> list[str]:
        return super().check() + _too_small(self, "", {"batch": 1})


@dataclass
class ReportCommand(CommandConfig):
    pass


def _is_url(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and parts.port != 0 and " " not in text
    except ValueError:
        return False


def _too_small(cfg: Any, above: str, least: dict[str, float]) -> list[str]:
    """A sentence for each setting that is less than its least value; null is no value."""
    values = {name: getattr(cfg, name) for name in least}
    return [
        f"{above}{name}={value} must be {least[name]} or more"
        for name, value in values.items()
        if value is not None and value < least[name]
    ]


def _quota_problems(above: str, quotas: dict[str, Quota]) -> list[str]:
    return [
        problem
        for name, quota in quotas.items()
        for problem in _too_small(quota, f"{above}.{name}.", {"train": 0, "test": 0})
    ]
