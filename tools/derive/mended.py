"""Files of rules/architectures that are written by hand where the tool falls short, and classes that are refused.

A run of the tool leaves these files as they are. Delete the line of one that the tool gets right by itself. Single classes
that the tool does not explain need no line here: `graft.py` keeps them as the files have them."""

# {stem: what is written by hand}
MENDED = {
    "depth_anything": "the backbone's config decides what the file speaks for",
    "prompt_depth_anything": "the backbone's config decides what the file speaks for",
    "zoedepth": "the backbone's config decides what the file speaks for",
}

# Classes whose expressions held for all samples and unseen configs and are wrong all the same: {class: what is not explained}
REFUSED = {
    "EfficientFormerModel": "widths of later stages",
    "GPTSanJapaneseForConditionalGeneration": "widths of extra layers and the spout",
    "JukeboxModel": "blocks of its autoencoders by their lists",
    "PPLCNetV4Backbone": "widths of its blocks by their lists",
    "PerceiverForImageClassificationLearned": "widths of queries and keys, positions by image_size",
    "PerceiverModel": "widths of queries and keys",
}
