"""What a server can do, by vLLM's own benchmark client; runs in vLLM's environment.

    .venv-vllm/bin/python -P benchmarks/vllm_limit.py CHATS URL MODEL IN_FLIGHT MAX_TOKENS

CHATS is a JSON list of chats, sent all at once but for IN_FLIGHT at a time. For each line on its
input it prints a JSON object: answers and tokens a second by vLLM's client, which streams, and by
bare requests, which do not, as the teacher's client asks.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import aiohttp
from vllm.benchmarks.datasets import SampleRequest
from vllm.benchmarks.serve import TaskType, benchmark

SAMPLING = {"temperature": 0.7, "top_p": 0.8, "top_k": 20}
Chats = list[list[dict[str, str]]]


async def by_vllm(chats: Chats, url: str, model: str, in_flight: int, max_tokens: int) -> Any:
    requests = [
        SampleRequest(prompt="", prompt_len=1, expected_output_len=max_tokens, chat_messages=chat)
        for chat in chats
    ]
    result = await benchmark(
        task_type=TaskType.GENERATION,
        endpoint_type="openai-chat",
        api_url=f"{url}/chat/completions",
        base_url=url.removesuffix("/v1"),
        model_id=model,
        model_name=model,
        tokenizer=None,
        input_requests=requests,
        logprobs=None,
        request_rate=float("inf"),
        burstiness=1.0,
        disable_tqdm=True,
        num_warmups=0,
        profile=False,
        selected_percentile_metrics=[],
        selected_percentiles=[],
        ignore_eos=False,
        goodput_config_dict={},
        max_concurrency=in_flight,
        lora_modules=None,
        extra_headers=None,
        extra_body=SAMPLING,
        ready_check_timeout_sec=0,
    )
    assert result["completed"] == len(chats), result["errors"][:3]
    return [result["request_throughput"], result["output_throughput"]]


async def by_bare_requests(
    chats: Chats, url: str, model: str, in_flight: int, max_tokens: int
) -> Any:
    waiting, tokens = iter(chats), 0

    async def lane(session: aiohttp.ClientSession) -> None:
        nonlocal tokens
        for chat in waiting:
            body = {"model": model, "messages": chat, "max_tokens": max_tokens, **SAMPLING}
            async with session.post(f"{url}/chat/completions", json=body) as response:
                tokens += (await response.json())["usage"]["completion_tokens"]

    since = time.perf_counter()
    connector = aiohttp.TCPConnector(limit=in_flight)
    async with aiohttp.ClientSession(connector=connector) as session:
        await asyncio.gather(*(lane(session) for _ in range(in_flight)))
    took = time.perf_counter() - since
    return [len(chats) / took, tokens / took]


if __name__ == "__main__":
    path, url, model, *numbers = sys.argv[1:]
    chats = json.loads(Path(path).read_text())
    for _ in sys.stdin:
        with redirect_stdout(sys.stderr):
            found = {
                name: asyncio.run(run(chats, url, model, *map(int, numbers)))
                for name, run in (("vllm", by_vllm), ("bare", by_bare_requests))
            }
        print(json.dumps(found), flush=True)
