#!/usr/bin/env python3
"""Write what the tokenizer classes of the transformers at hand make of tokenizer.json to rules/tokenizers.json. For maintainers.

    python tools/loader_tokenizers.py            # replace the entries of this version
    python tools/loader_tokenizers.py --check    # fail if the entries of this version differ

Each class opens a small tokenizer.json of every kind of model. Since transformers 5 a class with an `__init__` of its own
takes the vocabulary and builds the rest itself; such classes have an entry. Older versions open tokenizer.json as it is, but
for the classes under `replaces`, which have a post-processor of their own.
"""

import inspect
import json
import sys
import tempfile
from pathlib import Path

import transformers
from transformers.models.auto import tokenization_auto

from by_version import keep

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "rules" / "tokenizers.json"
MODELS = ("BPE", "Unigram", "WordLevel", "WordPiece")
# Tokens that classes write without a setting for them, and pieces of the letter c in the ways that classes split text.
LITERALS = ["<|startoftranscript|>", "<|notimestamps|>", "en_XX", "eng_Latn", "__eng__", "__fra__"]
PIECES = [*"abcdefgh", "▁", "Ġ", "▁c", "Ġc", "c</w>", *(f"x{i}" for i in range(120))]
# Settings that change what a class writes around text.
SETTINGS = ("src_lang", "tgt_lang", "language", "task", "predict_timestamps")
# Settings without which a class raises.
NEEDED = {"MarkupLMTokenizer": {"tags_dict": {"a": 0}}}


def specials(cls):
    """The special tokens that the class has by default, of its own or from the class that it extends."""
    for owner in cls.__mro__:
        parameters = inspect.signature(owner.__init__).parameters.items() if "__init__" in vars(owner) else ()
        found = {name: str(p.default) for name, p in parameters if name.endswith("_token") and isinstance(p.default, str)}
        if found:
            return found
    return {}


def document(kind, special, with_processor=True):
    """A tokenizer.json with a post-processor that writes a and b around text, and an added token that nothing else lists."""
    tokens = list(dict.fromkeys([*special.values(), *LITERALS, *PIECES]))
    ids = {token: i for i, token in enumerate(tokens)}
    vocab = [[t, 0.0 if t in special.values() else -1.0] for t in tokens] if kind == "Unigram" else ids
    model = {"type": kind, "vocab": vocab}
    model |= {
        "BPE": {"merges": []},
        "Unigram": {"unk_id": 0},
        "WordLevel": {"unk_token": tokens[0]},
        "WordPiece": {"unk_token": tokens[0], "continuing_subword_prefix": "##", "max_input_chars_per_word": 100},
    }[kind]
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False}
    added = [{"id": ids[t], "content": t, **flags, "special": True} for t in dict.fromkeys(special.values())]
    added.append({"id": len(tokens), "content": "<added>", **flags, "special": False})

    def special_token(name):
        return {"SpecialToken": {"id": name, "type_id": 0}}

    text = [{"Sequence": {"id": name, "type_id": 0}} for name in "AB"]
    post_processor = {
        "type": "TemplateProcessing",
        "single": [special_token("a"), text[0], special_token("b")],
        "pair": text,
        "special_tokens": {name: {"id": name, "ids": [ids[name]], "tokens": [name]} for name in "ab"},
    }
    # Classes of transformers 4 read settings of these two.
    normalizer = {
        "type": "BertNormalizer",
        "clean_text": False,
        "handle_chinese_chars": False,
        "strip_accents": None,
        "lowercase": False,
    }
    pre_tokenizer = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": True}
    parts = {"truncation": None, "padding": None, "added_tokens": added}
    return {
        "version": "1.0",
        **parts,
        "normalizer": normalizer,
        "pre_tokenizer": pre_tokenizer,
        "post_processor": post_processor if with_processor else None,
        "decoder": None,
        "model": model,
    }


def opened(cls, name, kind, special, named, with_processor=True, is_sequence=False):
    """The tokenizer that the class opens, or the exception. `is_sequence` is for classes that demand a sequence."""
    with tempfile.TemporaryDirectory() as directory:
        given = document(kind, special, with_processor)
        if is_sequence:
            given["pre_tokenizer"] = {"type": "Sequence", "pretokenizers": [given["pre_tokenizer"]]}
        Path(directory, "tokenizer.json").write_text(json.dumps(given))
        config = {"added_tokens_decoder": {}, **(special if named else {}), **NEEDED.get(name, {})}
        Path(directory, "tokenizer_config.json").write_text(json.dumps(config))
        try:
            return cls.from_pretrained(directory)
        except ImportError:
            raise
        except Exception as error:
            return error


def around(tokenizer, special):
    """Tokens before and after text: attributes such as `cls_token` where a setting decides, or the tokens themselves.
    `None` when the class keeps the post-processor of tokenizer.json.
    """
    processor = json.loads(tokenizer.backend_tokenizer.to_str())["post_processor"]
    if processor is not None and "a" in processor.get("special_tokens", {}):
        return None
    name_of = {token: name for name, token in special.items()}
    encoding = tokenizer.backend_tokenizer.encode("c")
    tokens = zip(encoding.tokens, encoding.special_tokens_mask, encoding.attention_mask)
    written = [name_of.get(t, t) if s else None for t, s, is_text in tokens if is_text]
    first = written.index(None)
    last = len(written) - written[::-1].index(None)
    return [written[:first], written[last:]]


def entry(cls, name):
    special = specials(cls)
    distinct = {attribute: f"<{attribute}>" for attribute in special}
    outcome = {kind: opened(cls, name, kind, special, False) for kind in MODELS}
    raises = {kind: type(error).__name__ for kind, error in outcome.items() if isinstance(error, Exception)}
    own = getattr(getattr(cls, "model", None), "__name__", None) or next((k for k in MODELS if k not in raises), None)
    if own is None or own in raises:
        print(f"{name}: not derived: {outcome[own or MODELS[0]]}", file=sys.stderr)
        return None
    apart = opened(cls, name, own, distinct, True)
    # A class that does not open with other special tokens writes its own.
    tokenizer, named = (outcome[own], {}) if isinstance(apart, Exception) else (apart, distinct)
    without = opened(cls, name, own, named or special, bool(named), with_processor=False)
    vocabulary = outcome[own].get_vocab()
    given = {*special.values(), *LITERALS, *PIECES}
    if not given <= set(vocabulary):
        print(f"{name}: not derived: it takes its vocabulary from nowhere but itself", file=sys.stderr)
        return None
    assert "<added>" not in vocabulary, name
    parameters = inspect.signature(cls.__init__).parameters
    return {
        "model": own,
        "raises": dict(sorted(raises.items())),
        "around": around(tokenizer, named),
        "without": around(without, named),
        "settings": [key for key in SETTINGS if key in parameters],
        "special": special,
        "adds": sorted(set(vocabulary) - given),
    }


def replacing(names):
    """Classes of transformers 4 that do not keep the post-processor of tokenizer.json, without `Fast`."""
    found = []
    for name in names:
        cls = tokenization_auto.tokenizer_class_from_name(name)
        if not name.endswith("Fast") or not isinstance(cls, type):
            continue
        special = specials(cls)
        try:
            opened_as = [opened(cls, name, kind, special, False) for kind in MODELS]
        except ImportError as error:
            print(f"{name}: not derived: {error}", file=sys.stderr)
            continue
        tokenizer = next((t for t in opened_as if not isinstance(t, Exception)), None)
        if tokenizer is None:
            print(f"{name}: not derived: {opened_as[0]}", file=sys.stderr)
        elif around(tokenizer, {}) is not None:
            found.append(name.removesuffix("Fast"))
    return sorted(found)


def main():
    names = json.loads((ROOT / "rules" / "classes.json").read_text())[transformers.__version__]["tokenizer"]
    backend = getattr(transformers, "TokenizersBackend", None)
    if backend is None:
        return keep(FILE, transformers.__version__, {"replaces": replacing(names)}, shown, indent=1)
    classes = {}
    for name in sorted(names):
        cls = tokenization_auto.tokenizer_class_from_name(name)
        is_built = isinstance(cls, type) and issubclass(cls, backend) and cls is not backend and "__init__" in vars(cls)
        # A name with Fast is another one of the same class, but for DPR, which is left out.
        is_one = tokenization_auto.tokenizer_class_from_name(name + "Fast") in (None, cls)
        if is_built and is_one and not name.endswith("Fast"):
            try:
                found = entry(cls, name)
            except ImportError as error:
                print(f"{name}: not derived: {error}", file=sys.stderr)
                continue
            if found:
                classes[name] = found
    lists = {
        "classes": classes,
        # Model types whose own class is opened whatever tokenizer_config.json names.
        "overruled": sorted(tokenization_auto.MODELS_WITH_INCORRECT_HUB_TOKENIZER_CLASS),
        # Patterns of `_name_or_path`, in lower case, with which tokenizer.json is opened as it is.
        "as_is": sorted(tokenization_auto.MODEL_IDS_TO_TOKENIZERS_BACKEND),
    }
    return keep(FILE, transformers.__version__, lists, shown, indent=1)


def shown(lists):
    if "replaces" in lists:
        return f'  "replaces": {json.dumps(lists["replaces"])}'
    classes = ",\n".join(f"   {json.dumps(n)}: {json.dumps(c, ensure_ascii=False)}" for n, c in lists["classes"].items())
    rest = "".join(f",\n  {json.dumps(key)}: {json.dumps(lists[key])}" for key in ("overruled", "as_is"))
    return f'  "classes": {{\n{classes}\n  }}{rest}'


if __name__ == "__main__":
    transformers.logging.set_verbosity_error()
    sys.exit(main())
