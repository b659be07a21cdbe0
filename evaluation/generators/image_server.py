"""Images of texts from servers of a text-to-image model, kept as files.

store/<name>/generated_images/<key>/
    about.json          the model and its settings; the key is their hash
    <hash>.png          the image of the text with this hash, as the server sent it
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
from teacher.servers.pool import NoResponseError, ServerPool, run_limited
from teacher.servers.responses import Response
from teacher.servers.server import Messages, RequestFields, Server

FOLDER = "generated_images"
CANARY = "A gray sphere on a plain floor."


class ImageGenerator:
    """Generates images of texts on the servers of `cfg`, once each."""

    def __init__(self, cfg: ImageServerConfig, store: Store) -> None:
        self._cfg = cfg
        about = {"model": cfg.model, "size": cfg.size, "seed": cfg.seed}
        self._folder = store.folder / FOLDER / short_hash(json.dumps(about, sort_keys=True))
        self._folder.mkdir(parents=True, exist_ok=True)
        write_json(self._folder / "about.json", about)

    def respond(self, texts: Iterable[str]) -> dict[str, Path]:
        """Return the image file of each text; intact files are not generated again.

        Raises:
            UserError: No server responds, or a single text has no image.
        """
        images = {text: self._folder / f"{short_hash(text)}.png" for text in texts}
        missing = [text for text, path in images.items() if not is_image(path)]
        if missing:
            asyncio.run(self._generate(missing, images))
        return images

    async def _generate(self, missing: list[str], images: dict[str, Path]) -> None:
        done = len(images) - len(missing)
        with tqdm(total=len(images), initial=done, desc="generating", unit="image") as bar:
            async with ServerPool(self._cfg, {}, _messages(CANARY), ImageServer) as pool:

                async def respond(text: str) -> None:
                    try:
                        [response] = await pool.complete(_messages(text))
                    except NoResponseError as error:
                        raise UserError(
                            f"{self._cfg.model} has no image of {text[:80]!r} ({error}): correct "
                            "that and run the same command again; it resumes after the images "
                            f"in {self._folder}",
                            code="no-response",
                        ) from error
                    write_atomically(images[text], base64.b64decode(response.text))
                    bar.update()

                await run_limited(missing, self._cfg.concurrency, respond)


class ImageServer(Server):
    """A server that generates an image of a single message; its response is base64."""

    cfg: ImageServerConfig

    async def _send(self, messages: Messages, n: int, fields: RequestFields) -> list[Response]:
        result = await self.client.images.generate(
            model=self.cfg.model,
            prompt=messages[0]["content"],
            n=n,
            size=self.cfg.size,
            response_format="b64_json",
            # OpenAI's API has no seed; servers of open models accept one.
            extra_body={"seed": self.cfg.seed},
        )
        images = [image.b64_json for image in result.data[:n]]
        if not images or not all(
            is_image(io.BytesIO(base64.b64decode(image, validate=True))) for image in images
        ):
            raise ValueError("the response holds no image that can be decoded")
        return [Response(image) for image in images]

    async def _unknown_model_error(self) -> UserError:
        return UserError(
            f"{self.url} generates no images with images.model={self.cfg.model}: it lacks that "
            "model, or does not serve /v1/images/generations, as vLLM-Omni does",
            code="unknown-model",
        )


def short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_image(source: Path | io.BytesIO) -> bool:
    """Return whether an image exists and can be decoded."""
    try:
        with Image.open(source) as image:
            image.load()
        return True
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return False


def _messages(text: str) -> Messages:
    return [{"role": "user", "content": text}]
