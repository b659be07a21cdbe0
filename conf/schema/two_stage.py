"""What two-stage retrieval takes: who writes, who draws, and who matches."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING

from conf.schema.benchmark import BenchmarkConfig
from conf.schema.checks import too_small
from conf.schema.commands import CommandConfig
from conf.schema.models import RetrieverConfig, StudentConfig
from conf.schema.servers import ImageServerConfig, ServerConfig
from conf.schema.training import ContrastiveTrainConfig, SftTrainConfig

ROUTES = ("cot_text", "predict_caption", "predict_image", "predict_drawn")


@dataclass
class MatcherConfig:
    """The frozen encoder that matches what was written to the database: any retriever's preset."""

    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """The preset's recipe; a measurement takes its precision alone."""
    model: str | None = None
    """A run folder of train.contrastive or what train.export wrote, with its own retriever and
    recipe; null takes the preset's model as it was released."""
    batch: int = 64
    """Texts or frames that pass the model at once."""

    def check(self) -> list[str]:
        return too_small(self, "matcher.", {"batch": 1})


@dataclass
class TwoStageCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    server: ServerConfig = field(default_factory=ServerConfig)
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """The preset's recipe; a base that writes takes its precision."""
    model: str | None = None
    """Who writes: a run folder of train.sft or what train.export wrote, with its own student and
    recipe; null takes the student's base."""
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    images: ImageServerConfig = field(default_factory=ImageServerConfig)
    routes: list[str] | None = None
    """cot_text (the state that a rationale foresees, matched to frames), predict_caption (a
    description of the future frame, matched to descriptions of the database's frames by the same
    model), predict_image (that description, matched to frames) and predict_drawn (what the server
    of images draws of it, matched to frames); null takes the first of a student, and the first
    three of a base."""
    batch: int = 16
    """Queries or frames that pass the writing model at once."""
    seed: int = 0
    """Of texts that are drawn, and of the scenes that are drawn for the intervals."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "", {"batch": 1})
        given = ["cot_text"] if self.routes is None else self.routes
        if not given or len(set(given)) < len(given) or set(given) - set(ROUTES):
            problems.append(
                f"routes={self.routes}: give one or more of {', '.join(ROUTES)}, each once"
            )
        if "predict_drawn" in given and not (self.images.urls and self.images.model):
            problems.append(
                "routes: predict_drawn needs a server of images, give "
                "images.url=http://HOST:PORT/v1 and images.model=NAME"
            )
        return problems
