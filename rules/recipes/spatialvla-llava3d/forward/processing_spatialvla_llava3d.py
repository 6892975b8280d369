"""SpatialVLA's processor, taken from the installed package `{{package}}`, over a Llama tokenizer.

The class names are what matters: under SpatialVLA's own, AutoProcessor wraps the Llama vocabulary in Gemma's
tokenizer, which says nothing and gives other ids.
"""

from {{package}}.processing_spatialvla import SpatialVLAProcessor as _SpatialVLAProcessor


class SpatialVLAProcessor(_SpatialVLAProcessor):
    tokenizer_class = ("LlamaTokenizer", "LlamaTokenizerFast")
