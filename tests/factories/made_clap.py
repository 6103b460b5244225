"""A tiny CLAP model with random weights, saved in a folder as the hub's are."""

import json
from pathlib import Path

import torch

RATE = 48000.0
SECONDS = 1
"""The longest clip that it hears."""


def save_clap(folder: Path, *, seed: int = 0, fused: bool = False) -> None:
    from transformers import ClapConfig, ClapFeatureExtractor, ClapModel, ClapProcessor, RobertaTokenizer

    folder.mkdir(parents=True, exist_ok=True)
    tokens = ["<s>", "<pad>", "</s>", "<unk>", "<mask>", "Ġ", *map(chr, range(33, 127))]
    vocabulary = {token: number for number, token in enumerate(tokens)}
    try:
        tokenizer = RobertaTokenizer(vocab=vocabulary, merges=[], model_max_length=40)
    except TypeError:  # before transformers 5 a tokenizer was made of files
        (folder / "vocab.json").write_text(json.dumps(vocabulary), encoding="utf-8")
        (folder / "merges.txt").write_text("#version: 0.2\n", encoding="utf-8")
        tokenizer = RobertaTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=40)
    extractor = ClapFeatureExtractor(max_length_s=SECONDS, truncation="fusion" if fused else "rand_trunc")
    text = {"vocab_size": len(tokens), "hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    text |= {"intermediate_size": 16, "max_position_embeddings": 64}
    audio = {"window_size": 4, "spec_size": 128, "patch_embeds_hidden_size": 8, "depths": [1, 1], "hidden_size": 16}
    audio |= {"num_attention_heads": [1, 2], "num_hidden_layers": 2}
    audio |= {"enable_fusion": fused, "fusion_num_hidden_layers": 2}
    config = ClapConfig(text_config=text, audio_config=audio, projection_dim=12)
    torch.manual_seed(seed)
    model = ClapModel(config)
    with torch.no_grad():
        # As they are drawn, every sound and every prompt would look alike.
        for parameter in model.parameters():
            parameter.mul_(8.0) if parameter.ndim > 1 else parameter.add_(0.05 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    ClapProcessor(feature_extractor=extractor, tokenizer=tokenizer).save_pretrained(folder)
