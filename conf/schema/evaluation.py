"""Settings of the commands that evaluate, report and run the human study."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from ipaddress import ip_address
from urllib.parse import urlsplit

from dynapix.conf.schema.benchmark import PAIRED, POOLS, BenchmarkConfig
from dynapix.conf.schema.commands import CommandConfig
from dynapix.conf.schema.models import RetrieverConfig, StudentConfig
from dynapix.conf.schema.servers import ServerConfig
from dynapix.conf.schema.settings import (
    MISSING,
    Settings,
    check_choices,
    check_run,
    is_url,
    path,
    setting,
)
from dynapix.conf.schema.training import RATIONALE_REGIMES, ContrastiveTrainConfig, SftTrainConfig

RESPONSE_MODES = ("reasoning", "answer", "record", "constrained")
ROUTES = ("cot_text", "predict_caption", "predict_image")


@dataclass
class ItemsCommand(CommandConfig):
    """Settings of the commands that measure models on selection items."""

    limit: int | None = setting(None, least=1)
    """Maximum number of test items, sampled evenly from the families; null uses all items."""
    suite: str | None = setting(None, (*PAIRED, None))
    """matched_anchor uses pairs of items that differ only in how the question names the target's
    moment: by an event or by a time. interventions uses pairs of items that ask for what comes and
    for what would have come. null uses the benchmark's standard items."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.suite and self.limit == 1:
            yield f"limit=1 with suite={self.suite}: a pair has two items; give limit=2 or more"


@dataclass
class GenerationCommand(CommandConfig):
    """Settings of the commands that measure a model by its generated text."""

    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    server: ServerConfig = field(default_factory=ServerConfig)
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """Training settings of the preset. For a base, only train.precision is used and, in
    evaluation.select, train.regime, which determines the prompt."""
    model: str | None = path(None)
    """Folder of a run of train.sft, train.distill or train.reinforce, or of its export. The
    settings saved there replace `student` and `train`. null measures the base that `student`
    names."""
    batch: int = setting(32, least=1)
    """Number of prompts per generated batch; not used with servers."""
    seed: int = setting(0, least=0)
    """Seed for sampling items and responses, and for the bootstrap."""


@dataclass
class SelectCommand(GenerationCommand, ItemsCommand):
    modes: list[str] | None = None
    """Response modes to measure: reasoning (rationale, then answer), answer (only the answer),
    record (JSON object with the choice) and constrained (the same object, with decoding constrained
    to its JSON schema). null uses the modes that the student was trained in; for a base, record and
    constrained."""
    control: str | None = setting(None, ("candidate_only", "shuffled_prefix", None))
    """Control condition to measure besides the unchanged items: candidate_only leaves out the
    prefix, shuffled_prefix shuffles its frames. null measures only the unchanged items."""
    prompt_regime: str | None = setting(None, (*RATIONALE_REGIMES, None))
    """Regime whose instruction ends the prompts in reasoning mode; null takes that of the student's
    training. With cot_no_match_layout, a student of cot is asked for no lines per candidate."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if self.prompt_regime and self.modes != ["reasoning"]:
            yield (
                f"prompt_regime={self.prompt_regime} changes the prompts of reasoning mode only: "
                "add modes=[reasoning]"
            )
        yield from check_choices("modes", self.modes, RESPONSE_MODES)


@dataclass
class EmbedderConfig(Settings):
    """A retriever to measure or, in evaluation.two_stage, to match generated texts to frames."""

    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """Training settings of the preset, of which only train.precision is used."""
    model: str | None = path(None)
    """Folder of a run of train.contrastive, or of its export. The settings saved there replace
    `retriever` and `train`. null uses the model that `retriever` names as released, or untrained if
    it is built from an architecture."""
    batch: int = setting(64, least=1)
    """Number of queries, prefixes, texts or frames per embedded batch."""


@dataclass
class EmbeddingCommand(EmbedderConfig, CommandConfig):
    """Settings of the commands that measure a retriever."""

    benchmark: BenchmarkConfig = MISSING
    seed: int = setting(0, least=0)
    """Seed for sampling items and for the bootstrap."""


@dataclass
class RetrieveCommand(EmbeddingCommand):
    pool: str = setting("future", POOLS)
    """Test queries to measure: future (the standard test) or counterfactual (where an object would
    be if another were absent)."""


@dataclass
class SimilarityCommand(ItemsCommand, EmbeddingCommand):
    """Settings of evaluation.similarity."""


@dataclass
class ReportCommand(CommandConfig):
    runs: list[str] | None = None
    """Run folders below `checkpoints`, or glob patterns of them, such as [select/cot,retrieve/*];
    null reports every finished run, and the results in `saved`."""
    saved: str = path("runs")
    """Folder of the results that the `save` methods of `dynapix.Result` and
    `dynapix.RetrievalScores` wrote."""
    logs: list[str] = field(default_factory=list)
    """Logs of other harnesses on benchmarks in `store`, which are saved in `saved`: of inspect_ai
    (*.eval), lmms-eval (the samples, *.jsonl) and MTEB (*_predictions.json)."""
    items: int = setting(120, least=0)
    """Maximum number of items shown per benchmark, sampled evenly from the subtypes and from
    correct and wrong answers."""
    seed: int = setting(0, least=0)
    """Seed of the sample of items."""

    def find_problems(self, group: str) -> Iterator[str]:
        if self.runs is not None and (not self.runs or not all(r.strip("/. ") for r in self.runs)):
            yield (
                f"runs={self.runs}: name folders below {self.checkpoints}, such as "
                "runs=[select/cot,retrieve/*], or leave runs=null for every finished run"
            )


@dataclass
class TwoStageCommand(GenerationCommand):
    matcher: EmbedderConfig = field(default_factory=EmbedderConfig)
    routes: list[str] | None = None
    """Routes from a query to frames: cot_text (matches the prediction and the outcome of the
    model's rationale to frames), predict_image (matches the model's description of the future frame
    to frames) and predict_caption (matches this description to the model's captions of the frames).
    null uses cot_text for a student, and all three for a base."""

    def find_problems(self, group: str) -> list[str]:
        return check_choices("routes", self.routes, ROUTES)


@dataclass
class StudyCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    items: str = path("60")
    """Number of test items, sampled evenly from the families; or a file with one item_id per
    line."""
    annotators: int = setting(3, least=1)
    """Number of annotators. Each has a personal link and answers every item."""
    seed: int = setting(0, least=0)
    """Seed of the sample of items and of each annotator's order of items and candidates."""
    host: str = "127.0.0.1"
    """Network address at which the server listens; 0.0.0.0 (all addresses) also needs `public`."""
    port: int = 8765
    """Port at which the server listens."""
    public: str | None = None
    """Address at which annotators reach the study, such as https://study.example.org behind a
    proxy; null uses host and port."""

    @property
    def address(self) -> str:
        """The address with which the annotators' links begin."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return (self.public or f"http://{host}:{self.port}").rstrip("/")

    def find_problems(self, group: str) -> Iterator[str]:
        if not self.items or (self.items.isdecimal() and int(self.items) == 0):
            yield f"items={self.items} selects no item: give a number above 0, or a file"
        if not 0 < self.port < 65536:
            yield f"port={self.port} is not a port: give a number from 1 to 65535"
        example = "such as https://study.example.org"
        if self.public is not None:
            # urlsplit raises an error for some texts that are no URL.
            url = urlsplit(self.public) if is_url(self.public) else None
            if url is None or not url.netloc or url.path not in ("", "/"):
                yield f"public={self.public} is not the URL of a host, {example}"
        if not _is_loopback(self.host) and not (self.public or "").startswith("https:"):
            yield (
                f"host={self.host} would send sign-in links unencrypted: serve the study behind an "
                f"https proxy with public=ADDRESS, {example}, or leave host at 127.0.0.1"
            )


@dataclass
class ExportStudyCommand(CommandConfig):
    run: str = path("default")
    """Run of evaluation.study to export: its name or its folder."""
    seed: int = setting(0, least=0)
    """Seed of the bootstrap over scenes."""

    def find_run_problems(self) -> list[str]:
        return check_run(self.run, f"{self.checkpoints}/study")


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
