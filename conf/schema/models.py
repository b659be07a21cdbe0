"""Students and retrievers: the base, its quantisation and adapters, and what it is shown."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING

from conf.schema.checks import no_share, too_small


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
    """Tokens of an answer, those of a thought included."""
    thinking: bool = False
    """Whether the model thinks before it answers. What it thinks is no answer."""
    temperature: float = 0.0
    """At which tokens of an answer are drawn; 0 takes the likeliest one each time."""
    top_p: float = 1.0
    """Share of the likeliest tokens that are drawn from."""
    top_k: int = 0
    """How many of the likeliest tokens are drawn from; 0 sets no bound."""

    def check(self) -> list[str]:
        least = {"max_new_tokens": 1, "temperature": 0, "top_k": 0}
        problems = _backbone_problems("student", self) + too_small(self, "student.", least)
        if not 0 < self.top_p <= 1:
            problems.append(f"student.top_p={self.top_p} must be above 0 and at most 1")
        return problems


ENCODERS = ("qwen3_vl", "vlm2vec", "dual", "languagebind")


@dataclass
class LateConfig:
    """A retriever of many vectors: one a token of the frame, or of the query's clip and question. A
    frame scores, for each vector of the query, the most that one of its own gives. The sum of these
    goes with a train.scale of about 1."""

    width: int = 128
    """Entries of a vector."""
    pool: int = 1
    """A frame keeps one of so many vectors, means of those that are most alike; 1 keeps all."""


@dataclass
class RetrieverConfig:
    name: str = MISSING
    encoder: str = "qwen3_vl"
    """qwen3_vl and vlm2vec read a prefix and its question together; dual (CLIP, SigLIP 2) and
    languagebind embed them apart and add them up. qwen3_vl alone is trained here, the others are
    measured as they were released."""
    model: str | None = None
    image_model: str | None = None
    """Of languagebind: what embeds frames, where `model` embeds prefixes and questions."""
    revision: str | None = None
    image_revision: str | None = None
    trust_remote_code: bool = False
    architecture: ArchitectureConfig | None = None
    quantization: str = "nf4"
    lora: LoraConfig = field(default_factory=LoraConfig)
    image_size: int = 336
    frames: int = 12
    max_length: int = 3072
    widths: list[int] = field(default_factory=lambda: [4096, 2048, 1024, 512, 256, 128, 64])
    """Matryoshka widths, widest first. Those of a retriever with one vector; `late` has its own."""
    late: LateConfig | None = None
    """null gives a query and a frame one vector each."""
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
        if self.late is not None:
            problems += too_small(self.late, "retriever.late.", {"width": 1, "pool": 1})
        return problems + self._encoder_problems()

    def _encoder_problems(self) -> list[str]:
        if self.encoder not in ENCODERS:
            return [f"retriever.encoder={self.encoder}: the options are {', '.join(ENCODERS)}"]
        problems = []
        if self.encoder != "qwen3_vl" and (
            self.quantization != "none"
            or self.lora.rank
            or self.late is not None
            or self.architecture is not None
        ):
            problems.append(
                f"retriever.encoder={self.encoder} is measured as it was released: give "
                "retriever.quantization=none and retriever.lora.rank=0, and leave retriever.late "
                "and retriever.architecture null"
            )
        if (self.encoder == "languagebind") != (self.image_model is not None):
            problems.append(
                f"retriever.image_model={self.image_model} with retriever.encoder={self.encoder}: "
                "languagebind, and it alone, has a model of its own for frames"
            )
        return problems


def _backbone_problems(group: str, cfg: StudentConfig | RetrieverConfig) -> list[str]:
    problems = too_small(cfg, f"{group}.", {"image_size": 32, "frames": 2, "max_length": 1})
    problems += too_small(cfg.lora, f"{group}.lora.", {"rank": 0})
    problems += no_share(cfg.lora, f"{group}.lora.", ["dropout"])
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
