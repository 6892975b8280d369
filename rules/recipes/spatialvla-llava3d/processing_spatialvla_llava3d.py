"""SpatialVLA's processor over the language model's own tokenizer.

Only the class name differs: with those of SpatialVLA, AutoProcessor wraps the other vocabulary in Gemma's tokenizer,
which raises no error and gives other ids.
"""

# transformers copies only the files that this module imports directly. processing_spatialvla.py imports the first;
# without this line it would not be copied, and loading would raise FileNotFoundError.
from .action_tokenizer import SpatialActionTokenizer  # noqa: F401
from .processing_spatialvla import SpatialVLAProcessor as _SpatialVLAProcessor


class SpatialVLAProcessor(_SpatialVLAProcessor):
    tokenizer_class = "AutoTokenizer"
