"""Run by vLLM's own Python: the token ids that its engine is given for a prompt with media.

    python vllm_prompt.py MODEL CONVERSATION.npz

The conversation is its text with a placeholder for each medium, the clip's pixels and metadata, and
the images' pixels. It is taken the way a request takes: through the model's multi-modal processor.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from PIL import Image
from vllm.config import ModelConfig, VllmConfig, set_current_vllm_config
from vllm.multimodal import MULTIMODAL_REGISTRY


def main(model: str, path: str) -> None:
    with np.load(path) as told:
        text, metadata = str(told["text"]), json.loads(str(told["metadata"]))
        media = {"image": [Image.fromarray(pixels) for pixels in told["images"]]}
        if metadata is not None:
            media["video"] = [(told["clip"], metadata)]
    config = ModelConfig(model, limit_mm_per_prompt={"image": 4, "video": 1})
    with set_current_vllm_config(VllmConfig(model_config=config)):
        processor = MULTIMODAL_REGISTRY.create_processor(config)
        items = processor.info.parse_mm_data(media)
        print(json.dumps(processor(text, items)["prompt_token_ids"]))


if __name__ == "__main__":
    main(*sys.argv[1:])
