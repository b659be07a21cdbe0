"""Serves a model of `tiny_qwen3` with llama.cpp. Arguments: its folder, a port, the number of slots
(requests that are answered at the same time)."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from threading import Event

CONTEXT = 4096
"""Maximum number of tokens of a slot."""


def write_gguf(folder: Path) -> Path:
    """Convert a saved Qwen3 to llama.cpp's file format, and return the file."""
    import gguf
    from safetensors.torch import load_file

    config, tokenizer, special = (
        json.loads((folder / name).read_text())
        for name in ("config.json", "tokenizer.json", "tokenizer_config.json")
    )
    path = folder / "model.gguf"
    writer = gguf.GGUFWriter(path, "qwen3")
    writer.add_context_length(config["max_position_embeddings"])
    writer.add_embedding_length(config["hidden_size"])
    writer.add_feed_forward_length(config["intermediate_size"])
    writer.add_block_count(config["num_hidden_layers"])
    writer.add_head_count(config["num_attention_heads"])
    writer.add_head_count_kv(config["num_key_value_heads"])
    writer.add_key_length(config["head_dim"])
    writer.add_value_length(config["head_dim"])
    writer.add_layer_norm_rms_eps(config["rms_norm_eps"])
    writer.add_rope_freq_base(config["rope_parameters"]["rope_theta"])
    added = {token["content"]: token["id"] for token in tokenizer["added_tokens"]}
    ids = {**tokenizer["model"]["vocab"], **added}
    words = sorted(ids, key=ids.__getitem__)
    control, normal = gguf.TokenType.CONTROL, gguf.TokenType.NORMAL
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre("gpt-2")
    writer.add_token_list(words)
    writer.add_token_types([control if word in added else normal for word in words])
    writer.add_token_merges([" ".join(pair) for pair in tokenizer["model"]["merges"]])
    writer.add_eos_token_id(ids[special["eos_token"]])
    writer.add_add_bos_token(False)
    writer.add_chat_template((folder / "chat_template.jinja").read_text())
    names = gguf.get_tensor_name_map(gguf.MODEL_ARCH.QWEN3, config["num_hidden_layers"])
    for name, tensor in load_file(folder / "model.safetensors").items():
        writer.add_tensor(names.get_name(name, (".weight",)), tensor.float().numpy())
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return path


def main(folder: str, port: str, slots: str) -> None:
    import xllamacpp

    parameters = xllamacpp.CommonParams()
    parameters.model.path = str(write_gguf(Path(folder)))
    parameters.model_alias = {"tiny"}
    parameters.port, parameters.n_parallel = int(port), int(slots)
    parameters.n_ctx = CONTEXT * int(slots)
    parameters.cpuparams.n_threads = parameters.cpuparams_batch.n_threads = 1
    server = xllamacpp.Server(parameters)
    print(server.listening_address, flush=True)
    Event().wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
