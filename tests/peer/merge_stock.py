#!/usr/bin/env python3
"""Merges a PaliGemma and a Llama, both written by save_pretrained, and opens the result in stock transformers."""

import json

from peer import Tally, check, doctor, errors, quiet, read_tensors, tiny_sentencepiece, workplace

IMAGE, PATCH = 28, 14
PROMPT = "pick the red cup"


def save_paligemma(path, work, width):
    from transformers import (
        AddedToken,
        GemmaTokenizerFast,
        PaliGemmaConfig,
        PaliGemmaForConditionalGeneration,
        PaliGemmaProcessor,
        SiglipImageProcessor,
    )
    from transformers.models.paligemma.processing_paligemma import EXTRA_TOKENS
    import torch

    model = tiny_sentencepiece(
        work,
        "gemma",
        400,
        pad_id=0,
        eos_id=1,
        bos_id=2,
        unk_id=3,
        pad_piece="<pad>",
        eos_piece="<eos>",
        bos_piece="<bos>",
        unk_piece="<unk>",
        add_dummy_prefix=False,
    )
    tokenizer = GemmaTokenizerFast(vocab_file=model)
    tokenizer.add_tokens(EXTRA_TOKENS)
    tokenizer.add_special_tokens({"additional_special_tokens": [AddedToken("<image>", normalized=False, special=True)]})
    images = SiglipImageProcessor(size={"height": IMAGE, "width": IMAGE})
    images.image_seq_length = (IMAGE // PATCH) ** 2
    PaliGemmaProcessor(images, tokenizer).save_pretrained(path)
    torch.manual_seed(1)
    PaliGemmaForConditionalGeneration(
        PaliGemmaConfig(
            text_config=dict(
                model_type="gemma",
                hidden_size=width,
                intermediate_size=48,
                num_hidden_layers=2,
                num_attention_heads=2,
                num_key_value_heads=1,
                head_dim=16,
                vocab_size=len(tokenizer),
            ),
            vision_config=dict(
                model_type="siglip_vision_model",
                hidden_size=32,
                intermediate_size=48,
                num_hidden_layers=2,
                num_attention_heads=2,
                image_size=IMAGE,
                patch_size=PATCH,
                vision_use_head=False,
            ),
            projection_dim=width,
            hidden_size=width,
            image_token_index=tokenizer.convert_tokens_to_ids("<image>"),
            vocab_size=len(tokenizer),
            bos_token_id=2,
            eos_token_id=1,
            pad_token_id=0,
        )
    ).to(torch.bfloat16).save_pretrained(path, max_shard_size="60KB")


def save_llama(path, work, width, tied, dtype="bfloat16"):
    from transformers import LlamaConfig, LlamaForCausalLM, LlamaTokenizerFast
    import torch

    model = tiny_sentencepiece(work, "llama", 340, unk_id=0, bos_id=1, eos_id=2, pad_id=-1)
    tokenizer = LlamaTokenizerFast(vocab_file=model, pad_token="<unk>")
    tokenizer.save_pretrained(path)
    torch.manual_seed(2)
    LlamaForCausalLM(
        LlamaConfig(
            hidden_size=width,
            intermediate_size=80,
            num_hidden_layers=3,
            num_attention_heads=4,
            num_key_value_heads=2,
            vocab_size=len(tokenizer),
            max_position_embeddings=512,
            tie_word_embeddings=tied,
            bos_token_id=1,
            eos_token_id=2,
            pad_token_id=0,
        )
    ).to(getattr(torch, dtype)).save_pretrained(path, max_shard_size="80KB")


def compare_tensors(tally, what, vision, language, out, padded):
    """Compares the tensors: copied ones are equal to the donor's, and grown matrices begin with the donor's rows."""
    from_vision = {k: t for k, t in read_tensors(vision).items() if not k.startswith("language_model.")}
    from_language = {f"language_model.{k}": t for k, t in read_tensors(language).items()}
    want, got = {**from_vision, **from_language}, read_tensors(out)
    tally.equal(sorted(got), sorted(want), f"{what}: tensor names")
    same = grown = 0
    for name in sorted(set(got) & set(want)):
        (dtype, shape, data), (want_dtype, want_shape, want_data) = got[name], want[name]
        if shape == want_shape:
            same += tally.expect((dtype, data) == (want_dtype, want_data), f"{what}: {name} differs from the donor")
        else:
            allowed = ("language_model.model.embed_tokens.weight", "language_model.lm_head.weight") + padded
            begins = dtype == want_dtype and shape[1:] == want_shape[1:] and data.startswith(want_data)
            grown += tally.expect(name in allowed and begins, f"{what}: {name} {want_shape} became {shape}")
    print(f"{what}: {same} tensors are equal to the donor's, {grown} begin with the donor's rows")


def open_stock(tally, what, language, out):
    import numpy
    import torch
    from PIL import Image
    from transformers import AutoProcessor, AutoTokenizer, PaliGemmaForConditionalGeneration

    model, info = PaliGemmaForConditionalGeneration.from_pretrained(out, output_loading_info=True)
    for kind in ("missing_keys", "unexpected_keys", "mismatched_keys", "error_msgs"):
        tally.equal(info[kind], [], f"{what}: {kind}")
    config, rows = model.config, model.get_input_embeddings().weight.shape[0]
    processor = AutoProcessor.from_pretrained(out)
    tokenizer = processor.tokenizer
    tally.equal(type(processor).__name__, "PaliGemmaProcessor", f"{what}: AutoProcessor")
    tally.equal(tokenizer.convert_tokens_to_ids("<image>"), config.image_token_index, f"{what}: id of <image>")
    tally.equal(tokenizer.pad_token_id, config.pad_token_id, f"{what}: id of padding")
    tally.expect(len(tokenizer) <= rows, f"{what}: {len(tokenizer)} tokens, {rows} rows")
    donor = AutoTokenizer.from_pretrained(language)
    ids = tokenizer(PROMPT, add_special_tokens=False)["input_ids"]
    tally.equal(ids, donor(PROMPT, add_special_tokens=False)["input_ids"], f"{what}: ids of a prompt")

    pixels = numpy.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=numpy.uint8)
    inputs = processor(images=Image.fromarray(pixels), text="<image>" + PROMPT, return_tensors="pt")
    with torch.no_grad():
        logits = model(**inputs).logits
        made = model.generate(**inputs, max_new_tokens=3, do_sample=False)
    tally.expect(torch.isfinite(logits).all(), f"{what}: logits are not finite")
    tally.equal(logits.shape[-1], rows, f"{what}: width of the logits")
    tally.expect(made.shape[1] > inputs["input_ids"].shape[1], f"{what}: generate returned no tokens")


def example(path, dtype):
    """The inputs of a picture and a prompt."""
    import numpy
    from PIL import Image
    from transformers import AutoProcessor

    pixels = numpy.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=numpy.uint8)
    processor = AutoProcessor.from_pretrained(path)
    return processor(images=Image.fromarray(pixels), text="<image>" + PROMPT, return_tensors="pt").to(dtype)


def open_in_types(tally, what, out):
    """Runs forward and generate in each type that users ask for."""
    import torch
    from transformers import PaliGemmaForConditionalGeneration

    for asked in (torch.bfloat16, "auto", torch.float32):
        model = PaliGemmaForConditionalGeneration.from_pretrained(out, torch_dtype=asked)
        types = {p.dtype for p in model.parameters()}
        tally.equal(len(types), 1, f"{what}: types of the parameters with torch_dtype={asked}: {types}")
        try:
            with torch.no_grad():
                inputs = example(out, model.dtype)
                finite = torch.isfinite(model(**inputs).logits).all()
                model.generate(**inputs, max_new_tokens=2, do_sample=False)
            tally.expect(finite, f"{what}: logits with torch_dtype={asked} are not finite")
        except RuntimeError as error:
            tally.expect(False, f"{what}: forward with torch_dtype={asked}: {error}")


def image_rows(path):
    """The features of an image as they enter the first layer, in float32."""
    import torch
    from transformers import PaliGemmaForConditionalGeneration

    model, seen = PaliGemmaForConditionalGeneration.from_pretrained(path), []
    first = model.language_model.model.layers[0]
    first.register_forward_pre_hook(
        lambda _, args, kwargs: seen.append((args or [kwargs["hidden_states"]])[0]), with_kwargs=True
    )
    inputs = example(path, model.dtype)
    with torch.no_grad():
        model(**inputs)
    return seen[0][inputs["input_ids"] == model.config.image_token_index]


def compare_types(tally, work):
    """Language models in other types than the vision side: cast, or refused; what the options say is what is stored."""
    for dtype in ("float16", "float32"):
        save_llama(work / f"llama-{dtype}", work, 64, tied=False, dtype=dtype)
        for option, stored in (("host", "BF16"), ("float32", "F32"), ("float16", "F16")):
            what, out = f"paligemma llama-{dtype} dtype={option}", work / f"merged-{dtype}-{option}"
            code, stdout, stderr = merge(work / "paligemma", work / f"llama-{dtype}", out, f"dtype={option}")
            if tally.expect(code == 0, f"{what}: exit {code}", (stdout + stderr)[-2000:]):
                tally.equal({tensor[0] for tensor in read_tensors(out).values()}, {stored}, f"{what}: stored types")
                tally.equal(errors(next(iter(check(out)[0].values()))), [], f"{what}: check")
                open_in_types(tally, what, out)
        code, stdout, stderr = merge(work / "paligemma", work / f"llama-{dtype}", work / "kept", "dtype=keep")
        tally.equal(code, 2, f"paligemma llama-{dtype} dtype=keep: exit code")
        tally.expect(f"bfloat16 and the language donor in {dtype}" in stdout + stderr, "dtype=keep: message", stdout)


def compare_scales(tally, work):
    """The image features that enter the first layer: as in the vision donor with scale=fold, divided with scale=keep."""
    import torch
    import transformers

    host = image_rows(work / "paligemma")
    for option, factor, versions in (("fold", 1, ()), ("keep", 8, ()), ("auto", 1, ("--for", transformers.__version__))):
        out = work / f"merged-{option}"
        code, stdout, stderr = merge(work / "paligemma", work / "llama", out, f"scale={option}", versions=versions)
        if not tally.expect(code == 0, f"scale={option}: exit {code}", (stdout + stderr)[-2000:]):
            continue
        rows = image_rows(out)
        rms = [float(r.pow(2).mean().sqrt()) for r in (host, rows)]
        print(f"scale={option}: rms of image features at the first layer {rms[1]:.6f}, of the vision donor {rms[0]:.6f}")
        tally.expect(torch.allclose(rows * factor, host, rtol=1e-4, atol=1e-6), f"scale={option}: image features", f"{rms}")


def merge(vision, language, out, *settings, versions=()):
    if not any(setting.startswith("scale=") for setting in settings):
        settings = (*settings, "scale=keep")
    options = [word for setting in settings for word in ("--set", setting)]
    return doctor(
        "build-merged",
        "--recipe",
        "paligemma-llama",
        "--vision",
        vision,
        "--language",
        language,
        "--out",
        out,
        *options,
        *versions,
    )


def main():
    tally = Tally()
    with workplace() as work:
        quiet()
        save_paligemma(work / "paligemma", work, 64)
        save_llama(work / "llama", work, 64, tied=False)
        save_llama(work / "llama-tied", work, 64, tied=True)
        save_llama(work / "llama-wide", work, 96, tied=False)
        projector = ("multi_modal_projector.linear.weight", "multi_modal_projector.linear.bias")
        before = {p: p.read_bytes() for p in work.glob("*llama*/*")} | {p: p.read_bytes() for p in work.glob("pali*/*")}

        for language, settings, padded in (
            ("llama", (), ()),
            ("llama-tied", (), ()),
            ("llama-wide", ("projector=pad",), projector),
        ):
            what, out = " ".join(("paligemma", language, *settings)), work / f"merged-{language}"
            code, stdout, stderr = merge(work / "paligemma", work / language, out, *settings)
            if not tally.expect(code == 0, f"{what}: exit {code}", (stdout + stderr)[-2000:]):
                continue
            entry = next(iter(check(out)[0].values()))
            tally.equal(errors(entry), [], f"{what}: check")
            tally.expect("auto_map" not in json.loads((out / "config.json").read_text()), f"{what}: auto_map in config")
            compare_tensors(tally, what, work / "paligemma", work / language, out, padded)
            open_stock(tally, what, work / language, out)

        compare_types(tally, work)
        compare_scales(tally, work)

        # The widths of projector and language model differ: the merge must stop at the seam.
        out = work / "merged-seam"
        code, stdout, stderr = merge(work / "paligemma", work / "llama-wide", out)
        output = stdout + stderr
        tally.equal(code, 2, "widths differ: exit code")
        tally.expect(not out.exists(), "widths differ: a target was written")
        for word in ("multi_modal_projector.linear.weight", "64", "96", "projector=pad"):
            tally.expect(word in output, f"widths differ: the message lacks {word}", output[-2000:])
        for path, data in before.items():
            tally.expect(path.read_bytes() == data, f"{path.name} of {path.parent.name} was changed")
        left = [p.name for p in work.iterdir() if p.name.startswith(".")]
        tally.equal(left, [], "other files beside the output")
    tally.finish()


if __name__ == "__main__":
    main()
