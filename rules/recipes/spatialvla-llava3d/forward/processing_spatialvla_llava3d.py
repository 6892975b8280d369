"""SpatialVLA's processor, taken from the installed package `{{package}}`, over the language
model's own tokenizer.

Only the class name differs: with those of SpatialVLA, AutoProcessor wraps the other vocabulary in Gemma's tokenizer,
which raises no error and gives other ids.
"""

from {{package}}.processing_spatialvla import SpatialVLAProcessor as _SpatialVLAProcessor


class SpatialVLAProcessor(_SpatialVLAProcessor):
    tokenizer_class = "AutoTokenizer"
