"""Read the responses and scores in the logs of evaluation harnesses."""

from __future__ import annotations

import json
import os
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import pyarrow as pa

from dynapix.conf.errors import UserError
from dynapix.models.student.responses import GeneratedText

ZSTANDARD, LOCAL_HEADER = 93, 30
"""Zip files: the number of a compression that Python reads from 3.14 on; bytes before a name."""


@dataclass(frozen=True)
class Log:
    """A model's responses by item id."""

    model: str
    responses: dict[str, GeneratedText]


@contextmanager
def name_damage(path: Path, kind: str) -> Iterator[None]:
    """Name a file or a folder that the block cannot read.

    Args:
        kind: What should be there, such as "a log of inspect eval".

    Raises:
        UserError: It is missing, something else, or damaged.
    """
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError, AttributeError, BadZipFile) as error:
        raise UserError(
            f"{path} is not {kind}, or it is damaged: {error}", code="damaged-file"
        ) from error


def read_inspect(path: Path) -> Log:
    """Read a log of `inspect eval`, a file *.eval or *.json.

    Raises:
        UserError: The file is not such a log, its evaluation did not finish, or it asked items
            several times.
    """
    with name_damage(path, "a log of inspect eval"):
        if zipfile.is_zipfile(path):
            header, samples = _read_archive(path)
        else:
            header = json.loads(path.read_text())
            samples = header["samples"]
        status, model = header["status"], header["eval"]["model"]
        rows = [(s["id"], s["epoch"], s["output"]) for s in samples]
        responses = {name: _read_output(output) for name, _, output in rows}
    if status != "success":
        raise UserError(
            f"{path}: the evaluation has the status {status}: finish it with inspect eval-retry",
            code="unfinished-run",
        )
    if any(epoch > 1 for _, epoch, _ in rows):
        raise UserError(
            f"{path} has several epochs: evaluate again with --epochs 1", code="repeated-items"
        )
    return Log(model, responses)


def _read_archive(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    with zipfile.ZipFile(path) as archive, open(path, "rb") as file:

        def read(info: zipfile.ZipInfo) -> dict[str, Any]:
            if info.compress_type != ZSTANDARD:
                return json.loads(archive.read(info))
            file.seek(info.header_offset)
            # The local header ends with the lengths of the name and of further fields.
            lengths = struct.unpack("<26x2H", file.read(LOCAL_HEADER))
            file.seek(sum(lengths), os.SEEK_CUR)
            packed = file.read(info.compress_size)
            return json.loads(pa.decompress(packed, info.file_size, "zstd", asbytes=True))

        infos = archive.infolist()
        samples = [read(info) for info in infos if info.filename.startswith("samples/")]
        return read(archive.getinfo("header.json")), samples


def _read_output(output: dict[str, Any]) -> GeneratedText:
    choice = output["choices"][0]
    content = choice["message"]["content"]
    if not isinstance(content, str):
        content = "".join(part["text"] for part in content if part["type"] == "text")
    return GeneratedText(content, choice["stop_reason"] == "max_tokens")


def read_lmms_eval(path: Path) -> Log:
    """Read a log of lmms-eval with `--log_samples`, a file *_samples_dynapix_selection.jsonl.

    Raises:
        UserError: The file is not such a log.
    """
    responses = {}
    with name_damage(path, "a log of lmms-eval's samples"):
        for line in path.read_text().splitlines():
            row = json.loads(line)
            # The task writes the id before the question.
            item_id, text = row["input"].partition(": ")[0], row["filtered_resps"]
            responses[item_id] = GeneratedText(text if isinstance(text, str) else text[0])
    return Log(path.parent.name, responses)


def read_mteb(path: Path) -> tuple[str, dict[str, dict[str, float]]]:
    """Read the predictions that MTEB saves of the task DynaPixRetrieval, a file
    *_predictions.json. Return the model, and the score of each frame by the query's id.

    Raises:
        UserError: The file does not contain such predictions.
    """
    with name_damage(path, "a file of MTEB's predictions"):
        log = json.loads(path.read_text())
        [scores] = log["default"].values()
        for frames in scores.values():
            frames.items()
        return str(log["mteb_model_meta"]["model_name"]), scores
