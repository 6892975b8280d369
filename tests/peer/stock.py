"""Tiny models as save_pretrained writes them, for surgery.py: hosts, which see and speak, guests, which speak, and towers.

Every tokenizer is a real one, trained on a few words: SentencePiece for the families that have it, byte-level BPE for others.
Every parameter is drawn, norms and biases too, so that no two tensors have the same bytes. Host and guest of a pair have the
same width, or the guest has WIDE.
"""

import inspect
import json
import random
import shutil
import tempfile
from pathlib import Path

from peer import doctor, tiny_sentencepiece, write_holes

WIDTH, WIDE = 32, 48
HEADS, KEYS, LAYERS = 4, 2, 2
SIDE, PATCH = 28, 14  # of an image and a patch, in pixels; some hosts need twice the side
TOKENS = (SIDE // PATCH) ** 2  # of an image
WORDS = "pick place cup spoon move the red green left right robot arm should take what drawer open near on in".split()
DTYPES = {"f32": "float32", "bf16": "bfloat16", "f16": "float16"}


# Tokenizers.

TEXT_TEMPLATE = (
    "{% for message in messages %}{{ '[' + message['role'] + '] ' + message['content'] + '\\n' }}{% endfor %}"
    "{% if add_generation_prompt %}[assistant] {% endif %}"
)


def sentences():
    rng = random.Random(7)
    return [" ".join(rng.choices(WORDS, k=rng.randint(4, 10))) + "." for _ in range(2000)]


def byte_level(size, start=()):
    """A byte-level BPE as GPT-2, Llama 3 and Qwen have it."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

    core = Tokenizer(models.BPE())
    core.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    core.decoder = decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    core.train_from_iterator(sentences(), trainers.BpeTrainer(vocab_size=size, initial_alphabet=alphabet, show_progress=False))
    core.add_special_tokens(list(start))
    return core


def of_files(cls, work, vocab_file, merges_file=None, **more):
    """A tokenizer from the files of its class, which from version 5 on only from_pretrained reads."""
    import transformers

    files = {"vocab_file": vocab_file} | ({"merges_file": merges_file} if merges_file else {})
    if transformers.__version__.startswith("4"):
        return cls(**{key: str(path) for key, path in files.items()}, **more)
    with tempfile.TemporaryDirectory(dir=work) as folder:
        for key, path in files.items():
            shutil.copy(path, Path(folder) / cls.vocab_files_names.get(key, Path(path).name))
        return cls.from_pretrained(folder, **more)


def llama(work, pad=None, more=()):
    from transformers import LlamaTokenizerFast

    model = tiny_sentencepiece(work, "llama", 340, unk_id=0, bos_id=1, eos_id=2, pad_id=-1)
    tokenizer = of_files(LlamaTokenizerFast, work, model, add_prefix_space=True, **({"pad_token": pad} if pad else {}))
    tokenizer.add_special_tokens({"additional_special_tokens": list(more)}) if more else None
    return tokenizer


def gemma(work, more=()):
    from transformers import GemmaTokenizerFast

    pieces = dict(
        pad_id=0, eos_id=1, bos_id=2, unk_id=3, pad_piece="<pad>", eos_piece="<eos>", bos_piece="<bos>", unk_piece="<unk>"
    )
    model = tiny_sentencepiece(work, "gemma", 400, add_dummy_prefix=False, user_defined_symbols=["<mask>", *more], **pieces)
    return of_files(GemmaTokenizerFast, work, model)


def llama3(work):
    from tokenizers import processors
    from transformers import PreTrainedTokenizerFast

    core = byte_level(380, ["<|begin_of_text|>", "<|end_of_text|>", "<|finetune_right_pad_id|>", "<|eot_id|>"])
    begin = core.token_to_id("<|begin_of_text|>")
    core.post_processor = processors.TemplateProcessing(
        single="<|begin_of_text|> $A",
        pair="<|begin_of_text|> $A <|begin_of_text|> $B",
        special_tokens=[("<|begin_of_text|>", begin)],
    )
    return PreTrainedTokenizerFast(
        tokenizer_object=core,
        bos_token="<|begin_of_text|>",
        eos_token="<|end_of_text|>",
        model_max_length=512,
        clean_up_tokenization_spaces=True,
        model_input_names=["input_ids", "attention_mask"],
    )


def qwen2(work, more=()):
    from transformers import Qwen2TokenizerFast

    core = byte_level(370)
    vocabulary, merges = work / "vocab.json", work / "merges.txt"
    model = json.loads(core.to_str())["model"]
    vocabulary.write_text(json.dumps(model["vocab"]))
    merges.write_text(
        "#version: 0.2\n" + "".join(" ".join(m) + "\n" if isinstance(m, list) else m + "\n" for m in model["merges"])
    )
    tokenizer = of_files(Qwen2TokenizerFast, work, vocabulary, merges, bos_token=None)
    tokenizer.add_special_tokens({"additional_special_tokens": ["<|im_start|>", "<|im_end|>", *more]})
    return tokenizer


def smollm(work):
    from transformers import GPT2TokenizerFast

    core = byte_level(370, ["<|endoftext|>", "<|im_start|>", "<|im_end|>"])
    return GPT2TokenizerFast(
        tokenizer_object=core,
        bos_token="<|im_start|>",
        eos_token="<|im_end|>",
        unk_token="<|endoftext|>",
        pad_token="<|im_end|>",
    )


def named(tokenizer, **tokens):
    """Adds special tokens that a processor finds by an attribute of the tokenizer, as published tokenizers have them."""
    # Transformers 5 has another name for the list.
    known = getattr(tokenizer, "additional_special_tokens", None) or getattr(tokenizer, "extra_special_tokens", [])
    tokenizer.add_special_tokens({"additional_special_tokens": [*known, *tokens.values()]})
    if hasattr(tokenizer, "additional_special_tokens"):
        tokenizer.extra_special_tokens = tokens
    tokenizer._set_model_specific_special_tokens(special_tokens=tokens)
    return tokenizer


# Guests: configs of language models, by model type.


# Families with a byte-level tokenizer, for which that of Llama 3 stands.
BYTE_LEVEL = ("granite", "cohere", "cohere2", "olmo2", "smollm3", "falcon", "glm4", "qwen3_moe")


def guest_tokenizer(kind, work):
    make = {
        "llama": lambda: llama(work),
        "llama3": lambda: llama3(work),
        "mistral": lambda: llama(work),
        "mixtral": lambda: llama(work),
        "qwen2": lambda: qwen2(work),
        "qwen3": lambda: qwen2(work, ["<think>", "</think>"]),
        "phi3": lambda: llama(work, more=["<|endoftext|>", "<|assistant|>", "<|end|>", "<|user|>"]),
        **dict.fromkeys(BYTE_LEVEL, lambda: llama3(work)),
        "gemma": lambda: gemma(work),
        "gemma2": lambda: gemma(work),
        "gemma3_text": lambda: gemma(work, ["<start_of_image>", "<end_of_image>"]),
    }
    return make[kind]()


def text_config(kind, width, tokenizer):
    """Keys of a config; the vocabulary has more rows than tokens where published models have."""
    ids = {f"{end}_token_id": getattr(tokenizer, f"{end}_token_id") for end in ("bos", "eos", "pad")}
    rows = len(tokenizer) if kind not in ("qwen2", "qwen3", "phi3") else -(-len(tokenizer) // 32) * 32
    config = dict(
        vocab_size=rows,
        hidden_size=width,
        intermediate_size=2 * width,
        num_hidden_layers=LAYERS,
        num_attention_heads=HEADS,
        num_key_value_heads=KEYS,
        max_position_embeddings=512,
        rms_norm_eps=1e-5,
        **ids,
    )
    if kind.startswith(("gemma", "qwen3")):
        config["head_dim"] = 16
    if kind in ("gemma2", "gemma3_text"):
        config |= dict(query_pre_attn_scalar=16, sliding_window=64)
    if kind == "granite":
        config |= dict(logits_scaling=8.0, embedding_multiplier=12.0, attention_multiplier=0.25, residual_multiplier=0.5)
    if kind.startswith("cohere"):
        config |= dict(logit_scale=0.25, layer_norm_eps=1e-5)
    if kind == "glm4":
        config["head_dim"] = width // HEADS
    if kind == "mixtral":
        config |= dict(num_local_experts=4, num_experts_per_tok=2)
    if kind == "qwen3_moe":
        config |= dict(
            num_experts=4, num_experts_per_tok=2, moe_intermediate_size=32, decoder_sparse_step=1, norm_topk_prob=True
        )
    if kind == "falcon":
        config |= dict(new_decoder_architecture=True, num_kv_heads=KEYS, bias=False, ffn_hidden_size=2 * width)
    if kind == "phi3":
        config |= dict(original_max_position_embeddings=512, sliding_window=64)
    return config


GUESTS = {
    "llama": "Llama", "llama3": "Llama", "mistral": "Mistral", "qwen2": "Qwen2", "qwen3": "Qwen3", "phi3": "Phi3", "gemma2": "Gemma2",
    "gemma3_text": "Gemma3", "granite": "Granite",
    "cohere": "Cohere", "cohere2": "Cohere2", "olmo2": "Olmo2", "smollm3": "SmolLM3", "falcon": "Falcon", "mixtral": "Mixtral",
    "qwen3_moe": "Qwen3Moe", "glm4": "Glm4",
}  # fmt: skip


def save_guest(kind, width, dtype, path, work):
    import transformers

    tokenizer = guest_tokenizer(kind, work)
    name = GUESTS[kind]
    config = getattr(transformers, {"gemma3_text": "Gemma3TextConfig"}.get(kind, f"{name}Config"))(
        **text_config(kind, width, tokenizer)
    )
    save_model(getattr(transformers, f"{name}ForCausalLM")(config), dtype, path)
    # Templates of language models take text alone.
    tokenizer.chat_template = TEXT_TEMPLATE
    tokenizer.save_pretrained(path)


def save_model(model, dtype, path):
    import torch

    torch.manual_seed(sum(map(ord, str(path.name))))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.rand_like(parameter) * 0.05 - 0.025)
    model.to(getattr(torch, DTYPES[dtype])).save_pretrained(path, safe_serialization=True)


# Hosts. Each function returns the class of the model, its config without `text_config`, the processor, and the kind of its
# language model.


def clip():
    return dict(
        model_type="clip_vision_model",
        hidden_size=32,
        intermediate_size=48,
        num_hidden_layers=2,
        num_attention_heads=4,
        image_size=SIDE,
        patch_size=PATCH,
        projection_dim=32,
    )


def siglip(side=SIDE, **more):
    return dict(
        model_type="siglip_vision_model",
        hidden_size=32,
        intermediate_size=48,
        num_hidden_layers=2,
        num_attention_heads=4,
        image_size=side,
        patch_size=PATCH,
        vision_use_head=False,
        **more,
    )


def clip_images():
    from transformers import CLIPImageProcessor

    return CLIPImageProcessor(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE})


def llava(work):
    from transformers import LlavaProcessor

    tokenizer = named(llama(work, pad="<unk>"), image_token="<image>")
    tokenizer.add_special_tokens({"pad_token": "<pad>"})
    processor = LlavaProcessor(
        clip_images(), tokenizer, patch_size=PATCH, vision_feature_select_strategy="default", num_additional_image_tokens=1
    )
    config = dict(
        vision_config=clip(),
        image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
        vision_feature_layer=-2,
        image_seq_length=TOKENS,
        pad_token_id=tokenizer.pad_token_id,
    )
    return "Llava", config, processor, "llama"


def llava_next(work):
    from transformers import LlavaNextImageProcessor, LlavaNextProcessor

    tokenizer = named(llama(work), image_token="<image>")
    tokenizer.add_special_tokens({"pad_token": "<pad>"})
    points = [[SIDE, 2 * SIDE], [2 * SIDE, SIDE], [2 * SIDE, 2 * SIDE]]
    images = LlavaNextImageProcessor(
        size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE}, image_grid_pinpoints=points
    )
    processor = LlavaNextProcessor(
        images, tokenizer, patch_size=PATCH, vision_feature_select_strategy="default", num_additional_image_tokens=1
    )
    config = dict(
        vision_config=clip(),
        image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
        image_grid_pinpoints=points,
        image_seq_length=TOKENS,
    )
    return "LlavaNext", config, processor, "mistral"


def llava_onevision(work):
    from transformers import LlavaOnevisionImageProcessor, LlavaOnevisionProcessor, LlavaOnevisionVideoProcessor

    tokenizer = named(qwen2(work), image_token="<image>", video_token="<video>")
    points = [[SIDE, SIDE], [SIDE, 2 * SIDE], [2 * SIDE, 2 * SIDE]]
    size = {"height": SIDE, "width": SIDE}
    processor = LlavaOnevisionProcessor(
        LlavaOnevisionImageProcessor(size=size, image_grid_pinpoints=points), tokenizer, LlavaOnevisionVideoProcessor(size=size),
        num_image_tokens=TOKENS, vision_feature_select_strategy="full",
    )  # fmt: skip
    config = dict(
        vision_config=siglip(), image_token_index=tokenizer.convert_tokens_to_ids("<image>"), video_token_index=tokenizer.convert_tokens_to_ids("<video>"),
        image_grid_pinpoints=points, vision_feature_layer=-1, vision_feature_select_strategy="full",
    )  # fmt: skip
    return "LlavaOnevision", config, processor, "qwen2"


def paligemma_of(kind):
    def make(work):
        from transformers import AddedToken, PaliGemmaProcessor, SiglipImageProcessor
        from transformers.models.paligemma.processing_paligemma import EXTRA_TOKENS

        tokenizer = gemma(work)
        tokenizer.add_tokens(EXTRA_TOKENS)
        tokenizer.add_special_tokens({"additional_special_tokens": [AddedToken("<image>", normalized=False, special=True)]})
        images = SiglipImageProcessor(size={"height": SIDE, "width": SIDE})
        images.image_seq_length = TOKENS
        config = dict(
            vision_config=siglip(projection_dim=WIDTH), projection_dim=WIDTH, hidden_size=WIDTH, vocab_size=len(tokenizer),
            image_token_index=tokenizer.convert_tokens_to_ids("<image>"), bos_token_id=2, eos_token_id=1, pad_token_id=0,
        )  # fmt: skip
        return "PaliGemma", config, PaliGemmaProcessor(images, tokenizer), kind

    return make


def splitting(kind):
    def make(work):
        import transformers

        classes = {"idefics3": "Idefics3", "smolvlm": "SmolVLM"}[kind]
        tokenizer = llama3(work) if kind == "idefics3" else smollm(work)
        if kind == "idefics3":
            tokenizer.pad_token = "<|finetune_right_pad_id|>"
        rows = [f"<row_{i}_col_{j}>" for i in (1, 2) for j in (1, 2)]
        tokenizer.add_special_tokens(
            {"additional_special_tokens": ["<fake_token_around_image>", "<image>", "<end_of_utterance>", "<global-img>", *rows]}
        )
        images = getattr(transformers, f"{classes}ImageProcessor")(
            size={"longest_edge": 4 * SIDE}, max_image_size={"longest_edge": 2 * SIDE}
        )
        parts = [images, tokenizer]
        if kind == "smolvlm":
            allow_without_num2words()
            parts.append(
                transformers.SmolVLMVideoProcessor(size={"longest_edge": 4 * SIDE}, max_image_size={"longest_edge": 2 * SIDE})
            )
        processor = getattr(transformers, f"{classes}Processor")(*parts, image_seq_len=TOKENS)
        vision = dict(
            hidden_size=32,
            intermediate_size=48,
            num_hidden_layers=2,
            num_attention_heads=4,
            image_size=2 * SIDE,
            patch_size=PATCH,
        )
        vision["model_type"] = {"idefics3": "idefics3", "smolvlm": "smolvlm_vision"}[kind]
        config = dict(
            vision_config=vision,
            image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
            scale_factor=2,
            pad_token_id=tokenizer.pad_token_id,
        )
        return classes, config, processor, "llama"

    return make


def allow_without_num2words():
    """SmolVLM's processor asks for a package that only videos need."""
    import importlib.util

    if importlib.util.find_spec("transformers.models.smolvlm"):
        from transformers.models.smolvlm import processing_smolvlm

        processing_smolvlm.num2words = processing_smolvlm.num2words or str


def qwen_vl(kind):
    def make(work):
        import transformers
        from transformers import Qwen2VLImageProcessor

        classes = {"qwen2_vl": "Qwen2VL", "qwen2_5_vl": "Qwen2_5_VL"}[kind]
        names = ["<|vision_start|>", "<|vision_end|>", "<|vision_pad|>", "<|image_pad|>", "<|video_pad|>"]
        tokenizer = qwen2(work, names)
        parts = [Qwen2VLImageProcessor(min_pixels=56 * 56, max_pixels=56 * 56), tokenizer]
        if hasattr(transformers, "Qwen2VLVideoProcessor"):
            parts.append(transformers.Qwen2VLVideoProcessor())
        vision = dict(
            depth=2, num_heads=4, in_channels=3, patch_size=PATCH, spatial_merge_size=2, temporal_patch_size=2, model_type=kind
        )
        vision |= (
            dict(embed_dim=32, hidden_size=WIDTH, mlp_ratio=2)
            if kind == "qwen2_vl"
            else dict(hidden_size=32, intermediate_size=48, out_hidden_size=WIDTH, fullatt_block_indexes=[1], window_size=112)
        )
        ids = {
            key: tokenizer.convert_tokens_to_ids(token)
            for key, token in zip(
                ("vision_start_token_id", "vision_end_token_id", "vision_token_id", "image_token_id", "video_token_id"), names
            )
        }
        config = dict(vision_config=vision, rope_scaling=dict(type="mrope", mrope_section=[2, 1, 1]), **ids)
        return classes, config, getattr(transformers, f"{classes}Processor")(*parts), "qwen2"

    return make


def qwen3_vl(work):
    import transformers
    from transformers import Qwen2VLImageProcessor

    names = ["<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>"]
    tokenizer = qwen2(work, names)
    images = Qwen2VLImageProcessor(min_pixels=56 * 56, max_pixels=56 * 56)
    vision = dict(
        depth=2, hidden_size=32, intermediate_size=48, num_heads=4, in_channels=3, patch_size=PATCH, spatial_merge_size=2,
        temporal_patch_size=2, out_hidden_size=WIDTH, num_position_embeddings=16, deepstack_visual_indexes=[0],
    )  # fmt: skip
    keys = ("vision_start_token_id", "vision_end_token_id", "image_token_id", "video_token_id")
    ids = {key: tokenizer.convert_tokens_to_ids(token) for key, token in zip(keys, names, strict=True)}
    processor = transformers.Qwen3VLProcessor(images, tokenizer, transformers.Qwen3VLVideoProcessor())
    return "Qwen3VL", dict(vision_config=vision, **ids), processor, "qwen3"


def glm4v(work):
    import transformers

    tokenizer = llama3(work)
    tokenizer.pad_token = "<|finetune_right_pad_id|>"
    names = dict(
        image_start="<|begin_of_image|>", image_end="<|end_of_image|>", video_start="<|begin_of_video|>", video_end="<|end_of_video|>",
        image="<|image|>", video="<|video|>",
    )  # fmt: skip
    tokenizer.add_special_tokens({"additional_special_tokens": list(names.values())})
    size = {"shortest_edge": 56 * 56, "longest_edge": 56 * 56 * 2}
    images, videos = transformers.Glm4vImageProcessor(size=size), transformers.Glm4vVideoProcessor()
    vision = dict(
        depth=2, hidden_size=32, num_heads=4, in_channels=3, image_size=2 * SIDE, patch_size=PATCH, spatial_merge_size=2, temporal_patch_size=2,
        out_hidden_size=WIDTH, intermediate_size=48,
    )  # fmt: skip
    ids = {f"{key}_token_id": tokenizer.convert_tokens_to_ids(token) for key, token in names.items()}
    return "Glm4v", dict(vision_config=vision, **ids), transformers.Glm4vProcessor(images, tokenizer, videos), "glm4"


def internvl(work):
    from transformers import GotOcr2ImageProcessor, InternVLProcessor, InternVLVideoProcessor

    names = dict(
        start_image_token="<img>", end_image_token="</img>", context_image_token="<IMG_CONTEXT>", video_token="<video>"
    )
    tokenizer = named(qwen2(work), **names)
    size = {"height": 2 * SIDE, "width": 2 * SIDE}
    processor = InternVLProcessor(
        GotOcr2ImageProcessor(size=size, crop_to_patches=False),
        tokenizer,
        InternVLVideoProcessor(size=size),
        image_seq_length=TOKENS,
    )
    vision = dict(
        model_type="internvl_vision", hidden_size=32, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4, image_size=[2 * SIDE] * 2,
        patch_size=[PATCH] * 2, norm_type="layer_norm", use_mean_pooling=True, use_absolute_position_embeddings=True,
    )  # fmt: skip
    config = dict(
        vision_config=vision,
        image_token_id=tokenizer.convert_tokens_to_ids("<IMG_CONTEXT>"),
        image_seq_length=TOKENS,
        downsample_ratio=0.5,
    )
    return "InternVL", config, processor, "qwen2"


def gemma3(work):
    from transformers import Gemma3ImageProcessor, Gemma3Processor

    tokenizer = gemma(work, ["<start_of_image>", "<end_of_image>"])
    names = dict(boi_token="<start_of_image>", eoi_token="<end_of_image>", image_token="<image_soft_token>")
    tokenizer = named(tokenizer, **names)
    images = Gemma3ImageProcessor(size={"height": 2 * SIDE, "width": 2 * SIDE}, image_seq_length=TOKENS)
    ids = {f"{key}_token_index": tokenizer.convert_tokens_to_ids(names[f"{key}_token"]) for key in ("boi", "eoi", "image")}
    config = dict(vision_config=siglip(2 * SIDE), mm_tokens_per_image=TOKENS, **ids)
    return "Gemma3", config, Gemma3Processor(images, tokenizer, image_seq_length=TOKENS), "gemma3_text"


def mistral3(work):
    from transformers import PixtralImageProcessor, PixtralProcessor

    tokenizer = llama(work)
    tokenizer.add_special_tokens({"pad_token": "<pad>", "additional_special_tokens": ["[IMG]", "[IMG_BREAK]", "[IMG_END]"]})
    images = PixtralImageProcessor(size={"longest_edge": 2 * SIDE}, patch_size={"height": PATCH, "width": PATCH})
    more = {"spatial_merge_size": 2} if "spatial_merge_size" in inspect.signature(PixtralProcessor).parameters else {}
    processor = PixtralProcessor(images, tokenizer, patch_size=PATCH, **more)
    tower = dict(
        model_type="pixtral", hidden_size=32, intermediate_size=48, num_hidden_layers=2, num_attention_heads=2, image_size=2 * SIDE, patch_size=PATCH
    )  # fmt: skip
    image = tokenizer.convert_tokens_to_ids("[IMG]")
    config = dict(vision_config=tower, image_token_index=image, vision_feature_layer=-1, spatial_merge_size=2)
    return "Mistral3", config, processor, "mistral"


def aya_vision(work):
    from transformers import AyaVisionProcessor, GotOcr2ImageProcessor

    tokenizer = llama3(work)
    names = ["<|START_OF_IMG|>", "<|END_OF_IMG|>", "<|IMG_PATCH|>", "TILE_GLOBAL"]
    tokenizer.pad_token = "<|finetune_right_pad_id|>"
    tokenizer.add_special_tokens({"additional_special_tokens": names})
    images = GotOcr2ImageProcessor(size={"height": 2 * SIDE, "width": 2 * SIDE}, max_patches=1)
    processor = AyaVisionProcessor(images, tokenizer, patch_size=PATCH, img_size=2 * SIDE, downsample_factor=2)
    image = tokenizer.convert_tokens_to_ids("<|IMG_PATCH|>")
    config = dict(vision_config=siglip(2 * SIDE), image_token_index=image, downsample_factor=2, alignment_intermediate_size=48)
    return "AyaVision", config, processor, "cohere2"


def deepseek_vl(work):
    from transformers import DeepseekVLImageProcessor, DeepseekVLProcessor

    tokenizer = named(llama3(work), image_token="<image_placeholder>")
    tokenizer.pad_token = "<|finetune_right_pad_id|>"
    images = DeepseekVLImageProcessor(size={"height": SIDE, "width": SIDE})
    config = dict(vision_config=siglip(), image_token_id=tokenizer.image_token_id)
    return "DeepseekVL", config, DeepseekVLProcessor(images, tokenizer, num_image_tokens=TOKENS), "llama"


def llava_next_video(work):
    import transformers

    tokenizer = named(llama(work), image_token="<image>", video_token="<video>")
    tokenizer.add_special_tokens({"pad_token": "<pad>"})
    points = [[SIDE, 2 * SIDE], [2 * SIDE, SIDE], [2 * SIDE, 2 * SIDE]]
    sizes = dict(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE})
    images = transformers.LlavaNextImageProcessor(**sizes, image_grid_pinpoints=points)
    if hasattr(transformers, "LlavaNextVideoVideoProcessor"):
        videos = transformers.LlavaNextVideoVideoProcessor(**sizes)
    else:
        videos = transformers.LlavaNextVideoImageProcessor(**sizes, image_grid_pinpoints=points)
    more = dict(patch_size=PATCH, vision_feature_select_strategy="default", num_additional_image_tokens=1)
    processor = transformers.LlavaNextVideoProcessor(videos, images, tokenizer, **more)
    ids = {f"{kind}_token_index": tokenizer.convert_tokens_to_ids(f"<{kind}>") for kind in ("image", "video")}
    config = dict(vision_config=clip(), image_grid_pinpoints=points, image_seq_length=TOKENS, **ids)
    return "LlavaNextVideo", config, processor, "llama"


def video_llava(work):
    import transformers

    tokenizer = named(llama(work), image_token="<image>", video_token="<video>")
    tokenizer.add_special_tokens({"pad_token": "<pad>"})
    sizes = dict(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE})
    parts = dict(image_processor=transformers.VideoLlavaImageProcessor(**sizes), tokenizer=tokenizer)
    if hasattr(transformers, "VideoLlavaVideoProcessor"):
        parts["video_processor"] = transformers.VideoLlavaVideoProcessor(**sizes)
    more = dict(patch_size=PATCH, vision_feature_select_strategy="default", num_additional_image_tokens=1)
    processor = transformers.VideoLlavaProcessor(**parts, **more)
    ids = {f"{kind}_token_index": tokenizer.convert_tokens_to_ids(f"<{kind}>") for kind in ("image", "video")}
    return "VideoLlava", dict(vision_config=clip(), image_seq_length=TOKENS, **ids), processor, "llama"


def vipllava(work):
    _, config, processor, language = llava(work)
    config.pop("vision_feature_layer")
    return "VipLlava", dict(config, vision_feature_layers=[-1, -2]), processor, language


def pixtral(work):
    """LLaVA with the tower of Pixtral."""
    _, config, processor, language = mistral3(work)
    processor.spatial_merge_size = 1
    return "Llava", dict(config, vision_feature_select_strategy="full", image_seq_length=TOKENS), processor, language


HOSTS = {
    "llava": llava,
    "vipllava": vipllava,
    "pixtral": pixtral,
    "llava_next": llava_next,
    "llava_next_video": llava_next_video,
    "video_llava": video_llava,
    "llava_onevision": llava_onevision,
    "paligemma": paligemma_of("gemma"),
    "paligemma2": paligemma_of("gemma2"),
    "idefics3": splitting("idefics3"),
    "smolvlm": splitting("smolvlm"),
    "qwen2_vl": qwen_vl("qwen2_vl"),
    "qwen2_5_vl": qwen_vl("qwen2_5_vl"),
    "qwen3_vl": qwen3_vl,
    "glm4v": glm4v,
    "internvl": internvl,
    "gemma3": gemma3,
    "mistral3": mistral3,
    "aya_vision": aya_vision,
    "deepseek_vl": deepseek_vl,
}

# What a user writes before the text of a prompt, so that the processor puts the image there.
IMAGE_IN_TEXT = {
    "qwen2_vl": "<|vision_start|><|image_pad|><|vision_end|>", "qwen2_5_vl": "<|vision_start|><|image_pad|><|vision_end|>",
    "qwen3_vl": "<|vision_start|><|image_pad|><|vision_end|>", "glm4v": "<|begin_of_image|><|image|><|end_of_image|>",
    "internvl": "<IMG_CONTEXT>\n", "gemma3": "<start_of_image>", "mistral3": "[IMG]", "pixtral": "[IMG]",
    "deepseek_vl": "<image_placeholder>",
}  # fmt: skip


def save_host(kind, dtype, path, work):
    import transformers

    classes, config, processor, language = HOSTS[kind](work)
    text = text_config(language, WIDTH, processor.tokenizer)
    if kind.startswith("qwen2"):
        config |= text
    else:
        config["text_config"] = dict(text, model_type=language)
    if kind == "qwen3_vl":
        sections = dict(rope_type="default", mrope_interleaved=True, mrope_section=[4, 2, 2])
        config["text_config"] |= dict(model_type="qwen3_vl_text", rope_scaling=sections)
    if kind == "glm4v":
        sections = dict(rope_type="default", mrope_section=[0, 1, 1])
        config["text_config"] |= dict(model_type="glm4v_text", rope_scaling=sections, partial_rotary_factor=0.5)
    # Gemma and Cohere models share one matrix for both ends; so do their hosts.
    config["tie_word_embeddings"] = language.startswith(("gemma", "cohere"))
    made = getattr(transformers, f"{classes}Config")(**config)
    save_model(getattr(transformers, f"{classes}ForConditionalGeneration")(made), dtype, path)
    processor.save_pretrained(path)
    if kind.startswith("qwen2") and transformers.__version__.startswith("4"):
        flatten(path / "config.json", config, f"{classes}ForConditionalGeneration")


def flatten(path, config, cls):
    """Writes the config as the hub has it. From 4.5x on save_pretrained adds a text_config, and moves `architectures` there."""
    saved = json.loads(path.read_text())
    kept = {key: value for key, value in saved.items() if key != "text_config"}
    path.write_text(json.dumps({**kept, **config, "architectures": [cls]}, indent=2) + "\n")


# OpenVLA's classes need the package timm, and are not opened.
OPENVLA_MODULES = {
    "configuration_prismatic.py": "from transformers import PretrainedConfig\n\n\nclass OpenVLAConfig(PretrainedConfig):\n    model_type = 'openvla'\n",
    "modeling_prismatic.py": "from transformers import PreTrainedModel\n\n\nclass OpenVLAForActionPrediction(PreTrainedModel):\n    pass\n",
    "processing_prismatic.py": "from transformers import ProcessorMixin\n\n\nclass PrismaticProcessor(ProcessorMixin):\n    pass\n",
}  # fmt: skip


def save_openvla(dtype, path, work):
    """The documents, and a file without blocks that has the names and shapes of the class."""
    tokenizer = llama(work)
    tokenizer.add_special_tokens({"pad_token": "<PAD>"})
    text = dict(text_config("llama", WIDTH, tokenizer), model_type="llama", vocab_size=-(-len(tokenizer) // 64) * 64)
    config = dict(
        architectures=["OpenVLAForActionPrediction"], model_type="openvla", torch_dtype=DTYPES[dtype], text_config=text,
        auto_map={"AutoConfig": "configuration_prismatic.OpenVLAConfig", "AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"},
        vision_backbone_id="dinosiglip-vit-so-224px", llm_backbone_id="llama2-7b-pure", arch_specifier="no-align+fused-gelu-mlp",
        use_fused_vision_backbone=True, image_sizes=[224, 224], image_resize_strategy="resize-naive", llm_max_length=2048,
        timm_model_ids=["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"], timm_override_act_layers=[None, None],
        hf_llm_id="meta-llama/Llama-2-7b-hf", pad_token_id=tokenizer.pad_token_id, pad_to_multiple_of=64, n_action_bins=256, norm_stats={},
    )  # fmt: skip
    path.mkdir()
    (path / "config.json").write_text(json.dumps(config, indent=2))
    _, expected, _ = doctor("expect", path, "--for", "transformers==4.47.0", "--output-format", "json")
    stored = {"f32": "F32", "bf16": "BF16", "f16": "F16"}[dtype]
    write_holes(
        path / "model.safetensors", {name: (stored, shape) for name, shape in json.loads(expected)[0]["tensors"].items()}
    )
    tokenizer.save_pretrained(path)
    (path / "preprocessor_config.json").write_text(
        json.dumps({"image_processor_type": "PrismaticImageProcessor", "processor_class": "PrismaticProcessor"})
    )
    for name, module in OPENVLA_MODULES.items():
        (path / name).write_text(module)


# Towers.


def save_tower(kind, dtype, path, work):
    """A vision tower with its image processor."""
    import transformers

    if kind == "clip":
        model, images = transformers.CLIPVisionModel(transformers.CLIPVisionConfig(**clip())), clip_images()
    elif kind == "siglip":  # for larger pictures than the towers of the hosts
        model = transformers.SiglipVisionModel(transformers.SiglipVisionConfig(**siglip(2 * SIDE)))
        images = transformers.SiglipImageProcessor(size={"height": 2 * SIDE, "width": 2 * SIDE})
    elif kind == "siglip2":
        vision = dict(
            hidden_size=32,
            intermediate_size=48,
            num_hidden_layers=2,
            num_attention_heads=4,
            num_patches=TOKENS,
            patch_size=PATCH,
        )
        model = transformers.Siglip2VisionModel(transformers.Siglip2VisionConfig(**vision))
        images = transformers.Siglip2ImageProcessor(patch_size=PATCH, max_num_patches=TOKENS)
    else:
        vision = dict(
            hidden_size=32, mlp_ratio=2, num_hidden_layers=2, num_attention_heads=4, image_size=SIDE, patch_size=PATCH
        )
        model = transformers.Dinov2Model(transformers.Dinov2Config(**vision))
        images = transformers.BitImageProcessor(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE})
    save_model(model, dtype, path)
    images.save_pretrained(path)


TOWERS = ("clip", "siglip", "siglip2", "dinov2")


# Building.


def knows(kind):
    """Whether the version on PYTHONPATH has the class."""
    import transformers

    kind = {
        "llama3": "llama",
        "openvla": "llama",
        "paligemma2": "paligemma",
        "siglip": "siglip_vision_model",
        "siglip2": "siglip2_vision_model",
        "clip": "clip_vision_model",
    }.get(kind, kind)
    return kind in transformers.CONFIG_MAPPING


def build(wanted, root):
    """Saves those of `wanted`, lists (role, kind, width, dtype), whose class this version has, and that are not there yet."""
    import transformers

    transformers.utils.logging.disable_progress_bar()
    for role, kind, width, dtype in wanted:
        path = root / donor_name(role, kind, width, dtype)
        if path.exists() or not knows(kind):
            continue
        work = root / "work"
        work.mkdir(exist_ok=True)
        if kind == "openvla":
            save_openvla(dtype, path, work)
        elif role == "host":
            save_host(kind, dtype, path, work)
        elif role == "guest":
            save_guest(kind, width, dtype, path, work)
        else:
            save_tower(kind, dtype, path, work)


def donor_name(role, kind, width, dtype):
    return f"{role}-{kind}-{width}-{dtype}"
