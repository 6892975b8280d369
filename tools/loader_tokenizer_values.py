#!/usr/bin/env python3
"""Write which values of tokenizer.json the tokenizers library refuses to rules/tokenizer-values.json. For maintainers.

    python tools/loader_tokenizer_values.py            # replace the entries of this version
    python tools/loader_tokenizer_values.py --check    # fail if the entries of this version differ

A document is made for every type of normalizer, pre-tokenizer, post-processor, decoder and model. Each of its keys is taken out, and
tried with values of every kind. A place is a path of keys; `*` stands for any key of a vocabulary and any element of a list, and a
part is named by its slot and its type: `normalizer Replace/pattern`. For each place there is one letter for each of `kinds`: `.` loads,
`R` is refused, and `d` depends on the value or on others; the last one is that of a missing key. `words` are texts that load, of
those that were tried, where others do not; `closed` are the objects that may have no other key. All known versions do the same.
"""

import copy
import io
import json
import sys
from pathlib import Path

import sentencepiece
import tokenizers
from sentencepiece import sentencepiece_model_pb2
from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, processors

FILE = Path(__file__).resolve().parents[1] / "rules" / "tokenizer-values.json"
KINDS = {
    "null": [None],
    "text": ["x", "y z", "("],
    "true": [True],
    "false": [False],
    "zero": [0],
    "one": [1],
    "whole": [2, 7, 50000],
    "negative": [-1, -7],
    "fraction": [0.0, 0.37, 1.0, 1.63, 4.0, -0.5],
    "empty-list": [[]],
    "list": [["x"], [1], [1, 2], ["a", "b"], [["a", "b"]], [{}]],
    "empty-object": [{}],
    "object": [{"x": 1}, {"Fixed": 8}, {"String": "a"}],
}
# Lists whose elements are told apart.
PAIRS = {"cls", "sep"}
# Lists of parts, and the slot of their elements.
LISTS = {"normalizers": "normalizer", "pretokenizers": "pre_tokenizer", "processors": "post_processor", "decoders": "decoder"}
SLOTS = (*LISTS.values(), "model")
# Objects with keys of any name.
FREE = {"vocab", "special_tokens"}
WORDS = ["(", "A", "B", "Removed", "Isolated", "MergedWithPrevious", "MergedWithNext", "Contiguous", "first", "never", "always", "Left",
         "Right", "LongestFirst", "OnlyFirst", "OnlySecond", "BatchLongest", "1.0", "2.0", "a", "ab"]  # fmt: skip
UPPER, LOWER = r"[\p{Lu}\p{Lt}\p{Lm}\p{Lo}\p{M}]", r"[\p{Ll}\p{Lm}\p{Lo}\p{M}]"
# Patterns of published tokenizers and of classes of transformers. No others are said to load: the engine has a syntax of its own.
PATTERNS = [
    " {2,}", r"\s+", " +▁", "^▁+$", r"\n", r"[\n\r\t]", r"\s{2,}|[\n\r\t]", r"\S+", "[\r\n]", "[0-9][0-9][0-9]", r"\s+|\w+|[^\w\s]+",
    r"\s?\p{L}+", r"\s?\p{P}+", "[一-龥ࠀ-一가-퟿]+", r"[\(\)\[\]\{\}]|([!\"\#\$%\&'\*\+,\-\./:;<=>\?\\\^_`\|\~])\1*",
    r"'s|'t|'re|'ve|'m|'ll|'d| ?\p{L}+| ?\p{N}+| ?[^\s\p{L}\p{N}]+|\s+(?!\S)|\s+",
    r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+",
    r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+",
    *(rf"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{{L}}\p{{N}}]?{word}+|{number}| ?[^\s{others}\p{{N}}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
      for word, others in ((r"\p{L}", r"\p{L}"), (r"[\p{L}\p{M}]", r"\p{L}\p{M}")) for number in (r"\p{N}", r"\p{N}{1,3}")),
    *(rf"[^\r\n\p{{L}}\p{{N}}]?{UPPER}*{LOWER}+{end}|[^\r\n\p{{L}}\p{{N}}]?{UPPER}+{LOWER}*{end}|{number}"
      rf"| ?[^\s\p{{L}}\p{{N}}]+[\r\n/]*|\s*[\r\n]+|\s+(?!\S)|\s+"
      for end in ("", "(?i:'s|'t|'re|'ve|'m|'ll|'d)?") for number in (r"\p{N}", r"\p{N}{1,3}")),
]  # fmt: skip
# Tables of characters: whole ones, and others with one fault each.
CHARSMAPS = ["BAAAAAAAAABhYgA=", "BAAAAAAAAAA=", "BQAAAAAAAABhYgA=", "AAAAAAAAAABhYgA=", "BAAAAAAAAABhYg", "BAAAAAAAAABhYg==",
             "kAEAAAAAAABhYgA=", "BAAAAAAAAABhYgD/", "", "YWJj", "BAAAAAAAAABhYgA=\n", "*AAAAAAAAABhYgA=", "BAAAAAAAAABhYgA_",
             "BAAAAAAAAABhYB==", "BAAAAAAAAABhYg==BAAAAAAAAABhYgA=", "BAAAAAAAAABhYgA=="]  # fmt: skip
TEXTS = {"Regex": PATTERNS, "precompiled_charsmap": CHARSMAPS}
VOCAB = {"<unk>": 0, "a": 1, "b": 2, "ab": 3, "##b": 4, "▁": 5}
PIECES = [["<unk>", 0.0], ["a", -1.0], ["b", -1.5], ["ab", -2.0], ["▁", -3.0]]


def charsmap():
    """The table of characters that sentencepiece writes into its models."""
    out = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter(["a b ab", "ab a b"] * 50),
        model_writer=out,
        vocab_size=10,
        minloglevel=2,
        hard_vocab_limit=False,
    )
    model = sentencepiece_model_pb2.ModelProto()
    model.ParseFromString(out.getvalue())
    return model.normalizer_spec.precompiled_charsmap


def parts():
    """(slot, part) of every kind."""
    n, p, d = normalizers, pre_tokenizers, decoders
    yield "normalizer", n.Precompiled(charsmap())
    yield from (("normalizer", part) for part in [
        n.BertNormalizer(), n.ByteLevel(), n.Lowercase(), n.NFC(), n.NFD(), n.NFKC(), n.NFKD(), n.Nmt(), n.Prepend("▁"),
        n.Replace("a", "b"), n.Replace(Regex("a"), "b"), n.Strip(), n.StripAccents(), n.Sequence([n.NFC(), n.Replace("a", "b")]),
    ])  # fmt: skip
    yield from (("pre_tokenizer", part) for part in [
        p.BertPreTokenizer(), p.ByteLevel(), p.CharDelimiterSplit("a"), p.Digits(), p.FixedLength(2), p.Metaspace(), p.Punctuation(),
        p.Split("a", "removed"), p.Split(Regex("a"), "isolated"), p.UnicodeScripts(), p.Whitespace(), p.WhitespaceSplit(),
        p.Sequence([p.Whitespace(), p.Digits()]),
    ])  # fmt: skip
    template = processors.TemplateProcessing("a $A b", "a $A b $B:1 b:1", [("a", 1), ("b", 2)])
    yield from (("post_processor", part) for part in [
        processors.BertProcessing(("a", 1), ("b", 2)), processors.RobertaProcessing(("a", 1), ("b", 2)), processors.ByteLevel(), template,
        processors.Sequence([processors.ByteLevel(), template]),
    ])  # fmt: skip
    yield from (("decoder", part) for part in [
        d.BPEDecoder(), d.ByteFallback(), d.ByteLevel(), d.CTC(), d.Fuse(), d.Metaspace(), d.Replace("a", "b"), d.Replace(Regex("a"), "b"),
        d.Strip(), d.WordPiece(), d.Sequence([d.ByteFallback(), d.Strip()]),
    ])  # fmt: skip
    yield from (("model", part) for part in [
        models.BPE(VOCAB, [("a", "b")], unk_token="<unk>"), models.Unigram([tuple(p) for p in PIECES], unk_id=0),
        models.WordLevel(VOCAB, unk_token="<unk>"), models.WordPiece(VOCAB, unk_token="<unk>"),
    ])  # fmt: skip


def documents():
    """Documents that load, with every part in one of them."""
    for slot, part in parts():
        tokenizer = Tokenizer(part if slot == "model" else models.WordLevel(VOCAB, unk_token="<unk>"))
        if slot != "model":
            setattr(tokenizer, slot, part)
        tokenizer.add_special_tokens(["<unk>", "<s>"])
        tokenizer.enable_truncation(8)
        tokenizer.enable_padding(pad_token="<unk>")
        yield json.loads(tokenizer.to_str())


def loads(document):
    """Whether the library reads the document."""
    try:
        Tokenizer.from_str(json.dumps(document))
    except BaseException:  # it panics, too
        return False
    return True


def places(value, path=(), place=""):
    """(path, place) of every key and element below a value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    last = path[-1] if path else None
    for key, inner in items:
        is_any = last in FREE or (isinstance(value, list) and last not in PAIRS)
        under = "*" if is_any else str(key)
        slot = LISTS.get(last) if isinstance(value, list) else key if not path and key in SLOTS else None
        here = f"{place}/{under}" if place else under
        yield (*path, key), here
        if slot and isinstance(inner, dict) and "type" in inner:
            here = f"{slot} {inner['type']}"
        yield from places(inner, (*path, key), here)


def at(document, path):
    for key in path:
        document = document[key]
    return document


def tried(document, path):
    """{kind: `refused` or `depends`} of the value at a path, with `absent` for a key that has to be there."""
    found, words = {}, None
    parent, key = path[:-1], path[-1]

    def outcome(value):
        other = copy.deepcopy(document)
        at(other, parent)[key] = copy.deepcopy(value)
        return loads(other)

    own = at(document, path)
    for kind, values in KINDS.items():
        said = [outcome(value) for value in values]
        if not all(said):
            found[kind] = "depends" if any(said) else "refused"
    if "text" in found:
        candidates = sorted({*TEXTS.get(key, WORDS), *([own] if isinstance(own, str) and len(own) < 40 else [])})
        words = [word for word in candidates if outcome(word)]
        if (words or isinstance(own, str)) and found["text"] == "refused":
            found["text"] = "depends"
    if isinstance(at(document, parent), dict) and "*" not in str(key):
        other = copy.deepcopy(document)
        del at(other, parent)[key]
        if not loads(other):
            found["absent"] = "refused"
    return found, words


def main():
    refused, words, extra = {}, {}, set()
    for document in documents():
        assert loads(document), document
        for path, place in places(document):
            found, load = tried(document, path)
            known = refused.setdefault(place, found)
            # Another value beside it decides.
            if known != found:
                kinds = {*known, *found}
                refused[place] = {k: known[k] if known.get(k) == found.get(k) else "depends" for k in kinds}
            if load and (path[-1] in TEXTS or len(load) < len(WORDS) - 1):
                words[place] = sorted({*words.get(place, []), *load})
            if isinstance(at(document, path), dict) and path[-1] not in FREE:
                other = copy.deepcopy(document)
                at(other, path)["another key"] = 1
                if not loads(other):
                    extra.add(place)
        other = {**document, "another key": 1}
        if not loads(other):
            extra.add("")
    letters = {"refused": "R", "depends": "d"}
    rows = {
        place: "".join(letters.get(found.get(kind), ".") for kind in [*KINDS, "absent"])
        for place, found in sorted(refused.items())
    }
    entry = {"kinds": [*KINDS, "absent"], "closed": sorted(extra), "places": rows, "words": dict(sorted(words.items()))}
    if "--check" in sys.argv[1:]:
        known = json.loads(FILE.read_text())
        differing = [f"{kind} {name}" for kind in ("places", "words") for name in {*known[kind], *entry[kind]}
                     if known[kind].get(name) != entry[kind].get(name)]  # fmt: skip
        print(
            f"{FILE.name}, tokenizers {tokenizers.__version__}: {len(rows)} places; differing: {', '.join(sorted(differing)) or 'none'}"
        )
        return 1 if differing or known["closed"] != entry["closed"] else 0
    FILE.write_text(shown(entry))
    print(f"{FILE.name}: {len(rows)} places of tokenizers {tokenizers.__version__}")
    return 0


def shown(entry):
    """One place in a line."""

    def table(name):
        lines = (
            f"    {json.dumps(k, ensure_ascii=False)}: {json.dumps(v, ensure_ascii=False)}" for k, v in entry[name].items()
        )
        return f'  "{name}": {{\n' + ",\n".join(lines) + "\n  }"

    lists = (f'  "{name}": {json.dumps(entry[name])}' for name in ("kinds", "closed"))
    return "{\n" + ",\n".join([*lists, table("places"), table("words")]) + "\n}\n"


if __name__ == "__main__":
    sys.exit(main())
