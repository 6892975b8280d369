#!/usr/bin/env python3
"""The ids that processors give to their tokens, by loader, against what `check` reports.

    token_ids.py FOLDER...

Each FOLDER has one version of transformers, for the Python that runs this; the first one makes the tokenizers. Tiny
tokenizers as Llama 2, Llama 3, Qwen2 and Gemma have them are put below each processor class. With the id that the loader
gives to the image token, `check --for` that version must report nothing about ids; with another id, or if the tokenizer
lacks the token, it must. A processor that raises must be predicted to.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from fresh import version_in
from peer import Tally, check, quiet, tiny_sentencepiece, workplace

# By model type: the processor class, its image processor, and keys of processor_config.json.
SQUARE = {"size": {"height": 28, "width": 28}}
CLIP = {"size": {"shortest_edge": 28}, "crop_size": {"height": 28, "width": 28}}
HOSTS = {
    "paligemma": ("PaliGemmaProcessor", {"image_processor_type": "SiglipImageProcessor", **SQUARE, "image_seq_length": 4}, {}),
    "llava": ("LlavaProcessor", {"image_processor_type": "CLIPImageProcessor", **CLIP}, {"patch_size": 14}),
    "llava_next": ("LlavaNextProcessor", {"image_processor_type": "LlavaNextImageProcessor", **CLIP}, {"patch_size": 14}),
    "llava_onevision": ("LlavaOnevisionProcessor", {"image_processor_type": "LlavaOnevisionImageProcessor", **SQUARE}, {}),
    "idefics2": ("Idefics2Processor", {"image_processor_type": "Idefics2ImageProcessor"}, {"image_seq_len": 4}),
    "idefics3": ("Idefics3Processor", {"image_processor_type": "Idefics3ImageProcessor"}, {"image_seq_len": 4}),
    "qwen2_vl": ("Qwen2VLProcessor", {"image_processor_type": "Qwen2VLImageProcessor"}, {}),
}
KEYS = {"idefics2": "image_token_id", "idefics3": "image_token_id", "qwen2_vl": "image_token_id"}
TEXTS = {"qwen2_vl": "<|image_pad|>"}
IDS = {"VLA005", "PRC014"}  # rules about the id of the image token
BPE_TEXT = "pick place cup spoon move the red green left right robot arm should take what drawer open near on in"


def byte_level(specials):
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers

    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(vocab_size=320, initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False)
    tokenizer.train_from_iterator([BPE_TEXT] * 20, trainer)
    tokenizer.add_special_tokens([AddedToken(token, special=True, normalized=False) for token in specials])
    return tokenizer


def make(place):
    """Writes the tokenizers, each as a donor has it, and some with fewer keys in tokenizer_config.json."""
    from transformers import GemmaTokenizerFast, LlamaTokenizerFast, PreTrainedTokenizerFast, Qwen2TokenizerFast

    llama = tiny_sentencepiece(place, "llama", 340, unk_id=0, bos_id=1, eos_id=2, pad_id=-1)
    gemma = tiny_sentencepiece(
        place,
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
    with_image = LlamaTokenizerFast(vocab_file=llama, pad_token="<unk>")
    with_image.add_tokens(["<image>"], special_tokens=True)
    of_gemma = GemmaTokenizerFast(vocab_file=gemma)
    of_gemma.add_tokens(["<mask>"], special_tokens=True)  # the class of transformers 5 adds it; Gemma has it
    begin, end = "<|begin_of_text|>", "<|eot_id|>"
    llama3 = PreTrainedTokenizerFast(tokenizer_object=byte_level([begin, end]), bos_token=begin, eos_token=end)
    words = ["<|endoftext|>", "<|im_start|>", "<|im_end|>"]
    asked = {"eos_token": "<|im_end|>", "pad_token": "<|endoftext|>", "unk_token": None}
    made = {
        "llama2": LlamaTokenizerFast(vocab_file=llama),
        "llama2-image": with_image,
        "llama3": llama3,
        "qwen2": Qwen2TokenizerFast(tokenizer_object=byte_level(words), **asked),
        "qwen2-vl": Qwen2TokenizerFast(tokenizer_object=byte_level([*words, "<|image_pad|>"]), **asked),
        "gemma": of_gemma,
    }
    for name, tokenizer in made.items():
        tokenizer.save_pretrained(place / name)
    for name, keys in (("llama3", ("bos_token",)), ("qwen2", ("unk_token", "pad_token"))):
        folder = shutil.copytree(place / name, place / f"{name}-bare")
        config = json.loads((folder / "tokenizer_config.json").read_text())
        config = {key: value for key, value in config.items() if key not in keys}
        (folder / "tokenizer_config.json").write_text(json.dumps(config))
        (folder / "special_tokens_map.json").unlink(missing_ok=True)
    config = json.loads((place / "qwen2-bare" / "tokenizer_config.json").read_text())
    shutil.copytree(place / "qwen2-bare", place / "qwen2-no-bos")
    (place / "qwen2-no-bos" / "tokenizer_config.json").write_text(json.dumps({**config, "add_bos_token": False}))


def compose(place, tokenizer, host, token_id):
    """A directory with the tokenizer and the documents of a model, without weights."""
    folder = place / f"{host}+{tokenizer.name}"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(tokenizer, folder)
    processor, images, more = HOSTS[host]
    for name, content in (
        ("config.json", {"model_type": host, KEYS.get(host, "image_token_index"): token_id}),
        ("preprocessor_config.json", {**images, "processor_class": processor}),
        ("processor_config.json", {**more, "processor_class": processor}),
    ):
        (folder / name).write_text(json.dumps(content))
    return folder


def worker(folders):
    """Under one version: for each folder the id of the image token (null without one) and the length, or the exception."""
    from transformers import AutoProcessor

    quiet()
    told = {}
    for folder in map(Path, folders):
        try:
            tokenizer = AutoProcessor.from_pretrained(folder).tokenizer
            text = TEXTS.get(folder.name.split("+")[0], "<image>")
            told[folder.name] = {"id": tokenizer.get_vocab().get(text), "length": len(tokenizer)}
        except Exception as error:  # each class has its own
            told[folder.name] = {"raises": f"{type(error).__name__}: {error}"[:200]}
    print(json.dumps(told))


def run(folder, *words):
    env = {**os.environ, "PYTHONPATH": folder, "TRANSFORMERS_VERBOSITY": "critical", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, __file__, *map(str, words)], capture_output=True, text=True, env=env)
    if done.returncode:
        sys.exit(f"{words[0]} failed with {folder}:\n{done.stderr[-2000:]}")
    return done.stdout


def codes(folder, version):
    (entry,) = check(folder, "--metadata-only", "--for", f"transformers=={version}")[0].values()
    return {finding["code"] for finding in entry["findings"]}


def compare(tally, place, folder, version, told):
    """What `check` reports for the loader's own id, and for another one."""
    host, tokenizer = folder.name.split("+")
    what = f"{version} {folder.name}"
    own = told.get("id")
    compose(place, place / tokenizer, host, 5 if own is None else own)
    found = codes(folder, version)
    if "ARC001" in found:  # the class is not known under this version, and nothing is said
        return None
    if "raises" in told:
        return tally.expect("PRC015" in found, f"{what}: {told['raises']}; check reports {sorted(found)}")
    if own is None:
        return tally.expect(found & IDS, f"{what}: the tokenizer lacks the token; check reports {sorted(found)}")
    tally.expect(not found & IDS, f"{what}: the id is {own}; check reports {sorted(found & IDS)}")
    compose(place, place / tokenizer, host, own - 1)
    return tally.expect(codes(folder, version) & IDS, f"{what}: check does not report the id {own - 1}, which is {own}")


def main():
    if sys.argv[1] == "--make":
        return make(Path(sys.argv[2]))
    if sys.argv[1] == "--worker":
        return worker(sys.argv[2:])
    versions, tally, counts = sys.argv[1:], Tally(), {}
    with workplace() as place:
        run(versions[0], "--make", place)
        tokenizers = sorted(path for path in place.iterdir() if path.is_dir())
        folders = [compose(place, tokenizer, host, 0) for host in HOSTS for tokenizer in tokenizers]
        for version_folder in versions:
            version = version_in(version_folder)
            told = json.loads(run(version_folder, "--worker", *folders))
            silent = [folder.name for folder in folders if compare(tally, place, folder, version, told[folder.name]) is None]
            tally.expect(len(silent) <= len(tokenizers), f"{version}: nothing is said of {silent}")
            kinds = ["raises" if "raises" in t else "absent" if t["id"] is None else "id" for t in told.values()]
            counts[version] = {kind: kinds.count(kind) for kind in ("id", "absent", "raises")}
    for version, count in counts.items():
        print(
            f"transformers {version}: {count['id']} ids, {count['absent']} tokenizers without the token, {count['raises']} raise"
        )
        tally.expect(count["id"] >= 20, f"{version}: only {count['id']} processors gave an id")
    return tally.finish()


if __name__ == "__main__":
    main()
