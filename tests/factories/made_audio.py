"""A tiny Stable Audio with random weights, saved in a folder as the hub's are."""

import warnings
from pathlib import Path
from typing import Any

import torch

RATE = 8000.0
"""Of its waveforms, Hz."""
FRAMES, STRIDES, DIM = 512, [2, 4], 8
"""It works at 512 frames of 8 samples, .512 s."""


def tiny_pipeline() -> Any:
    """Return the pipeline; the same weights every time."""
    import transformers

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import diffusers
        from diffusers import StableAudioPipeline

    torch.manual_seed(0)
    words = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("▁", -2.0)]
    words += [(letter, -3.0) for letter in "abcdefghijklmnopqrstuvwxyz"]
    tokenizer = transformers.T5Tokenizer(vocab=words, extra_ids=0, model_max_length=16)
    text_encoder = transformers.T5EncoderModel(
        transformers.T5Config(vocab_size=40, d_model=16, d_kv=8, d_ff=16, num_layers=1, num_heads=2)
    )
    vae = {"encoder_hidden_size": DIM, "downsampling_ratios": STRIDES, "audio_channels": 2, "sampling_rate": int(RATE)}
    vae |= {"decoder_channels": DIM, "decoder_input_channels": DIM // 2, "channel_multiples": [1, 2]}
    dit = {"sample_size": FRAMES, "in_channels": DIM // 2, "out_channels": DIM // 2, "num_layers": 1}
    dit |= {"attention_head_dim": 8, "num_attention_heads": 2, "num_key_value_attention_heads": 1, "time_proj_dim": 8}
    dit |= {"cross_attention_dim": 16, "global_states_input_dim": 32, "cross_attention_input_dim": 16}
    return StableAudioPipeline(
        vae=diffusers.AutoencoderOobleck(**vae),
        text_encoder=text_encoder,
        projection_model=diffusers.StableAudioProjectionModel(
            text_encoder_dim=16, conditioning_dim=16, min_value=0, max_value=32
        ),
        tokenizer=tokenizer,
        transformer=diffusers.StableAudioDiTModel(**dit),
        scheduler=diffusers.CosineDPMSolverMultistepScheduler(),
    )


def save_audio(folder: Path) -> Path:
    """Save the pipeline and return its folder."""
    tiny_pipeline().save_pretrained(folder)
    return folder
