"""What people found in the source and no search finds: expressions to try before searching. They must explain every sample as well.

A width that several keys move at once, or a rule with more cases than a search visits, costs a class all its budget."""

# Tried for every class: what heads and embeddings are often as wide as, when many other keys change with it.
ANY = (
    "c.vocab_size",
    "c.num_labels",
    "c.xvector_output_dim",
    "c.num_hidden_layers + 1",
    "c.src_vocab_size",
    "c.tgt_vocab_size",
)
SAM = (  # SamVisionLayer: no window in the layers named, and in none when window_size is 0
    "i in c.{0}global_attn_indexes || c.{0}window_size == 0 ? 2 * (c.{0}image_size / c.{0}patch_size) - 1 : 2 * c.{0}window_size - 1",
)
AST = (  # ASTEmbeddings.get_shape
    "((c.num_mel_bins - c.patch_size) / c.frequency_stride + 1) * ((c.max_length - c.patch_size) / c.time_stride + 1) + 2",
)
BY_TYPE = {
    "sam": [t.format("vision_config.") for t in SAM],
    "sam_vision_model": [t.format("") for t in SAM],
    "sam_hq": [t.format("vision_config.") for t in SAM],
    "sam_hq_vision_model": [t.format("") for t in SAM],
    "siglip2_vision_model": ["c.num_patches", "isqrt(c.num_patches) * isqrt(c.num_patches)"],
    "audio-spectrogram-transformer": AST,
    "gpt_bigcode": ["c.multi_query == true ? c.n_embd + 2 * (c.n_embd / c.n_head) : 3 * c.n_embd"],
    "idefics2": ["c.perceiver_config.num_key_value_heads * c.perceiver_config.resampler_head_dim"],
}


def expressions(model_type, targets):
    """Candidates, the special ones first; a coincidence is likely where there are few different values."""
    out = list(BY_TYPE.get(model_type, ()))
    return out + list(ANY) if len(set(targets)) > 3 else out
