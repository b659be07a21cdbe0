"""What decoding under the grammar costs and gains, asked of a running vLLM server.

    python -m benchmarks.speed.grammar http://127.0.0.1:8000/v1 MODEL

Asks for a rationale of each of 64 made scenes, 32 at a time, with the grammar and without, and
judges each answer's form: all that `validate` rejects but a wrong letter, for a model that has
learnt nothing knows no right one. The request that compiles the grammar is timed by itself.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import openai

from conf.schema import TeacherConfig
from teacher.grammar import grammar
from teacher.predicates import predicates_of
from teacher.prompts import messages
from teacher.validation.validate import validate
from tests.teacher import synthetic

REQUESTS, IN_FLIGHT = 64, 32
MAX_TOKENS = 2500
"""Above `TeacherConfig.max_tokens`, for a random model spells its words in many tokens."""


@dataclass
class Tally:
    """What became of one run's answers."""

    tokens: int = 0
    seconds: float = 0.0
    accepted: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        reasons = ", ".join(f"{n} {reason}" for reason, n in self.reasons.most_common())
        return (
            f"{self.accepted} of {REQUESTS} of a rationale's form, {self.tokens} tokens, "
            f"{self.tokens / self.seconds:.0f} a second; rejected for: {reasons or 'nothing'}"
        )


def jobs(cfg: TeacherConfig) -> list:
    """Chats about made scenes, and what to judge their answers by."""
    rng, made = np.random.default_rng(0), []
    while len(made) < REQUESTS:
        scene = synthetic.random_scene(rng)
        item = synthetic.item((60, 80, 100, 120), answer=len(made) % 4)
        predicates = predicates_of(item, scene, lambda _, scene=scene: scene)
        if predicates is not None:
            made.append((messages(predicates, item, cfg), predicates, item))
    return made


async def ask_all(client: openai.AsyncOpenAI, cfg: TeacherConfig, made: list, body: dict) -> Tally:
    tally, waiting = Tally(), iter(made)

    async def lane() -> None:
        for chat, predicates, item in waiting:
            completion = await ask(client, cfg, chat, body)
            tally.tokens += completion.usage.completion_tokens
            choice = completion.choices[0]
            verdict = validate((choice.message.content or "").strip(), predicates, item, cfg)
            reasons = {reason.split(":")[0] for reason in verdict.reasons} - {"wrong answer"}
            reasons |= {"cut off"} if choice.finish_reason == "length" else set()
            tally.reasons.update(reasons)
            tally.accepted += not reasons

    since = time.perf_counter()
    await asyncio.gather(*(lane() for _ in range(IN_FLIGHT)))
    tally.seconds = time.perf_counter() - since
    return tally


async def ask(client: openai.AsyncOpenAI, cfg: TeacherConfig, chat: list, body: dict) -> object:
    return await client.chat.completions.create(
        model=cfg.model,
        messages=chat,
        temperature=cfg.temperature,
        top_p=cfg.top_p,
        max_tokens=cfg.max_tokens,
        extra_body={
            "top_k": cfg.top_k,
            "chat_template_kwargs": {"enable_thinking": False},
            **body,
        },
    )


async def main(url: str, model: str) -> None:
    cfg = TeacherConfig(name="grammar", url=url, model=model, max_tokens=MAX_TOKENS)
    client = openai.AsyncOpenAI(base_url=url, api_key="none", max_retries=0, timeout=600)
    made = jobs(cfg)
    text = grammar(cfg)
    held = {"structured_outputs": {"grammar": text}}
    for name, body in (("without", {}), ("with", held)):
        since = time.perf_counter()
        await ask(client, TeacherConfig(**{**vars(cfg), "max_tokens": 1}), made[0][0], body)
        first = time.perf_counter() - since
        print(f"{name:8} first token after {first:.2f} s; {await ask_all(client, cfg, made, body)}")
    print(f"the grammar is {len(text) / 1e3:.0f} KB")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2]))
