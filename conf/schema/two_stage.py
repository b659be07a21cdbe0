"""Settings of two-stage retrieval: the writing model, the image server and the matcher."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING

from conf.schema.benchmark import BenchmarkConfig
from conf.schema.checks import check_choices, check_minimum
from conf.schema.commands import CommandConfig
from conf.schema.models import RetrieverConfig, StudentConfig
from conf.schema.servers import ImageServerConfig, ServerConfig
from conf.schema.training import ContrastiveTrainConfig, SftTrainConfig

ROUTES = ("cot_text", "predict_caption", "predict_image", "predict_generated_image")


@dataclass
class MatcherConfig:
    """Frozen encoder that matches written texts to the database: the preset of any retriever."""

    retriever: RetrieverConfig = MISSING
    train: ContrastiveTrainConfig = field(default_factory=ContrastiveTrainConfig)
    """The preset's training recipe, of which only the precision is used."""
    model: str | None = None
    """Run folder of train.contrastive or folder that train.export wrote, with its own retriever and
    recipe; null uses the preset's released model."""
    batch: int = 64
    """Texts or frames per forward pass."""

    def check(self) -> list[str]:
        return check_minimum(self, "matcher.", {"batch": 1})


@dataclass
class TwoStageCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    student: StudentConfig = MISSING
    server: ServerConfig = field(default_factory=ServerConfig)
    train: SftTrainConfig = field(default_factory=SftTrainConfig)
    """The preset's training recipe, of which a base uses only the precision."""
    model: str | None = None
    """Writing model: run folder of train.sft or folder that train.export wrote, with its own
    student and recipe; null uses the student's base."""
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    images: ImageServerConfig = field(default_factory=ImageServerConfig)
    routes: list[str] | None = None
    """Routes to measure: cot_text (the future state in a rationale, matched to frames),
    predict_caption (a description of the future frame, matched to the same model's descriptions of
    the database's frames), predict_image (that description, matched to frames) and
    predict_generated_image (an image that the image server generates from it, matched to frames).
    null uses cot_text for a student, and the first three for a base."""
    batch: int = 16
    """Queries or frames per forward pass of the writing model."""
    seed: int = 0
    """Seed of sampled texts and of the bootstrap."""

    def check(self) -> list[str]:
        problems = super().check() + check_minimum(self, "", {"batch": 1})
        if "predict_drawn" in (self.routes or ()):
            return [*problems, "routes: predict_drawn is now called predict_generated_image"]
        problems += check_choices("routes", self.routes, ROUTES)
        generates = "predict_generated_image" in (self.routes or ())
        if generates and not (self.images.urls and self.images.model):
            problems.append(
                "routes: predict_generated_image needs an image server: set "
                "images.url=http://HOST:PORT/v1 and images.model=NAME"
            )
        return problems
