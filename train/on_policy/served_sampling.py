"""Sample the responses of a student on vLLM servers, which load its adapters at each step."""

from __future__ import annotations

import asyncio
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import peft
from torch import nn
from transformers import ProcessorMixin

from dynapix.conf.errors import UserError
from dynapix.conf.runs import rank
from dynapix.conf.schema import (
    DistillTrainConfig,
    ReinforceTrainConfig,
    SamplingServerConfig,
    StudentConfig,
)
from dynapix.models.distributed import main_first
from dynapix.models.student.chat_format import takes_clips
from dynapix.models.student.chat_requests import (
    build_messages,
    find_difference,
    qwen_fields,
    sampling_fields,
)
from dynapix.models.student.prompts import show_frames_as_images
from dynapix.models.student.responses import GeneratedText
from dynapix.teacher.servers.pool import NoResponseError, ServerPool, run_limited
from dynapix.teacher.servers.responses import TRUNCATED, Response
from dynapix.train.on_policy.sampling import EncodedPrompt, ResponseSampler

ADAPTER_FOLDER = "sampled_adapters"
"""Folder of a run that contains the adapters of the current step."""


class ServedSampler(ResponseSampler):
    """Samples a student's responses on servers of its base.

    Args:
        student: Settings of the student; those of sampling are replaced.
        folder: Folder of the run. The servers read the adapters from it.

    Raises:
        UserError: The student has no adapters.
    """

    def __init__(
        self,
        processor: ProcessorMixin,
        student: StudentConfig,
        train: DistillTrainConfig | ReinforceTrainConfig,
        servers: SamplingServerConfig,
        folder: Path,
    ) -> None:
        super().__init__(processor, student, train)
        if not student.lora.rank:
            raise UserError(
                "sampling_server.url needs a student with adapters, which the servers load at each "
                "step, and student.lora.rank is 0: leave out sampling_server.url",
                code="no-adapters",
            )
        self._servers = servers
        self._folder = folder.absolute() / ADAPTER_FOLDER
        self._compared = False

    def sample(
        self, model: nn.Module, prompts: Sequence[EncodedPrompt], seeds: Sequence[int]
    ) -> list[GeneratedText]:
        """Return a response to each prompt.

        Raises:
            UserError: The servers do not respond, load no adapters, return no token ids, or read
                the first prompt as other tokens than this process.
        """
        return asyncio.run(self._sample(model, prompts, seeds))

    def close(self) -> None:
        """Remove the adapters from the servers and from the run's folder.

        Raises:
            UserError: The servers do not respond.
        """
        if rank() == 0 and self._folder.exists():
            with explain_no_response():
                asyncio.run(self._remove_adapters())

    async def _sample(
        self, model: nn.Module, prompts: Sequence[EncodedPrompt], seeds: Sequence[int]
    ) -> list[GeneratedText]:
        texts = [GeneratedText("") for _ in prompts]
        with explain_no_response():
            # The other ranks wait until the main rank has given the adapters to the servers.
            with main_first():
                if rank() == 0:
                    await self._replace_adapters(model)
            (adapters,) = self._list_adapters()
            async with self._connect(adapters.name) as pool:

                async def respond(index: int) -> None:
                    texts[index] = await self._request(pool, prompts[index], seeds[index])

                await run_limited(range(len(prompts)), self._servers.concurrency, respond)
        return texts

    def _connect(self, name: str) -> ServerPool:
        return ServerPool(replace(self._servers, model=name), {})

    def _list_adapters(self) -> list[Path]:
        return [path for path in self._folder.iterdir() if path.is_dir()]

    async def _replace_adapters(self, model: nn.Module) -> None:
        """Save the adapters of this step and load them on the servers, and remove those of the step
        before.

        Each step has a new name: vLLM caches prefixes by the name of the adapters, and runs that
        share a server do not replace each other's adapters.
        """
        assert isinstance(model, peft.PeftModel)
        self._folder.mkdir(exist_ok=True)
        earlier = self._list_adapters()
        folder = self._folder / f"{self._servers.model}-{uuid.uuid4().hex[:12]}"
        model.save_pretrained(folder)
        async with self._connect(folder.name) as pool:
            await pool.load_adapter(folder)
            await self._unload(pool, earlier)

    async def _remove_adapters(self) -> None:
        remaining = self._list_adapters()
        if remaining:
            async with self._connect(remaining[0].name) as pool:
                await self._unload(pool, remaining)
        self._folder.rmdir()

    async def _unload(self, pool: ServerPool, folders: Sequence[Path]) -> None:
        for folder in folders:
            await pool.unload_adapter(folder.name)
            shutil.rmtree(folder)

    async def _request(self, pool: ServerPool, prompt: EncodedPrompt, seed: int) -> GeneratedText:
        fields = sampling_fields(self._sampling, self._sampling.max_new_tokens)
        fields["logprobs"] = fields["extra_body"]["return_token_ids"] = True
        shown = prompt.sample
        if takes_clips(self._processor):
            fields["extra_body"] |= qwen_fields(self._sampling, shown.clip)
        else:
            shown = show_frames_as_images(shown)
        never = {str(token): -100 for token in self._never}
        [response] = await pool.complete(
            build_messages(shown), **fields, seed=seed, logit_bias=never
        )
        text = self._read(response)
        if response.prompt_ids and not self._compared:
            self._compared = True
            self._compare(prompt.encoded.input_ids, response.prompt_ids)
        return text

    def _compare(self, own: Sequence[int], served: Sequence[int]) -> None:
        """Raise UserError if a server read a prompt as other tokens: the gradients would be those
        of responses to another prompt."""
        if difference := find_difference(own, served, self._processor.tokenizer):
            raise UserError(
                f"the servers of sampling_server.url read prompts differently: {difference}. Start "
                "them with python -m teacher.serve frames=true and the student's base",
                code="other-prompts",
            )

    def _read(self, response: Response) -> GeneratedText:
        ids, logs = response.token_ids, response.log_probabilities
        if not ids or len(logs) != len(ids):
            raise UserError(
                "the servers of sampling_server.url return no token ids, or not their "
                "log-probabilities: use vLLM, whose responses contain both",
                code="no-token-ids",
            )
        text = self._processor.tokenizer.decode(ids, skip_special_tokens=True)
        return GeneratedText(text, response.flaw == TRUNCATED, ids, logs)


@contextmanager
def explain_no_response() -> Iterator[None]:
    """Say what to do if the servers do not respond."""
    try:
        yield
    except NoResponseError as error:
        raise UserError(
            f"the servers of sampling_server.url sample no responses ({error}): correct the cause "
            "and run the same command again, which resumes",
            code="no-response",
        ) from error


def build_sampler(
    processor: ProcessorMixin,
    student: StudentConfig,
    train: DistillTrainConfig | ReinforceTrainConfig,
    servers: SamplingServerConfig,
    folder: Path,
) -> ResponseSampler:
    """Return a sampler on servers, if there are any, or one in this process."""
    if servers.url is None:
        return ResponseSampler(processor, student, train)
    return ServedSampler(processor, student, train, servers, folder)
