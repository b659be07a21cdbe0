"""Print the token ids of a prompt with media in vLLM's engine. vLLM's own Python runs this.

    python vllm_prompt.py MODEL CONVERSATION.npz

The conversation is its text with a placeholder for each medium, the clip's pixels and metadata, and
the images' pixels. It passes the model's multi-modal processor, as a request does.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from PIL import Image
from vllm.config import ModelConfig, VllmConfig, set_current_vllm_config
from vllm.multimodal import MULTIMODAL_REGISTRY


def main(model: str, path: str) -> None:
    with np.load(path) as conversation:
        text, metadata = str(conversation["text"]), json.loads(str(conversation["metadata"]))
        media = {"image": [Image.fromarray(pixels) for pixels in conversation["images"]]}
        if metadata is not None:
            media["video"] = [(conversation["clip"], metadata)]
    config = ModelConfig(model, limit_mm_per_prompt={"image": 4, "video": 1})
    with set_current_vllm_config(VllmConfig(model_config=config)):
        processor = MULTIMODAL_REGISTRY.create_processor(config)
        items = processor.info.parse_mm_data(media)
        print(json.dumps(processor(text, items)["prompt_token_ids"]))


if __name__ == "__main__":
    main(*sys.argv[1:])
