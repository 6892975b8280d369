"""SpatialVLA's model class around the language model that `text_config` names.

SpatialVLA builds a Gemma 2 unless it is handed a language model; here it is handed one. Tensor names, the forward
pass and the hook after loading are SpatialVLA's own.
"""

from transformers import AutoModelForCausalLM

from {{package}}.modeling_spatialvla import SpatialVLAForConditionalGeneration as _SpatialVLA

# The very class that AutoConfig reads config.json into; AutoModel compares the two.
from .configuration_spatialvla_llava3d import SpatialVLAConfig


class SpatialVLAForConditionalGeneration(_SpatialVLA):
    config_class = SpatialVLAConfig

    def __init__(self, config, vision_model=None, vision_zoe_model=None, projector_model=None, language_model=None):
        language_model = language_model or AutoModelForCausalLM.from_config(config.text_config)
        super().__init__(config, vision_model, vision_zoe_model, projector_model, language_model)
