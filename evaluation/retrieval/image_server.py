"""Texts become images, drawn by servers and kept as files, so that nothing is drawn twice.

store/<name>/drawn/<key>/
    about.json          what all of them were drawn by; the key is its hash
    <text's hash>.png   written whole or not at all, as the server gave it
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import io
import json
from collections.abc import Iterable
from pathlib import Path

from PIL import Image
from tqdm import tqdm

from conf.errors import UserError
from conf.runs import write_json
from conf.schema import ImageServerConfig
from data.store import Store, write_atomically
from teacher.servers.concurrency import run_limited
from teacher.servers.pool import NoResponseError, ServerPool
from teacher.servers.responses import Response
from teacher.servers.server import Messages, RequestFields, Server

DRAWN = "drawn"
"""Folder of them in a store."""
CANARY = "A gray sphere on a plain floor."
"""What any server of images can draw."""
SHOWN = 80
"""Characters of a text that an error shows."""


def draw(cfg: ImageServerConfig, texts: Iterable[str], store: Store) -> dict[str, Path]:
    """The image of each text; those that are there and whole are not drawn again.

    Raises:
        UserError: no server can be asked, or there is no image of a text though there is of others.
    """
    about = {"model": cfg.model, "size": cfg.size, "seed": cfg.seed}
    folder = store.folder / DRAWN / short_hash(json.dumps(about, sort_keys=True))
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "about.json", about)
    images = {text: folder / f"{short_hash(text)}.png" for text in texts}
    waiting = [text for text, path in images.items() if not is_image(path)]
    if waiting:
        asyncio.run(_draw(cfg, waiting, images))
    return images


def short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_image(source: Path | io.BytesIO) -> bool:
    """Whether an image can be read whole; one that cannot is drawn again."""
    try:
        with Image.open(source) as image:
            image.load()
        return True
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return False


async def _draw(cfg: ImageServerConfig, waiting: list[str], images: dict[str, Path]) -> None:
    with tqdm(total=len(images), initial=len(images) - len(waiting), desc="drawing") as bar:
        async with ServerPool(cfg, {}, _chat(CANARY), ImageServer) as client:

            async def one(text: str) -> None:
                try:
                    [reply] = await client.complete(_chat(text))
                except NoResponseError as fault:
                    raise UserError(
                        f"{cfg.model} has no image of {text[:SHOWN]!r} ({fault}); once that is "
                        "mended, run the same command again, it goes on with what is drawn"
                    ) from fault
                write_atomically(images[text], base64.b64decode(reply.text))
                bar.update()

            await run_limited(waiting, cfg.concurrency, one)


def _chat(text: str) -> Messages:
    return [{"role": "user", "content": text}]


class ImageServer(Server):
    """A server that draws what the one message of a chat says; a reply is an image in base64."""

    cfg: ImageServerConfig

    async def _send(self, chat: Messages, n: int, request: RequestFields) -> list[Response]:
        drawn = await self.client.images.generate(
            model=self.cfg.model,
            prompt=chat[0]["content"],
            n=n,
            size=self.cfg.size,
            response_format="b64_json",
            # The API itself knows of no seed; servers of open models do.
            extra_body={"seed": self.cfg.seed},
        )
        replies = [Response(image.b64_json) for image in drawn.data[:n]]
        for reply in replies:
            if not is_image(io.BytesIO(base64.b64decode(reply.text, validate=True))):
                raise ValueError("what it gives is no image that can be decoded")
        if not replies:
            raise ValueError("it gives no image")
        return replies

    async def _unknown_model_error(self) -> UserError:
        return UserError(
            f"{self.url} draws nothing as images.model={self.cfg.model}: it has no such model, or "
            "is no server of images (/v1/images/generations); vLLM-Omni is one that is"
        )
