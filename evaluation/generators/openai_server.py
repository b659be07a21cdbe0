"""A generator whose model runs on OpenAI-compatible servers, which receive the frames over HTTP."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import openai

from dynapix.conf.errors import UserError
from dynapix.conf.proxies import proxy_hint
from dynapix.conf.schema import SelectCommand, ServerConfig, StudentConfig, TwoStageCommand
from dynapix.evaluation.generators.response_log import (
    SampleOf,
    SaveResponses,
    Subject,
    response_seed,
)
from dynapix.evaluation.generators.response_schema import build_record_schema
from dynapix.models.fingerprints import find_commit, processor_digest, weights_digest
from dynapix.models.student.chat_requests import (
    build_messages,
    find_difference,
    qwen_fields,
    sampling_fields,
)
from dynapix.models.student.prompts import Sample, show_frames_as_images
from dynapix.models.student.responses import THOUGHT_TAG, GeneratedText, response_token_limit
from dynapix.models.trained_runs import product_folder, run_title
from dynapix.teacher.servers.capabilities import Messages, RequestFields
from dynapix.teacher.servers.pool import NoResponseError, ServerPool, run_limited
from dynapix.teacher.servers.responses import TRUNCATED, Response
from dynapix.teacher.servers.server import (
    API_KEY_VARIABLE,
    MALFORMED_REPLY_ERRORS,
    authentication_error,
    open_client,
)

log = logging.getLogger(__name__)

WritePrompt = Callable[[Sample], tuple[Messages, RequestFields]]
"""Writes a sample as messages, and the fields in `extra_body` that go with them."""
ADVICE = (
    ": start a server with python -m teacher.serve frames=true, or correct server.url, which ends "
    f"with /v1, or the API key in the environment variable {API_KEY_VARIABLE}"
)
"""What to do about a server that does not list its models."""
CANARY_SIZE = 64
"""Width and height (px) of the blank frames of a canary: a request that any working server answers,
sent after a failure to find out whether the server or the failed request is at fault."""


class ServedModel:
    """A generator on servers: the student of a run or export in `folder`, or a base without one."""

    def __init__(
        self, cfg: SelectCommand | TwoStageCommand, folder: Path | None, student: StudentConfig
    ) -> None:
        if folder is not None and cfg.server.model is None:
            raise UserError(
                f"model={folder} is to be measured at server.url: set server.model=NAME, the name "
                "under which the server serves this student; by default its base would respond",
                code="missing-server-model",
            )
        self._student, self._seed = student, cfg.seed
        self._server = replace(cfg.server, model=cfg.server.model or student.model)
        self.name = run_title(folder) if folder else f"{student.name} base"
        origin = served_origin(self._server)
        if folder is None and origin["parent"]:
            raise UserError(
                f"server.model={self._server.model} is an adapter over {origin['parent']}: set "
                "model=RUN, the run that trained it, so that its prompts are those of the training",
                code="adapter-without-run",
            )
        if origin["parent"] and student.quantization == "nf4":
            log.warning(
                "the adapters of %s were trained over a base in NF4: if the server has loaded the "
                "base unquantised, as python -m teacher.serve does, the responses differ from "
                "those of the student and of its merged export (python -m train.export)",
                folder,
            )
        weights = product_folder(folder, "student") if folder else None
        self._processor_source = str(weights or student.model)
        # vLLM, which takes clips and reports token ids, is the server that reports where weights
        # come from.
        self._is_vllm = self._compares = origin["root"] is not None
        source = origin["parent"] or origin["root"]
        if source is None or not Path(source).is_dir():
            log.info(
                "the weights that the server calls %s are not in a folder of this machine, and "
                "cannot be compared: when the server gets other weights under this name, %s, or "
                "the responses of the earlier weights are reused",
                self._server.model,
                "serve them under another name" if folder else "set student.revision=COMMIT",
            )
        self.identity: dict[str, Any] = {
            "served": self._server.model,
            **origin,
            "revision": student.revision,
            "weights": weights_digest(origin["root"], origin["parent"], weights),
            "processor": processor_digest(source),
        }

    def respond(
        self, mode: str, sample_of: SampleOf, subjects: list[Subject], save: SaveResponses
    ) -> None:
        """Generate the responses with `server.concurrency` requests at a time."""
        asyncio.run(self._respond(mode, sample_of, subjects, save))

    async def _respond(
        self, mode: str, sample_of: SampleOf, subjects: list[Subject], save: SaveResponses
    ) -> None:
        student, server = self._student, self._server
        loop = asyncio.get_running_loop()
        # The JSON schema allows no thought before the record.
        starts_in_thought = student.thinking and mode != "constrained"
        # The frame cache is not thread-safe, so one thread prepares all samples.
        with ThreadPoolExecutor(1) as preparer:
            limit = response_token_limit(mode, student.max_new_tokens, student.thinking)
            shared = sampling_fields(student, limit)
            schema = build_record_schema() if mode == "constrained" else None
            first = await loop.run_in_executor(preparer, sample_of, subjects[0])
            blank = blank_sample(first)
            canary = build_messages(show_frames_as_images(blank))
            show = partial(save, [])
            async with ServerPool(server, shared, canary, schema, show=show) as pool:
                write = await self._choose_form(pool, blank)
                pool.canary = write(blank)[0]

                def prepare(subject: Subject) -> tuple[Messages, RequestFields]:
                    messages, extra = write(sample_of(subject))
                    return messages, {"extra_body": shared["extra_body"] | extra}

                thoughts: list[Subject] = []

                async def respond(subject: Subject) -> None:
                    messages, fields = await loop.run_in_executor(preparer, prepare, subject)
                    if student.temperature:
                        fields["seed"] = response_seed(self._seed, subject, mode)
                    compares, self._compares = self._compares, False
                    if compares:
                        fields["extra_body"]["return_token_ids"] = True
                    try:
                        [response] = await pool.complete(messages, **fields)
                    except NoResponseError as error:
                        raise UserError(
                            f"{server.model} gave no response to {subject.name} ({error}): correct "
                            "the cause and run the same command again, which resumes",
                            code="no-response",
                        ) from error
                    if schema is not None and not response.constrained:
                        raise UserError(
                            f"{server.model}: the server does not apply the JSON schema of "
                            "constrained mode: leave out the mode, or use a server with JSON "
                            "schemas (response_format), such as vLLM",
                            code="no-constraint",
                        )
                    if compares and response.prompt_ids and self._processor:
                        ids = subject, response.prompt_ids
                        await loop.run_in_executor(preparer, self._compare, sample_of, *ids)
                    if response.reasoning and not response.text and response.flaw != TRUNCATED:
                        thoughts.append(subject)
                    save([(subject, restore_thought(response, starts_in_thought))])

                await run_limited(subjects, server.concurrency, respond)
        if thoughts:
            log.warning(
                "%d of %d responses in %s mode are thoughts without an answer, although they are "
                "complete: if the model does not think, start the server without a reasoning "
                "parser (--reasoning-parser), which takes responses for thoughts",
                len(thoughts), len(subjects), mode,
            )  # fmt: skip

    async def _choose_form(self, pool: ServerPool, blank: Sample) -> WritePrompt:
        """Return the function that writes a sample as messages and the fields that go with them.

        Clips are sent as videos in vLLM's format if the model is told their times and the server
        takes them, otherwise as images with their times.
        """
        student, processor = self._student, self._processor

        def with_video(sample: Sample) -> tuple[Messages, RequestFields]:
            return build_messages(sample), qwen_fields(student, sample.clip)

        def with_images(sample: Sample) -> tuple[Messages, RequestFields]:
            return build_messages(show_frames_as_images(sample)), {}

        from dynapix.models.student.chat_format import takes_clips

        if processor is not None and not takes_clips(processor):
            return with_images
        messages, extra = with_video(blank)
        is_asked = blank.clip and not self._is_vllm
        if is_asked and not await pool.takes(messages, max_tokens=1, extra_body=extra):
            log.warning(
                "the server takes no videos in vLLM's format: the frames of a prefix are sent as "
                "images, each after its time, which is another prompt than that of a local model"
            )
            return with_images
        return with_video

    @cached_property
    def _processor(self) -> Any:
        """The processor of the student, or None if it is not on this machine."""
        student, source = self._student, self._processor_source
        try:
            from transformers import AutoProcessor

            from dynapix.models.compat import write_clips_as_released
            from dynapix.models.loading import pin_sizes

            origin = {"trust_remote_code": student.trust_remote_code}
            if not Path(source).is_dir():
                # Loading would ask a hub that does not answer again and again.
                origin["revision"] = find_commit(source, student.revision)
            processor = AutoProcessor.from_pretrained(source, **origin)
        except Exception as error:
            # The hub's client raises the errors of whichever HTTP library is installed.
            reason = str(error).partition("\n")[0]
            log.info("prompts are not compared with a local model's, which is missing: %s", reason)
            return None
        write_clips_as_released(processor)
        pin_sizes(processor, student.image_size, student.frames)
        return processor

    def _compare(self, sample_of: SampleOf, subject: Subject, served: Sequence[int]) -> None:
        """Warn if the server reads a prompt as other tokens than a local model."""
        from dynapix.models.student.collator import encode

        own = encode(sample_of(subject), self._processor, None, self._student.thinking).input_ids
        if difference := find_difference(own, served, self._processor.tokenizer):
            log.warning(
                "the server reads prompts differently from a local model: %s. Start it with python "
                "-m teacher.serve frames=true, or expect other results",
                difference,
            )


def blank_sample(sample: Sample) -> Sample:
    """Return a sample with the same text and number of frames, but with small blank frames."""
    blank = np.zeros((CANARY_SIZE, CANARY_SIZE, 3), np.uint8)
    clip = sample.clip and replace(sample.clip, pixels=np.stack([blank] * len(sample.clip.indices)))
    return replace(sample, clip=clip, images=[blank] * len(sample.images))


def restore_thought(response: Response, starts_in_thought: bool) -> GeneratedText:
    """Return a response's text with its thought inside `<think>` tags.

    Args:
        starts_in_thought: Whether the prompt ends with `<think>`. The response then lacks this tag.
            A response that a server's reasoning parser has split lacks it as well.
    """
    text = response.text
    if response.reasoning:
        text = f"{THOUGHT_TAG}{response.reasoning}" + (f"</think>{text}" if text else "")
    elif starts_in_thought and THOUGHT_TAG not in text:
        text = f"{THOUGHT_TAG}{text}"
    return GeneratedText(text, response.flaw == TRUNCATED)


def served_origin(server: ServerConfig) -> dict[str, str | None]:
    """Ask the servers where the weights of `server.model` come from, by vLLM's /v1/models.

    Returns:
        `root`: the folder or hub name of the model or adapter. `parent`: the root of the base of an
        adapter. A value that the servers do not report is None.

    Raises:
        UserError: No server responds, one lacks the model or rejects the API key, or two serve
            different models under this name.
    """
    problems: dict[str, Exception] = {}
    origins = {}
    for url in server.urls:
        try:
            with open_client(openai.OpenAI, url, timeout=10) as client:
                origins[url] = _find_origin(client, server.model, url)
        except openai.AuthenticationError as error:
            raise authentication_error(url, error) from error
        except (openai.OpenAIError, *MALFORMED_REPLY_ERRORS) as error:
            problems[url] = error
    if not origins:
        lines = [
            f"{url} does not list its models ({str(error.__cause__ or error).splitlines()[0]})"
            f"{proxy_hint(url) or ADVICE}"
            for url, error in problems.items()
        ]
        raise UserError("\n".join(lines), code="no-server")
    first, origin = next(iter(origins.items()))
    if others := [url for url, other in origins.items() if other != origin]:
        raise UserError(
            f"server.url: {first} and {others[0]} serve different models under the name "
            f"{server.model}: list servers of one model",
            code="different-models",
        )
    return origin


def _find_origin(client: openai.OpenAI, name: str, url: str) -> dict[str, str | None]:
    """Return what a server reports of the origin of a model; see `served_origin`."""
    try:
        models = {m.id: m.model_extra or {} for m in client.models.list()}
    except openai.InternalServerError:
        # `transformers serve` fails to list its models if there is no cache of the hub.
        if not _serves_folder(client, name):
            raise
        return {"root": None, "parent": None}
    if name in models:
        served = models[name]
        parent = models.get(served.get("parent"), {})
        return {"root": served.get("root"), "parent": parent.get("root")}
    # The list of `transformers serve` lacks models that are not in that cache.
    if _serves_folder(client, name):
        return {"root": None, "parent": None}
    raise UserError(
        f"{url} does not serve server.model={name}: give one of the models that it serves "
        f"({', '.join(models) or 'none'})",
        code="unknown-model",
    )


def _serves_folder(client: openai.OpenAI, name: str) -> bool:
    """Return whether a model is a folder, and a server responds to a short request to it."""
    message = {"role": "user", "content": "Hello"}
    if not Path(name).is_dir():
        return False
    try:
        # The server closes the connection after it has failed to list its models, and a request on
        # this connection may be lost.
        client.with_options(timeout=60, max_retries=1).chat.completions.create(
            model=name, messages=[message], max_tokens=1
        )
    except openai.OpenAIError:
        return False
    return True
