"""One version of transformers opens the directories that surgery.py made, and runs them.

surgery.py calls it as a program, `opened.py CELLS TOLD`: CELLS has a line of JSON for each directory, and TOLD gets one, with
what failed in it, stage by stage: an empty list when everything holds, null when this version has no class for it.
"""

import importlib
import inspect
import json
import re
import sys
import tempfile
from functools import cache
from pathlib import Path

from peer import quiet, read_tensors
from stock import IMAGE_IN_TEXT, allow_without_num2words

TEXT = "pick the red cup"
# These attend to the whole prompt, and guests only backwards: one token is the same for both.
ONE_TOKEN = {"paligemma", "paligemma2", "spatialvla"}
CLOSE = 5e-4  # of logits in float32; those of another rounding differ by more than twice that


def dtype_key():
    import transformers

    return "torch_dtype" if transformers.__version__.startswith("4.47") else "dtype"


@cache
def picture():
    import numpy
    from PIL import Image

    return Image.fromarray(numpy.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=numpy.uint8))


@cache
def guest_of(path, dtype):
    """The donor of the language model by its own classes: tokenizer, and model in float32 after rounding to `dtype`."""
    import torch
    from transformers import AutoModelForCausalLM, AutoTokenizer

    model, info = AutoModelForCausalLM.from_pretrained(path, output_loading_info=True, **{dtype_key(): torch.float32})
    with torch.no_grad():
        for parameter in model.parameters():  # buffers are computed in float32
            parameter.copy_(parameter.to(getattr(torch, dtype)))
    return AutoTokenizer.from_pretrained(path), model.eval(), faults_of(info)


@cache
def processor_name(path):
    return type(processor_of(path)).__name__


def processor_of(path):
    from transformers import AutoProcessor

    return AutoProcessor.from_pretrained(path, trust_remote_code=True)


def class_of(path, host):
    """The class that config.json names, perhaps one that only the module of the host has; None without one in this version."""
    import transformers
    from transformers.dynamic_module_utils import get_class_from_dynamic_module

    config = json.loads((Path(path) / "config.json").read_text())
    if "AutoModel" in config.get("auto_map", {}):
        # The modules of the fixture are written for this version.
        ours = transformers.__version__.startswith("4.47")
        return get_class_from_dynamic_module(config["auto_map"]["AutoModel"], str(path)) if ours else None
    name, kind = (config.get("architectures") or ["none"])[0], {"paligemma2": "paligemma", "pixtral": "llava"}.get(host, host)
    if kind not in transformers.CONFIG_MAPPING:
        return None
    module = importlib.import_module(f"transformers.models.{kind}.modeling_{kind}")
    return getattr(transformers, name, None) or getattr(module, name, None)


def faults_of(info):
    return [f"{kind} {len(names)}: {sorted(map(str, names))[:2]}" for kind, names in info.items() if names]


def load(cls, path, dtype):
    """The model in a dtype, and what is wrong with the load."""
    from transformers import PreTrainedModel

    # SpatialVLA's own from_pretrained does not return the report.
    model, info = PreTrainedModel.from_pretrained.__func__(cls, path, output_loading_info=True, **{dtype_key(): dtype})
    wrong = faults_of(info)
    if dtype != "auto":
        others = sorted({str(p.dtype) for p in model.parameters()} - {str(dtype)})
        wrong += [f"parameters of {others}"] if others else []
    return model.eval(), wrong


def run(model, processor, host):
    """Forward and generate with an image; returns what is wrong."""
    import torch

    text = TEXT if host == "spatialvla" else IMAGE_IN_TEXT.get(host, "<image>") + TEXT
    inputs = processor(images=[picture()], text=[text], return_tensors="pt").to(model.dtype)
    wrong = []
    with torch.no_grad():
        logits = model(**inputs).logits
        if not torch.isfinite(logits).all():
            wrong.append("forward: logits are not finite")
        rows = model.get_input_embeddings().weight.shape[0]
        if logits.shape[-1] != rows:
            wrong.append(f"forward: {logits.shape[-1]} logits, {rows} rows")
        if len(processor.tokenizer) > rows:
            wrong.append(f"tokenizer: {len(processor.tokenizer)} tokens, {rows} rows")
        made = model.generate(**inputs, min_new_tokens=3, max_new_tokens=3, do_sample=False)
    if made.shape[1] != inputs["input_ids"].shape[1] + 3:
        wrong.append(f"generate: {made.shape[1] - inputs['input_ids'].shape[1]} tokens")
    return wrong


def see(model, processor, host, path):
    """Another picture gives other logits, unless the report says that pictures have no effect yet."""
    import torch
    from PIL import ImageOps

    text = TEXT if host == "spatialvla" else IMAGE_IN_TEXT.get(host, "<image>") + TEXT
    with torch.no_grad():
        one, other = (
            model(**processor(images=[image], text=[text], return_tensors="pt").to(model.dtype)).logits
            for image in (picture(), ImageOps.invert(picture()))
        )
    report, sees = Path(path) / "merge-report.md", bool((one - other).abs().max() > 0)
    is_blind = report.exists() and "has no effect until it is trained" in report.read_text()
    return [f"the picture changes {'a' if sees else 'no'} logit"] if sees == is_blind else []


def listen(model, processor):
    """A chat with a picture, as this version writes it, has the place of the picture, and the model takes it."""
    import torch

    chat = [{"role": "user", "content": [{"type": "image"}, {"type": "text", "text": TEXT}]}]
    text = processor.apply_chat_template(chat, add_generation_prompt=True, tokenize=False)
    if TEXT not in text or "{" in text:
        return [f"the chat is {text!r}"]
    inputs = processor(images=[picture()], text=[text], return_tensors="pt").to(model.dtype)
    with torch.no_grad():
        logits = model(**inputs).logits
    return [] if torch.isfinite(logits).all() else ["logits of a chat are not finite"]


def lines_of(path):
    """The blocks of Python in merge-report.md, by section."""
    sections = (Path(path) / "merge-report.md").read_text().split("\n## ")[1:]
    return {part.partition("\n")[0]: re.findall(r"^```python\n(.*?)^```", part, re.M | re.S) for part in sections}


def follow(model, processor, path):
    """The lines of the report ask about a picture, and train what the report counts: of tensors with new rows, these alone."""
    lines, wrong = lines_of(path), []
    names = {"model": model, "processor": processor}
    (question,) = lines["Ask about a picture"]
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        picture().save(file)
        file.flush()
        exec(question.replace('"picture.png"', repr(file.name)), names)
    if "The names are those in the files" in (Path(path) / "merge-report.md").read_text():
        return wrong  # the report does not know what this version calls them
    for block in lines["Training"]:
        exec(block, names)
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
    sizes = json.loads((Path(path) / "merge-manifest.json").read_text())["training"]["sizes"]
    told, found = sum(size["values"] for size in sizes), sum(p.numel() for p in trained.values())
    if told != found:
        wrong.append(f"{told} parameters to train, the model has {found}: {sorted(trained)[:5]}")
    model(**names["inputs"]).logits.logsumexp(-1).mean().backward()
    first = names.get("first_new", {})
    # Behind a matrix that its class starts with zeros, nothing gets a gradient in the first step.
    has_zeros = any(p.dim() > 1 and not p.any() for p in trained.values())
    for name, p in trained.items():
        # New rows and the spatial embedding are of tokens that this text has not: images and actions.
        if (
            not has_zeros
            and name not in first
            and not name.startswith("spatial_embed")
            and (p.grad is None or not p.grad.any())
        ):
            wrong.append(f"{name} gets no gradient")
        elif name in first and p.grad is not None and p.grad[: first[name]].any():
            wrong.append(f"{name}: old rows get a gradient")
    if any(size["new_rows"] for size in sizes) and not first.keys() & trained.keys():
        wrong.append(f"no tensor with new rows is found: {sorted(first)}")
    for p in model.parameters():
        p.requires_grad_(False)
        p.grad = None
    return wrong


def as_guest(model, tokenizer, host, guest_dir, dtype, times=1.0):
    """Text alone gives the ids and, in float32, `times` the logits are those of the language model alone."""
    import torch

    own, guest, wrong = guest_of(guest_dir, dtype)
    ids, wanted = (t(TEXT, add_special_tokens=False)["input_ids"] for t in (tokenizer, own))
    if ids != wanted:
        return wrong + [f"ids {ids[:8]}, the guest's {wanted[:8]}"]
    batch = torch.tensor([wanted[:1] if host in ONE_TOKEN else wanted])
    # The LLaVAs of 4.47 do not run without an image; the language model in them is a whole one there.
    inside = getattr(model, "language_model", None)
    speaker = inside if hasattr(inside, "lm_head") else model
    with torch.no_grad():
        want = guest(input_ids=batch, attention_mask=torch.ones_like(batch)).logits
        got = speaker(input_ids=batch, attention_mask=torch.ones_like(batch)).logits[..., : want.shape[-1]] * times
    far = (want[..., : got.shape[-1]] - got).abs().max().item()
    return wrong + ([f"logits of text differ from the guest's by {far:.3g}"] if not far <= CLOSE else [])


def whole(cell, cls):
    """A model with its processor, in three dtypes."""
    import torch

    yield "processor"
    processor = processor_of(cell["out"])
    if type(processor).__name__ != processor_name(cell["host_dir"]):
        yield "processor", [f"it is a {type(processor).__name__}"]
    for dtype in (torch.float32, torch.bfloat16, "auto"):
        yield f"load {dtype}"
        model, wrong = load(cls, cell["out"], dtype)
        yield f"load {dtype}", wrong
        yield f"run {dtype}"
        yield f"run {dtype}", run(model, processor, cell["host"])
        if dtype == torch.float32:
            yield "see"
            yield "see", see(model, processor, cell["host"], cell["out"])
        if dtype == torch.float32 and cell.get("guest_dir"):
            yield "listen"
            yield "listen", listen(model, processor)
            yield "follow"
            yield "follow", follow(model, processor, cell["out"])
            yield "text"
            yield "text", as_guest(model, processor.tokenizer, cell["host"], cell["guest_dir"], cell["stored"])


class EnoughError(Exception):
    """Ends a forward whose inputs are known."""


def entering(model, inputs):
    """What enters the first layer of the language model."""
    import torch

    layers = [m for n, m in model.named_modules() if n.endswith("layers.0") and not re.search("vision|visual|encoder|zoe", n)]
    seen = []

    def keep(module, args, kwargs):
        seen.append(args[0] if args else kwargs["hidden_states"])
        raise EnoughError

    handle = layers[0].register_forward_pre_hook(keep, with_kwargs=True)
    try:
        with torch.no_grad():
            model(**inputs)
    except EnoughError:
        pass
    finally:
        handle.remove()
    return seen[0][0]


def rows_of(path):
    """Rows of the embedding in a directory."""
    tensors = read_tensors(Path(path)).items()
    return next(
        shape[0]
        for name, (_, shape, _) in tensors
        if name.endswith(("embed_tokens.weight", "word_embeddings.weight")) and "vision" not in name
    )


@cache
def proportion(path, host, tokens):
    """The norm of image features by that of the rows of the first tokens, as they enter the first layer."""
    import torch

    processor = processor_of(path)
    model, _ = load(class_of(path, host), path, torch.float32)
    text = TEXT if host == "spatialvla" else IMAGE_IN_TEXT.get(host, "<image>") + TEXT
    inputs = processor(images=[picture()], text=[text], return_tensors="pt").to(model.dtype)
    config, ids = model.config, inputs["input_ids"]
    image = next(getattr(config, key) for key in ("image_token_id", "image_token_index") if hasattr(config, key))
    rows = [i for i in range(tokens) if i != image]
    more = torch.tensor([rows])
    longer = {key: value for key, value in inputs.items() if value.shape == ids.shape and key != "input_ids"}
    longer = {key: torch.cat([value, value[:, -1:].expand(1, len(rows))], 1) for key, value in longer.items()}
    hidden = entering(model, {**inputs, **longer, "input_ids": torch.cat([ids, more], 1)})
    sizes = hidden[: ids.shape[1]][ids[0] == image], hidden[ids.shape[1] :]
    of_image, of_text = (size.square().sum(-1).mean().sqrt().item() for size in sizes)
    return of_image / of_text


def as_text(cell, cls):
    """`scale=text` makes image features a quarter as large, by the size of text, as they are in the host."""
    import transformers

    if transformers.__version__ == cell["version"]:
        yield "size"
        # Rows that were appended are no text.
        stored = (rows_of(cell[of]) for of in ("host_dir", "guest_dir"))
        host, result = (proportion(cell[of], cell["host"], rows) for of, rows in zip(("host_dir", "out"), stored, strict=True))
        print(f"{cell['name']}: image features {host:.3g} of text in the host, {result:.3g} in the result", file=sys.stderr)
        yield "size", [] if abs(result / host / 0.25 - 1) < 0.03 else [f"{result:.4g} of text, in the host {host:.4g}"]


def language_part(cell, cls):
    """A language model that was taken out gives what its host gives for text alone."""
    import torch

    yield "host"
    host, _ = load(class_of(cell["host_dir"], cell["host"]), cell["host_dir"], torch.float32)
    tokenizer = processor_of(cell["host_dir"]).tokenizer
    yield "part"
    # The class of Aya Vision leaves out the factor on logits that its language model has.
    times = getattr(host.config.text_config, "logit_scale", 1.0) if cell["host"] == "aya_vision" else 1.0
    yield "part", as_guest(host, tokenizer, cell["host"], cell["out"], cell["stored"], times)


def in_a_row(images):
    """Images that a processor nests by text, one after another."""
    if isinstance(images, list):
        return [image for of_text in images for image in of_text]
    return images.flatten(0, images.dim() - 4) if images.dim() > 4 else images


def vision_part(cell, cls):
    """A tower that was taken out opens in its own class, and sees an image of its own image processor."""
    import torch
    from transformers import AutoImageProcessor

    yield "image processor"
    images = AutoImageProcessor.from_pretrained(cell["out"])
    yield "load"
    model, wrong = load(cls, cell["out"], torch.float32)
    yield "load", wrong
    yield "run"
    inputs = images(images=[picture()], return_tensors="pt")
    if "pixel_values_images" in inputs:  # as the processor of a model with two towers has it
        inputs["pixel_values"] = inputs.pop("pixel_values_images")
    kept = {"pixel_values", "image_grid_thw", "pixel_attention_mask"} & inputs.keys()
    given = {key: in_a_row(inputs[key]) for key in kept}
    if "image_grid_thw" in given:
        given = {"hidden_states": given["pixel_values"], "grid_thw": given["image_grid_thw"]}
    given = {key: value for key, value in given.items() if key in inspect.signature(model.forward).parameters}
    with torch.no_grad():
        model(**given)


@cache
def opens(guest_dir, dtype):
    """Whether this version opens a guest alone."""
    try:
        guest_of(guest_dir, dtype)
    except Exception:
        return False
    return True


def open_cell(cell):
    """What failed under this version, each with its stage; None for a class, or a guest, that it does not open."""
    cls, wrong, stage = class_of(cell["out"], cell["host"]), [], "class"
    if cls is None or cell.get("guest_dir") and not opens(cell["guest_dir"], cell["stored"]):
        return None
    how = {"as text": as_text, "part language": language_part, "part vision": vision_part}.get(cell["what"], whole)
    try:
        for told in how(cell, cls):
            if isinstance(told, str):
                stage = told
            else:
                wrong += [f"{told[0]}: {fault}" for fault in told[1]]
    except Exception as error:  # a result may break the loader in any way
        words = str(error).strip().splitlines() or [""]
        wrong.append(f"{stage}: {type(error).__name__}: {words[0][:200]}")
    return wrong


def main():
    cells, told = map(Path, sys.argv[1:])
    import torch
    import transformers

    torch.set_num_threads(1)
    quiet()
    allow_without_num2words()
    with told.open("w") as file:
        for line in cells.read_text().splitlines():
            cell = json.loads(line)
            file.write(json.dumps({"name": cell["name"], "version": transformers.__version__, "wrong": open_cell(cell)}) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
