"""Settings of students and retrievers: base, quantisation, adapters and inputs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from dynapix.conf.schema.settings import MISSING, Settings, path, setting

ENCODERS = ("sentence_transformers", "vlm2vec", "dual", "languagebind")


@dataclass
class ArchitectureConfig(Settings):
    """Sizes of a Qwen3-VL that is built with random weights and its own tokenizer, without any
    download."""

    seed: int = 0
    """Seed of the weights."""
    vocabulary: int = 1024
    """Number of tokens of the vocabulary."""
    hidden: int = 192
    """Hidden size of the language tower."""
    layers: int = 4
    """Layers of the language tower."""
    heads: int = 6
    """Attention heads per layer of the language tower."""
    kv_heads: int = 6
    """Key and value heads per layer of the language tower."""
    head: int = 32
    """Size of one attention head of the language tower. Its rotary frequencies (half of this size)
    are divided among time, height and width."""
    feed_forward: int = 512
    """Feed-forward size of the language tower."""
    patch: int = setting(16, least=4)
    """Width and height (px) of a patch; a visual token covers 2 x 2 patches."""
    vision_hidden: int = 128
    """Hidden size of the vision tower."""
    vision_layers: int = 3
    """Layers of the vision tower."""
    vision_heads: int = 4
    """Attention heads per layer of the vision tower."""
    vision_feed_forward: int = 384
    """Feed-forward size of the vision tower."""


@dataclass
class LoraConfig(Settings):
    rank: int = setting(16, least=0)
    """Rank of the adapters; 0 adds no adapters and trains the whole model."""
    alpha: int = setting(32, least=1)
    """Numerator of the adapters' scale: their output is multiplied by alpha / rank."""
    dropout: float = setting(0.0, least=0, below=1)
    """Dropout probability of the adapters' inputs."""
    targets: str | None = None
    """Regular expression that matches the full names of the modules to adapt; null adapts the
    attention and feed-forward projections of the language tower."""


@dataclass
class ModelConfig(Settings):
    """Settings that students and retrievers share."""

    name: str = MISSING
    """Name of the model in reports."""
    model: str | None = path(None)
    """Folder of the base, or its name on the Hugging Face hub, from which it is downloaded unless
    it is in the local cache. null builds a model from `architecture`."""
    revision: str | None = None
    """Branch, tag or commit of `model` on the hub."""
    trust_remote_code: bool = False
    """Allow Python code from the model's repository to run."""
    architecture: ArchitectureConfig | None = None
    """Sizes of a model to build with random weights; null loads `model`."""
    quantization: str = setting("nf4", ("nf4", "none"))
    """Quantisation of the base's weights: nf4 (4 bits) or none."""
    lora: LoraConfig = field(default_factory=LoraConfig)
    image_size: int = setting(336, least=32)
    """Width and height (px) to which frames are resized before the model's image processor. Qwen's
    processors keep this size; those of other families resize to the size of their vision tower."""
    frames: int = setting(12, least=2)
    """Number of evenly spaced frames of a prefix that the model sees."""
    max_length: int = setting(3072, least=1)
    """Maximum length (tokens) of an input, including the response if it is trained on. A longer
    input raises an error; inputs are never truncated."""

    def find_problems(self, group: str) -> Iterator[str]:
        rank = self.lora.rank
        quantization = f"{group}quantization={self.quantization}"
        if (self.model is None) == (self.architecture is None):
            yield (
                f"{group}model and {group}architecture: set exactly one of them, a model to load "
                "or the sizes of a model to build"
            )
        if self.quantization == "nf4" and rank == 0:
            yield (
                f"{quantization} with {group}lora.rank=0: 4-bit weights cannot be trained "
                f"directly; set {group}quantization=none or raise {group}lora.rank"
            )
        if self.architecture is not None and (self.quantization == "nf4" or rank > 0):
            yield (
                f"{quantization} and {group}lora.rank={rank} with {group}architecture: a model "
                f"with random weights is trained as a whole; set {group}quantization=none and "
                f"{group}lora.rank=0"
            )


@dataclass
class StudentConfig(ModelConfig):
    max_new_tokens: int = setting(512, least=1)
    """Maximum number of generated tokens, including those of thinking. Without thinking, answer
    mode has a fixed limit of 16 tokens instead."""
    thinking: bool = False
    """Let the model think (`<think>` ... `</think>`) before its response. Only the text after the
    thinking is scored."""
    temperature: float = setting(0.0, least=0)
    """Sampling temperature of responses; 0 decodes greedily."""
    top_p: float = setting(1.0, above=0, most=1)
    """Sample from the smallest set of most likely tokens whose total probability reaches this."""
    top_k: int = setting(0, least=0)
    """Sample from this number of most likely tokens; 0 sets no limit."""


@dataclass
class LateConfig(Settings):
    """Late interaction: a frame has one vector per token, and a query has one per token of its clip
    and question. The score is the sum, over the query's vectors, of the highest similarity to any
    vector of the frame. Train with train.scale near 1."""

    width: int = setting(128, least=1)
    """Number of dimensions of each token's vector."""


@dataclass
class RetrieverConfig(ModelConfig):
    encoder: str = setting("sentence_transformers", ENCODERS)
    """How the model is loaded. sentence_transformers loads any model that this library loads, and
    trains those that read images; a saved retriever keeps its pooling and its prompts, and another
    model gets last-token pooling. vlm2vec, dual (CLIP, SigLIP 2) and languagebind are released
    models that are only evaluated."""
    image_model: str | None = path(None)
    """Model that embeds frames, for languagebind only; `model` embeds prefixes and questions."""
    image_revision: str | None = None
    """Branch, tag or commit of `image_model` on the hub."""
    widths: list[int] = field(default_factory=lambda: [4096, 2048, 1024, 512, 256, 128, 64])
    """Matryoshka widths in descending order; not used with late interaction (`late.width`)."""
    late: LateConfig | None = None
    """Settings of late interaction, with one vector per token; +exp=late_interaction sets them.
    null embeds each query and each frame as a single vector."""
    query_instruction: str | None = None
    """Prompt of a query: the system message of a chat model. null keeps the prompt of a saved
    retriever; a model without pooling gets that of Qwen3-VL-Embedding."""
    frame_instruction: str | None = None
    """Prompt of a frame, as `query_instruction`."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        descending = sorted(set(self.widths), reverse=True) == list(self.widths)
        if not self.widths or not descending or self.widths[-1] < 1:
            yield (
                f"{group}widths={self.widths}: give one or more widths above 0 in strictly "
                "descending order"
            )
        encoder = f"{group}encoder={self.encoder}"
        if self.encoder in ENCODERS[1:] and (
            self.quantization != "none"
            or self.lora.rank
            or self.late is not None
            or self.architecture is not None
        ):
            yield (
                f"{encoder} can only be evaluated as released: set {group}quantization=none and "
                f"{group}lora.rank=0, and leave {group}late and {group}architecture null"
            )
        if (self.encoder == "languagebind") != (self.image_model is not None):
            yield (
                f"{group}image_model={self.image_model} with {encoder}: languagebind needs an "
                "image_model, and no other encoder takes one"
            )
