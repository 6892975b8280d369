"""Names (`let`) for what the expressions of a file say often, so that shapes can be read."""

import re
from collections import Counter

from .cel import paths, replace_path, variables
from .tree import conditions, identifier, rewritten

OFTEN = 3  # uses from which a well-known width gets its short name
LONG, LONG_OFTEN = 30, 3  # characters, and uses, from which anything else gets one
WIDTHS = {
    "hidden_size": "h",
    "intermediate_size": "ff",
    "d_model": "d",
    "embed_dim": "e",
    "n_embd": "e",
    "dim": "d",
    "hidden_dim": "h",
    "d_ff": "ff",
    "ffn_dim": "ff",
    "encoder_ffn_dim": "encoder_ff",
    "decoder_ffn_dim": "decoder_ff",
    "moe_intermediate_size": "expert_ff",
    "embedding_size": "e",
    "vision_hidden_size": "vision_h",
}
PRODUCTS = {
    "c.num_attention_heads * c.head_dim": "q",
    "c.head_dim * c.num_attention_heads": "q",
    "c.num_attention_heads * head_dim": "q",
    "c.num_key_value_heads * head_dim": "kv",
    "c.num_key_value_heads * c.head_dim": "kv",
    "c.head_dim * c.num_key_value_heads": "kv",
}
SUBS = {
    "text_config": "text_",
    "vision_config": "vision_",
    "audio_config": "audio_",
    "encoder": "encoder_",
    "decoder": "decoder_",
    "backbone_config": "backbone_",
}


def short(path):
    """The short name of a width, `vision_h` for one of a sub-config."""
    sub, _, leaf = path.rpartition(".")
    if leaf not in WIDTHS or sub and sub not in SUBS:
        return None
    return SUBS.get(sub, "") + WIDTHS[leaf]


def name_all(classes):
    """(lets, classes): `let` of the file, and its classes' tensors with the names in place of what they stand for."""
    indices = {index for tensors in classes for index in all_indices(tensors)}
    naming = Naming(classes, indices)
    for text, name in fallbacks(naming.said(), indices):
        naming.give(name, text, lambda t, text=text, name=name: name if t == text else t.replace(f"({text})", name))
    texts = naming.counted()
    for text, name in PRODUCTS.items():
        if texts[text] >= 2:
            naming.give(name, text, lambda t, text=text, name=name: name if t == text else t)
    keys = Counter(path for _, _, text in naming.said() for path in paths(text))
    widths = {}
    for path, uses in sorted(keys.items(), key=lambda row: (-row[1], row[0])):
        name = short(path)
        if name and uses >= OFTEN and naming.free(name) and name not in widths:
            widths[name] = f"c.{path}"
            naming.rewrite(lambda t, path=path, name=name: replace_path(t, path, name))
    texts = naming.counted()
    for place, kind, text in naming.said():
        if (
            len(text) >= LONG
            and not re.fullmatch(r"c[\w.]+", text)
            and texts[text] >= LONG_OFTEN
            and text not in naming.lets.values()
            and not variables(text) & indices
        ):
            name = stem(place, kind)
            while not naming.free(name) or name in widths:
                name += "_too" if not name[-1].isdigit() else "0"
            naming.give(name, text, lambda t, text=text, name=name: name if t == text else t)
    return {**dict(sorted(widths.items())), **naming.lets}, naming.classes


class Naming:
    def __init__(self, classes, indices):
        self.classes, self.indices, self.lets = classes, indices, {}

    def said(self):
        return [row for tensors in self.classes for row in conditions(tensors)]

    def counted(self):
        return Counter(text for _, _, text in self.said())

    def free(self, name):
        return name not in self.lets and name not in self.indices

    def give(self, name, text, rewrite):
        if self.free(name):
            self.rewrite(rewrite)
            self.lets[name] = text

    def rewrite(self, rewrite):
        self.classes = [rewritten(tensors, rewrite) for tensors in self.classes]
        self.lets = {name: rewrite(text) for name, text in self.lets.items()}


FALLBACK = re.compile(r"c\.(\w+) != null \? c\.\1 : [^?:()\[\]]*(?:\([^?:()\[\]]*\))?[^?:()\[\]]*")


def fallbacks(said, indices):
    """`c.head_dim != null ? c.head_dim : …`, said twice, is `head_dim`."""
    found = Counter()
    for _, _, text in said:
        for match in FALLBACK.finditer(text):
            one = match[0].strip()
            if text == one or f"({one})" in text:
                found[match[1], one] += 1
    taken = set(indices)
    for (key, text), uses in found.items():
        if uses >= 2 and key not in taken and not variables(text) & indices:
            taken.add(key)
            yield text, key


def stem(place, kind):
    name = identifier(place)
    return {"shape": f"{name}_size", "repeat": f"{name}_count"}.get(kind, f"has_{name}")


def all_indices(tensors):
    for member in tensors.values():
        yield from member.get("repeat", ())
        yield from member.get("let", ())
        if "tensors" in member:
            yield from all_indices(member["tensors"])
