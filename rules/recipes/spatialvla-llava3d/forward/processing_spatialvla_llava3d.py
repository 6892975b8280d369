"""SpatialVLA's processor, taken from the installed package `{{package}}`, over a Llama tokenizer.

Only the class names differ: with those of SpatialVLA, AutoProcessor wraps the Llama vocabulary in Gemma's tokenizer,
which raises no error and gives other ids.
"""

from {{package}}.processing_spatialvla import SpatialVLAProcessor as _SpatialVLAProcessor


class SpatialVLAProcessor(_SpatialVLAProcessor):
    tokenizer_class = ("LlamaTokenizer", "LlamaTokenizerFast")
