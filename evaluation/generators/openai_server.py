"""A model that answers on servers, which are asked with its frames."""

from __future__ import annotations

import asyncio
import base64
import io
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import openai
from PIL import Image

from conf.errors import UserError
from conf.schema import ServerConfig, StudentConfig
from evaluation.generators.response_log import SaveResponses, Subject, response_seed
from evaluation.generators.response_schema import schema
from models.student.generation import THOUGHT, GeneratedText, response_token_limit
from models.student.prompts import Clip, Sample
from teacher.servers.concurrency import run_limited
from teacher.servers.pool import NoResponseError, ServerPool
from teacher.servers.responses import TRUNCATED, Response
from teacher.servers.server import (
    MALFORMED_RESPONSE_ERRORS,
    Messages,
    RequestFields,
    authentication_error,
    get_api_key,
)

ANY_SIZE = 1
"""Pixels that an image has at least; none is enlarged."""
BLANK = 64
"""Edge in px of the frames of a canary."""


async def say(
    server: ServerConfig,
    cfg: StudentConfig,
    seed: int,
    mode: str,
    sample_of: Callable[[Subject], Sample],
    things: list[Subject],
    keep: SaveResponses,
) -> None:
    """Have a served model answer in `mode`, as `sample_of` shows and asks each.

    Raises:
        UserError: no server can be asked, does not take a clip and images, or has no answer to
            one though it answers others.
    """
    loop = asyncio.get_running_loop()
    # What is held to a record from its first token on has no thought.
    opened = cfg.thinking and mode != "constrained"
    # Frames are kept in one cache, which takes one thread at a time.
    with ThreadPoolExecutor(1) as desk:
        first = await loop.run_in_executor(desk, sample_of, things[0])
        request = request_of(cfg, mode, first.clip)
        async with ServerPool(server, request, chat_of(blank(first))) as client:

            async def ask(thing: Subject) -> None:
                chat, clip = await loop.run_in_executor(desk, _shown, sample_of, thing)
                own = request_of(cfg, mode, clip)
                if cfg.temperature:
                    own["seed"] = response_seed(seed, thing, mode)
                try:
                    [reply] = await client.complete(chat, **own)
                except NoResponseError as fault:
                    raise UserError(
                        f"{server.model} has no answer about {thing.name} ({fault}); once that is "
                        "mended, run the same command again, it goes on with what is answered"
                    ) from fault
                keep([(thing, written(reply, opened))])

            await run_limited(things, server.concurrency, ask)


def _shown(sample_of: Callable[[Subject], Sample], thing: Subject) -> tuple[Messages, Clip | None]:
    sample = sample_of(thing)
    return chat_of(sample), sample.clip


def chat_of(sample: Sample) -> Messages:
    """A conversation in the API's form, its frames as PNGs within it. A clip is vLLM's sequence of
    images, whose times go with the request."""
    pictures = iter(sample.images)
    parts: list[dict[str, Any]] = []
    for part in sample.content:
        if part["type"] == "text":
            parts.append(part)
        elif part["type"] == "image":
            url = f"data:image/png;base64,{_png(next(pictures))}"
            parts.append({"type": "image_url", "image_url": {"url": url}})
        else:
            frames = ",".join(map(_png, sample.clip.pixels))
            url = f"data:video/jpeg;base64,{frames}"
            parts.append({"type": "video_url", "video_url": {"url": url}})
    return [{"role": "user", "content": parts}]


def _png(pixels: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1)
    return base64.b64encode(buffer.getvalue()).decode()


def blank(sample: Sample) -> Sample:
    """A sample of the same form that shows nothing."""
    empty = np.zeros((BLANK, BLANK, 3), np.uint8)
    clip = sample.clip and replace(sample.clip, pixels=np.stack([empty] * len(sample.clip.indices)))
    return replace(sample, clip=clip, images=[empty] * len(sample.images))


def request_of(cfg: StudentConfig, mode: str, clip: Clip | None) -> RequestFields:
    """What goes with a chat: how tokens are drawn, what may be written, and that frames are neither
    sampled again nor shrunk, as where a model is loaded here."""
    area = cfg.image_size**2
    # Twice the pixels there are, as where a model is loaded here: no budget shrinks a frame.
    images = {"size": {"shortest_edge": ANY_SIZE, "longest_edge": 2 * area}}
    videos = {"size": {"shortest_edge": ANY_SIZE, "longest_edge": 2 * cfg.frames * area}}
    extra: dict[str, Any] = {
        "chat_template_kwargs": {"enable_thinking": cfg.thinking},
        "mm_processor_kwargs": {
            "images_kwargs": images,
            "videos_kwargs": {**videos, "do_sample_frames": False},
        },
    }
    if clip:
        extra["media_io_kwargs"] = {"video": {"num_frames": -1, **clip.metadata}}
    if cfg.temperature:
        # Left out, a server takes the bound of the model's own generation_config.json.
        extra["top_k"] = cfg.top_k or -1
    request = {
        "temperature": cfg.temperature,
        "top_p": cfg.top_p,
        "max_tokens": response_token_limit(mode, cfg.max_new_tokens, cfg.thinking),
        "extra_body": extra,
    }
    if mode == "constrained":
        held = {"name": "record", "strict": True, "schema": schema()}
        request["response_format"] = {"type": "json_schema", "json_schema": held}
    return request


def written(reply: Response, opened: bool) -> GeneratedText:
    """What a server's model wrote, its thought within the text. A thought that the prompt has
    `opened`, or that the server has taken out, is opened again."""
    text = reply.text
    if reply.reasoning:
        text = f"{THOUGHT}{reply.reasoning}" + (f"</think>{text}" if text else "")
    elif opened and THOUGHT not in text:
        text = f"{THOUGHT}{text}"
    return GeneratedText(text, reply.flaw == TRUNCATED)


def revision(server: ServerConfig) -> dict[str, Any]:
    """What the servers that answer tell of `server.model`: the `root` that it was loaded from, and
    that of the `parent` that it is an adapter of.

    Raises:
        UserError: none answers, or one does not serve the model or accept the key, or two have
            another one by that name.
    """
    problems, told = [], {}
    for url in server.urls:
        try:
            with openai.OpenAI(
                base_url=url, api_key=get_api_key(), max_retries=0, timeout=10
            ) as client:
                models = {m.id: m.model_extra or {} for m in client.models.list()}
        except openai.AuthenticationError as error:
            raise authentication_error(url, error) from error
        except (openai.OpenAIError, *MALFORMED_RESPONSE_ERRORS) as error:
            problems.append(f"{url}: {error.__cause__ or error}")
            continue
        if server.model not in models:
            raise UserError(
                f"{url} does not serve server.model={server.model}; it has {', '.join(models)}"
            )
        own = models[server.model]
        parent = models.get(own.get("parent"), {}).get("root")
        told[url] = {"root": own.get("root"), "parent": parent}
    if not told:
        raise UserError(
            f"no server of server.url can be asked ({'; '.join(problems)}): start one, such as "
            "with python -m teacher.serve frames=true, and run this again"
        )
    first, *others = told
    for url in others:
        if told[url] != told[first]:
            raise UserError(
                f"server.url: by the name {server.model} {first} has {_loaded(told[first])} and "
                f"{url} {_loaded(told[url])}: give servers of one model"
            )
    return told[first]


def _loaded(told: dict[str, Any]) -> str:
    over = f" over {told['parent']}" if told["parent"] else ""
    return f"{told['root']}{over}"
