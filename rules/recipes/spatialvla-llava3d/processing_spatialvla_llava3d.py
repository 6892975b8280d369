"""SpatialVLA's processor over a Llama tokenizer.

The class names are what matters: under SpatialVLA's own, AutoProcessor wraps the Llama vocabulary in Gemma's
tokenizer, which says nothing and gives other ids.
"""

# transformers copies only the files that this one imports by itself, relatively and by name. The first is imported
# by processing_spatialvla.py: without this line it would stay behind, and loading would not find it.
from .action_tokenizer import SpatialActionTokenizer  # noqa: F401
from .processing_spatialvla import SpatialVLAProcessor as _SpatialVLAProcessor


class SpatialVLAProcessor(_SpatialVLAProcessor):
    tokenizer_class = ("LlamaTokenizer", "LlamaTokenizerFast")
