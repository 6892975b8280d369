"""SpatialVLA's model class with the language model of `text_config`.

SpatialVLA builds a Gemma 2 unless a language model is passed to it; this class passes one. Tensor names, the forward
pass and the hook after loading are those of SpatialVLA.
"""

from transformers import AutoModelForCausalLM

# transformers copies only the files that this module imports directly. modeling_spatialvla.py imports the first two;
# without these lines they would not be copied, and loading would raise FileNotFoundError.
from .configuration_spatialvla import SpatialVLAConfig  # noqa: F401
from .modeling_gemma2 import Gemma2ForCausalLM  # noqa: F401
from .modeling_spatialvla import SpatialVLAForConditionalGeneration as _SpatialVLA


class SpatialVLAForConditionalGeneration(_SpatialVLA):
    def __init__(self, config, vision_model=None, vision_zoe_model=None, projector_model=None, language_model=None):
        language_model = language_model or AutoModelForCausalLM.from_config(config.text_config)
        super().__init__(config, vision_model, vision_zoe_model, projector_model, language_model)
